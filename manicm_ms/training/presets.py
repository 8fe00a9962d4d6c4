"""Presets of teachers and students: everything that decides a training, named, documented and overridable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Self, TypeVar, get_type_hints

from manicm_ms.errors import ConfigError, UnknownNameError, require_at_least
from manicm_ms.policies.configuration import Nested, merged, typed
from manicm_ms.policies.methods import METHODS
from manicm_ms.registry import Registry
from manicm_ms.training.optim import FitConfig

SIZES = ("smoke", "quick", "paper")
"""What a preset may be called the size of: each part says what it means by them."""
CHUNK, TRAINING = "chunk", "training"
"""Sections beside those of a policy: its lengths, and the fields of a preset."""


@dataclass(frozen=True, kw_only=True)
class TeacherPreset(FitConfig):
    """How to train a policy on demonstrations: a size, steps and optimiser.

    What a size means, each encoder, backbone, head and input transform says itself (`sizes`); chunk and parts are the
    method's.

    Attributes:
        size: "smoke", "quick" or "paper".
        ema_power: of the averaged weights, which are the policy in the end where the method averages; see `PowerDecay`.
        ema_max_decay: never keep more than this of the old average.
        precision: used unless the command names another; see `resolve_precision`.
        changes: departures from the method's configuration, nested sections as those of `build_policy`, and `chunk`.
    """

    size: str = "paper"
    ema_power: float = 0.75
    ema_max_decay: float = 0.9999
    precision: str = "auto"
    changes: Nested = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.size not in SIZES:
            raise UnknownNameError("size", self.size, SIZES)

    def configuration(self, method: str) -> dict[str, Any]:
        """Return the nested configuration of this method's policy, and its lengths as the section `chunk`.

        Raises UnknownNameError or ConfigError where the method or something in `changes` does not exist or fit.
        """
        row, changes = METHODS.get(method), dict(self.changes)
        chunk = row.chunk_of(self.size, _lengths(changes.pop(CHUNK, {})))
        return {CHUNK: asdict(chunk), **row.configuration(self.size, changes)}

    def with_changes(self, changes: Nested) -> Self:
        """Return the preset with more departures; the section `training` holds fields of the preset itself.

        Raises:
            UnknownNameError: the preset has no such field.
            ConfigError: a value is of another type or out of range.
        """
        return _with_changes(self, changes)


@dataclass(frozen=True, kw_only=True)
class StudentPreset(FitConfig):
    """How to distil a teacher into a one-step student.

    Attributes:
        objective: name in `DISTILLATIONS`: "consistency", or "public-consistency" for comparison only.
        solver_stride: k, training timesteps that one step of the solver spans.
        ema_decay: share that the target network keeps at each step, in [0, 1).
        draws: random point subsets for which the frozen encoder's features are computed, once each, where the
            teacher reads fewer points than are stored; with the full cloud there is only one.
        nfe: network evaluations of the student when acting: 1, or 4 for a little more precision.
        precision: used unless the command names another; see `resolve_precision`.
    """

    objective: str = "consistency"
    solver_stride: int = 10
    ema_decay: float = 0.95
    draws: int = 4
    nfe: int = 1
    precision: str = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(1, solver_stride=self.solver_stride, draws=self.draws, nfe=self.nfe)
        if not 0 <= self.ema_decay < 1:
            raise ConfigError(f"ema_decay must lie in [0, 1), got {self.ema_decay}")

    def with_changes(self, changes: Nested) -> Self:
        """Return the preset with the fields that the section `training` holds; it has no other section."""
        return _with_changes(self, changes)


Preset = TypeVar("Preset", bound=FitConfig)


def _with_changes(preset: Preset, changes: Nested) -> Preset:
    rest = dict(changes)
    training = rest.pop(TRAINING, {})
    if not isinstance(training, Mapping):
        raise ConfigError(f"{TRAINING} takes keys of its own, as in {TRAINING}.steps; got {training!r}")
    known = [f.name for f in fields(preset) if f.name != "changes"]
    hints = get_type_hints(type(preset))
    for name in training:
        if name not in known:
            raise UnknownNameError("configuration key", f"{TRAINING}.{name}", [f"{TRAINING}.{k}" for k in known])
    values = {name: typed(value, hints[name], f"{TRAINING}.{name}") for name, value in training.items()}
    for one, other in (("steps", "epochs"), ("epochs", "steps")):
        if values.get(one) is not None and other not in values:
            values[other] = None
    if isinstance(preset, TeacherPreset):
        values["changes"] = merged(preset.changes, rest)
    elif rest:
        raise UnknownNameError("configuration key", next(iter(rest)), [TRAINING])
    return replace(preset, **values)


def _lengths(section_: Any) -> Nested:
    if not isinstance(section_, Mapping):
        raise ConfigError(f"{CHUNK} takes keys of its own, as in {CHUNK}.horizon; got {section_!r}")
    return section_


def preset_for(method: str, name: str) -> TeacherPreset:
    """Return the preset called `name` with what the method itself says of the optimiser."""
    return TEACHER_PRESETS.get(name).with_changes({TRAINING: METHODS.get(method).optimizer})


TEACHER_PRESETS: Registry[TeacherPreset] = Registry("teacher preset")
STUDENT_PRESETS: Registry[StudentPreset] = Registry("student preset")

TEACHER_PRESETS.add(
    "quick",  # two minutes on one CPU core: small U-Net, a quarter of the points, hand-relative cloud
    TeacherPreset(
        steps=1500,
        batch_size=64,
        learning_rate=1e-3,
        warmup_steps=100,
        clip_norm=1.0,
        size="quick",
    ),
)
TEACHER_PRESETS.add(
    "smoke",  # some seconds: shows that everything runs, and learns next to nothing
    TeacherPreset(steps=30, batch_size=16, warmup_steps=5, save_every=15, size="smoke"),
)
TEACHER_PRESETS.add(
    "paper",  # DP3's public configuration with the horizon of the ManiCM paper, section 4.1
    TeacherPreset(
        epochs=3000,
        batch_size=128,
        learning_rate=1e-4,
        warmup_steps=500,
        clip_norm=None,
        log_every=100,
        save_every=2000,
        precision="32-true",
    ),
)
STUDENT_PRESETS.add(
    "quick",
    StudentPreset(steps=200, batch_size=64, learning_rate=5e-4, warmup_steps=50, clip_norm=1.0, save_every=100),
)
STUDENT_PRESETS.add("smoke", StudentPreset(steps=20, batch_size=16, warmup_steps=5, draws=1, save_every=10))
STUDENT_PRESETS.add(
    "paper",  # ManiCM, section 4.1
    StudentPreset(
        epochs=3000,
        batch_size=128,
        learning_rate=5e-5,
        warmup_steps=500,
        clip_norm=None,
        log_every=100,
        save_every=2000,
        precision="32-true",
    ),
)
