"""Tables of what is registered, for `manicm-ms list`, in the width that there is."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from manicm_ms.errors import UnknownNameError

_FILE_WIDTH = 1000  # columns of what is not read on a terminal: a table takes as many as it needs
_SHOWN_METHOD = "simple_dp3"
_NONE = {"points": "all", "down_dims": "the policy's", "clip_norm": "no clipping"}
"""What None means in a preset's field; elsewhere, that the field does not apply."""


class Listing(NamedTuple):
    """A table before it is laid out.

    Attributes:
        headers: of the columns.
        rows: texts, as many as there are headers.
        title: above the table, or empty.
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""


def console() -> Console:
    """Return standard output, wide enough for any table where it is a file."""
    found = Console()
    if not found.is_terminal:
        found.width = max(found.width, _FILE_WIDTH)
    return found


def show(listing: Listing, where: Console) -> None:
    """Print a table; where the terminal is too narrow, each row as its first text and the others in lines below it."""
    table = Table(*listing.headers, title=listing.title or None, title_justify="left")
    for row in listing.rows:
        table.add_row(*row)
    if where.measure(table, options=where.options.update(width=_FILE_WIDTH)).maximum <= where.width:
        where.print(table)
        return
    lines = [f"{listing.title}:"] if listing.title else []
    for name, *values in listing.rows:
        pairs = zip(listing.headers[1:], values, strict=True)
        told = values if len(values) == 1 else [f"{header} {value}" for header, value in pairs if value]
        lines += [name, *textwrap.wrap("; ".join(told), where.width, initial_indent="  ", subsequent_indent="  ",
                                       break_long_words=False, break_on_hyphens=False)]  # fmt: skip
    where.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)


def envs(tag: str | None = None) -> list[Listing]:
    """Return the environments, those carrying `tag` if it is given: shapes, rate, length, expert styles, tags.

    Raises UnknownNameError where no environment carries `tag`.
    """
    from manicm_ms.demos.experts import EXPERTS
    from manicm_ms.envs.simulator import ENVS

    known_tags = {t for name in ENVS.names() for t in ENVS.tags(name)}
    if tag is not None and tag not in known_tags:
        raise UnknownNameError("tag", tag, known_tags)
    rows = []
    for name in ENVS.names(tag):
        spec = ENVS.get(name).spec
        styles = getattr(EXPERTS.get(name), "styles", ("yes",)) if name in EXPERTS.names() else ("none",)
        cloud = f"{spec.obs.num_points}x{spec.obs.point_channels}"
        numbers = (spec.obs.agent_pos_dim, spec.action.dim, f"{spec.action.control_hz:g}", spec.max_episode_steps)
        tags = ", ".join(sorted(ENVS.tags(name)))
        rows.append((name, cloud, *map(str, numbers), spec.obs.frame, ", ".join(styles), tags))
    return [Listing(("env id", "cloud", "agent_pos", "action", "Hz", "steps", "frame", "expert", "tags"), rows)]


def policies() -> list[Listing]:
    """Return the table of methods: parts, lengths, network evaluations, and one sentence on each."""
    from manicm_ms.policies.methods import METHODS

    rows = []
    for name in METHODS.names():
        row = METHODS.get(name)
        parts = [_part(part) for part in (row.encoder, row.backbone, row.head)]
        chunk = f"{row.chunk.n_obs_steps}, {row.chunk.horizon}, {row.chunk.n_action_steps}"
        rows.append((name, *parts, row.objective, chunk, str(row.nfe), row.sentence, row.reference))
    headers = ("policy", "encoder", "backbone", "head", "objective", "To, Tp, Ta", "NFE", "what it is", "reference")
    return [Listing(headers, rows)]


def _part(part: Any) -> str:
    return str(part["name"] if isinstance(part, Mapping) else part or "-")


def presets() -> list[Listing]:
    """Return the presets of trainings and those of distillations, a column each, and their fields.

    Those of trainings show the keys of a policy too, as simple_dp3 has them.
    """
    from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS
    from manicm_ms.training.settings import flag_values

    teachers = {}
    for name in TEACHER_PRESETS.names():
        preset = TEACHER_PRESETS.get(name)
        own = {f.name: getattr(preset, f.name) for f in fields(preset) if f.name != "changes"}
        teachers[name] = own | flag_values(_SHOWN_METHOD, preset)
    students = {}
    for name in STUDENT_PRESETS.names():
        distillation = STUDENT_PRESETS.get(name)
        students[name] = {f.name: getattr(distillation, f.name) for f in fields(distillation)}
    return [_presets(f"training presets, as for {_SHOWN_METHOD}", teachers), _presets("student presets", students)]


def _presets(title: str, presets: Mapping[str, Mapping[str, Any]]) -> Listing:
    names = dict.fromkeys(name for values in presets.values() for name in values)
    rows = [(name, *(_value(name, values.get(name)) for values in presets.values())) for name in names]
    return Listing(("field", *presets), rows, title)


def _value(name: str, value: Any) -> str:
    if value is None:
        return _NONE.get(name, "-")
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)
