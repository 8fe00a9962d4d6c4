"""Tables of what is registered, for `manicm-ms list`."""

from __future__ import annotations

from dataclasses import fields

from rich.console import Console
from rich.table import Table

from manicm_ms.errors import UnknownNameError

_FILE_WIDTH = 160  # columns of a table that is not read on a terminal


def console() -> Console:
    """Return standard output, wide enough for a table where it is a file."""
    found = Console()
    if not found.is_terminal:
        found.width = max(found.width, _FILE_WIDTH)
    return found


def envs(tag: str | None = None) -> Table:
    """Return the environments, those carrying `tag` if it is given: shapes, rate, length, expert styles, tags.

    Raises UnknownNameError where no environment carries `tag`.
    """
    from manicm_ms.demos.experts import EXPERTS
    from manicm_ms.envs.simulator import ENVS

    known_tags = {t for name in ENVS.names() for t in ENVS.tags(name)}
    if tag is not None and tag not in known_tags:
        raise UnknownNameError("tag", tag, known_tags)
    table = Table("env id", "cloud", "agent_pos", "action", "Hz", "steps", "frame", "expert", "tags")
    for column in table.columns[:2]:
        column.no_wrap = True
    for name in ENVS.names(tag):
        spec = ENVS.get(name).spec
        styles = getattr(EXPERTS.get(name), "styles", ("yes",)) if name in EXPERTS.names() else ("none",)
        cloud = f"{spec.obs.num_points}x{spec.obs.point_channels}"
        numbers = (spec.obs.agent_pos_dim, spec.action.dim, f"{spec.action.control_hz:g}", spec.max_episode_steps)
        table.add_row(
            name, cloud, *map(str, numbers), spec.obs.frame, ", ".join(styles), ", ".join(sorted(ENVS.tags(name)))
        )
    return table


def policies() -> Table:
    """Return the policies with one line on each."""
    from manicm_ms.policies.base import POLICIES

    table = Table("policy", "what it is")
    for name in POLICIES.names():
        table.add_row(name, (POLICIES.get(name).__doc__ or "").strip().splitlines()[0])
    return table


def presets() -> Table:
    """Return the training presets, a column each, and their fields."""
    from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS

    recipes = {f"teacher {n}": TEACHER_PRESETS.get(n) for n in TEACHER_PRESETS.names()}
    students = {f"student {n}": STUDENT_PRESETS.get(n) for n in STUDENT_PRESETS.names()}
    names = dict.fromkeys(f.name for recipe in (*recipes.values(), *students.values()) for f in fields(recipe))
    table = Table("field", *recipes, *students)
    for name in names:
        table.add_row(name, *(str(getattr(r, name, "")) for r in (*recipes.values(), *students.values())))
    return table
