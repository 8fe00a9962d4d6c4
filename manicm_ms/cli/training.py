"""`manicm-ms train` and `distill`: the fields of the named preset are options, its values their defaults."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from manicm_ms.cli.counts import Seed
from manicm_ms.cli.options import this_command
from manicm_ms.errors import ConfigError, ManicmWarning
from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS, StudentPreset, TeacherPreset

DEFAULT_PRESET = "quick"


def train_command(arguments: Sequence[str]) -> Callable[..., None]:
    """Return the command `train` with the preset that `arguments` name."""
    default = TEACHER_PRESETS.get(_preset_asked(arguments))

    def train(
        policy: tyro.conf.Positional[str],
        data: tuple[Path, ...],
        out: Path,
        recipe: Annotated[TeacherPreset, tyro.conf.arg(name="")] = default,
        preset: str = DEFAULT_PRESET,
        device: str = "auto",
        seed: Seed = 0,
    ) -> None:
        """Train a diffusion teacher on demonstrations; the same command goes on after Ctrl-C or a kill.

        Args:
            policy: dp3 or simple_dp3.
            data: store of demonstrations; several of the same task are read as one.
            out: checkpoint folder to write; state and logs go beside it, to OUT.train.
            recipe: the preset's fields, each of which can be overridden.
            preset: recipe to start from; `manicm-ms list presets` shows them.
            device: torch device; auto takes an accelerator where there is one.
            seed: of weights, batches and noise.
        """
        from manicm_ms.training.demonstrations import store_paths
        from manicm_ms.training.teacher import train_teacher

        for store in store_paths(data):
            _check_points(recipe, default, store)
        train_teacher(policy, data, out, recipe, device=device, seed=seed, command=this_command())

    return train


def distill_command(arguments: Sequence[str]) -> Callable[..., None]:
    """Return the command `distill` with the preset that `arguments` name."""
    default = STUDENT_PRESETS.get(_preset_asked(arguments))

    def distill(
        teacher: Path,
        data: tuple[Path, ...],
        out: Path,
        recipe: Annotated[StudentPreset, tyro.conf.arg(name="")] = default,
        preset: str = DEFAULT_PRESET,
        device: str = "auto",
        seed: Seed = 0,
        allow_other_task: bool = False,
    ) -> None:
        """Distil a teacher into a one-step ManiCM student; the same command goes on after Ctrl-C or a kill.

        Args:
            teacher: checkpoint folder of the teacher.
            data: the store, or stores, that the teacher was trained on.
            out: checkpoint folder to write; state and logs go beside it, to OUT.train.
            recipe: the preset's fields, each of which can be overridden.
            preset: recipe to start from; `manicm-ms list presets` shows them.
            device: torch device; auto takes an accelerator where there is one.
            seed: of batches and noise.
            allow_other_task: take demonstrations of another task than the teacher's, which is refused otherwise.
        """
        from manicm_ms.training.student import distill as distill_student

        distill_student(
            teacher, data, out, recipe, device=device, seed=seed, allow_other_task=allow_other_task,
            command=this_command(),
        )  # fmt: skip

    return distill


def _check_points(recipe: TeacherPreset, default: TeacherPreset, data: Path) -> None:
    """Raise ConfigError where more points are asked for than the clouds of the store have.

    A preset's own number is no such request: of smaller clouds all points are read, which a warning says.
    """
    from manicm_ms.demos.store import DemoStore

    with DemoStore.open(data) as store:
        stored = store.spec.obs.num_points
    if recipe.points is None or recipe.points <= stored:
        return
    if recipe.points != default.points:
        raise ConfigError(
            f"--points {recipe.points} exceeds the {stored} points of each cloud in {data}: give {stored} or less"
        )
    warnings.warn(
        f"the clouds in {data} have {stored} points: all are read, where the preset names {recipe.points}",
        ManicmWarning,
        stacklevel=2,
    )


def _preset_asked(arguments: Sequence[str]) -> str:
    """Return the preset that the command line names: known before parsing, because the defaults depend on it."""
    for k, word in enumerate(arguments):
        if word == "--preset" and k + 1 < len(arguments):
            return arguments[k + 1]
        if word.startswith("--preset="):
            return word.removeprefix("--preset=")
    return DEFAULT_PRESET
