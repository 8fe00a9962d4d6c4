"""Methods that a benchmark compares: how each gets its checkpoint, and what it plays with."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich.console import Console

from manicm_ms.benchmark.method_names import MethodName, folder_name, read_name
from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.policies.action_policy import Parts, keys_read, read_parts
from manicm_ms.policies.configuration import parse_overrides
from manicm_ms.policies.methods import METHODS, methods_of, student_name
from manicm_ms.training.optim import FitConfig
from manicm_ms.training.presets import CHUNK, STUDENT_PRESETS, StudentPreset, TeacherPreset, preset_for

if TYPE_CHECKING:
    from manicm_ms.policies.action_policy import ActionPolicy
    from manicm_ms.policies.policy import Policy
    from manicm_ms.spec import EnvSpec

DEFAULT_TEACHER = "simple_dp3"


class Training(NamedTuple):
    """What all methods are trained with.

    Attributes:
        data: store of demonstrations.
        preset: name of the presets of teacher and student.
        seed: of the training.
        device: torch device.
        snapshots: checkpoints to keep on the way.
        console: where progress goes.
        command: for the record.
    """

    data: Path
    preset: str
    seed: int
    device: str
    snapshots: int
    console: Console
    command: str


class Method(ABC):
    """A way to a policy.

    Attributes:
        name: as on the command line.
    """

    name: str

    @property
    def folder(self) -> str:
        """Name of its folder: with its overrides and its teacher's, so that no two ever take one another's."""
        own = folder_name(read_name(self.name))
        return own if self.made_from is None else f"{own}-{self.made_from.folder}"

    @property
    def made_from(self) -> Method | None:
        """The method whose checkpoint this one needs, if any."""
        return None

    @property
    def trains(self) -> bool:
        """Whether it has a checkpoint of its own."""
        return True

    @property
    def owner(self) -> Method:
        """The method whose checkpoint it plays with: itself, or what it is made from where it does not train."""
        return self if self.trains or self.made_from is None else self.made_from

    def preset(self, size: str) -> FitConfig | None:
        """Return the preset called `size` with its overrides; None where it does not train.

        Raises UnknownNameError or ConfigError where an override names no key, or a value does not fit.
        """
        return None

    def reads(self, preset: str, spec: EnvSpec) -> tuple[str, ...]:
        """Return the observations that demonstrations must hold for it: a student's are its teacher's."""
        return () if self.made_from is None else self.made_from.reads(preset, spec)

    @abstractmethod
    def train(self, out: Path, source: Path | None, training: Training) -> None:
        """Write the checkpoint `out`; `source` is that of `made_from`."""

    @abstractmethod
    def load(self, checkpoint: Path, device: str) -> Policy:
        """Return the policy of a checkpoint: its own, or that of `made_from` where it has none."""


@dataclass(frozen=True)
class Trained(Method):
    """What is trained on demonstrations: a row of the table of methods, with all its network evaluations.

    Attributes:
        name: in `METHODS`, with overrides of its configuration, if any, in brackets.
    """

    name: str

    @property
    def row(self) -> str:
        """Its name in `METHODS`."""
        return read_name(self.name).kind

    def preset(self, size: str) -> TeacherPreset:
        """See `Method.preset`."""
        changed = preset_for(self.row, size).with_changes(parse_overrides(read_name(self.name).overrides))
        changed.configuration(self.row)
        return changed

    def reads(self, preset: str, spec: EnvSpec) -> tuple[str, ...]:
        """See `Method.reads`."""
        config = self.preset(preset).configuration(self.row)
        return keys_read({key: value for key, value in config.items() if key != CHUNK}, spec)

    def parts(self) -> Parts:
        """Return the parts of its policy at the published size, with its overrides."""
        config = self.preset("paper").configuration(self.row)
        return read_parts({key: value for key, value in config.items() if key != CHUNK})

    def require_nfe(self, nfe: int) -> None:
        """Raise ConfigError where its network cannot be evaluated `nfe` times a decision."""
        kind, config = self.parts().head
        if kind.nfe_field is not None:
            replace(config, **{kind.nfe_field: nfe})
        elif nfe != (own := METHODS.get(self.row).nfe):
            raise ConfigError(f"{self.name} takes {own} network evaluations a decision and no other number, got {nfe}")

    def train(self, out: Path, source: Path | None, training: Training) -> None:
        """See `Method.train`."""
        from manicm_ms.training.train import train

        train(
            self.row, training.data, out, self.preset(training.preset), device=training.device, seed=training.seed,
            snapshots=training.snapshots, console=training.console, command=training.command,
        )  # fmt: skip

    def load(self, checkpoint: Path, device: str) -> Policy:
        """See `Method.load`."""
        return _load(checkpoint, device)


@dataclass(frozen=True)
class OneStep(Method):
    """The control: a teacher's network evaluated once, without distillation."""

    name: str
    teacher: Trained

    @property
    def made_from(self) -> Method | None:
        """See `Method.made_from`."""
        return self.teacher

    @property
    def trains(self) -> bool:
        """See `Method.trains`."""
        return False

    def train(self, out: Path, source: Path | None, training: Training) -> None:
        """Do nothing: the teacher's checkpoint is its own."""

    def load(self, checkpoint: Path, device: str) -> Policy:
        """See `Method.load`."""
        control = _load(checkpoint, device).one_step()
        if control is None:
            raise ConfigError(f"{self.teacher.name} has no one-step control: it is no diffusion teacher")
        return control


@dataclass(frozen=True)
class Student(Method):
    """A student of one network evaluation, distilled as ManiCM.

    Attributes:
        teacher: what it is distilled from.
    """

    name: str
    teacher: Trained

    @property
    def made_from(self) -> Method | None:
        """See `Method.made_from`."""
        return self.teacher

    def preset(self, size: str) -> StudentPreset:
        """See `Method.preset`."""
        start = replace(STUDENT_PRESETS.get(size), nfe=1)
        return start.with_changes(parse_overrides(read_name(self.name).overrides))

    def require_nfe(self, nfe: int) -> None:
        """Raise ConfigError where its network cannot be evaluated `nfe` times a decision."""
        most = self.teacher.parts().head[1].num_train_timesteps // self.preset("paper").solver_stride
        if not 1 <= nfe <= most:
            raise ConfigError(f"{self.name}: nfe={nfe} must lie between 1 and num_solver_steps={most}")

    def train(self, out: Path, source: Path | None, training: Training) -> None:
        """See `Method.train`."""
        from manicm_ms.training.distill import distill

        assert source is not None
        distill(
            source, training.data, out, self.preset(training.preset), device=training.device, seed=training.seed,
            snapshots=training.snapshots, console=training.console, command=training.command,
        )  # fmt: skip

    def load(self, checkpoint: Path, device: str) -> Policy:
        """See `Method.load`."""
        return _load(checkpoint, device)


@dataclass(frozen=True)
class Steps(Method):
    """Another method's checkpoint with its network evaluated another number of times a decision.

    Attributes:
        method: whose checkpoint it is.
        nfe: network evaluations.
    """

    name: str
    method: Trained | Student
    nfe: int

    @property
    def made_from(self) -> Method | None:
        """See `Method.made_from`."""
        return self.method

    @property
    def folder(self) -> str:
        """See `Method.folder`."""
        return f"{folder_name(read_name(self.name))}-{(self.method.made_from or self.method).folder}"

    @property
    def trains(self) -> bool:
        """See `Method.trains`."""
        return False

    def train(self, out: Path, source: Path | None, training: Training) -> None:
        """Do nothing: the checkpoint is another method's."""

    def load(self, checkpoint: Path, device: str) -> Policy:
        """See `Method.load`."""
        return _load(checkpoint, device).with_nfe(self.nfe)


def _load(checkpoint: Path, device: str) -> ActionPolicy:
    from manicm_ms.policies.checkpoint import load_checkpoint

    return load_checkpoint(checkpoint, device=device)


ONE_STEP = "one_step"


def method_names() -> tuple[str, ...]:
    """Return the names of all methods: what is trained on demonstrations, and what is made of a teacher."""
    from manicm_ms.training.objectives.objective import trained_methods

    return (*trained_methods(), ONE_STEP, *methods_of("student"))


def parse_methods(names: Sequence[str]) -> tuple[Method, ...]:
    """Return the methods of these names, in their order.

    A student is distilled from the one teacher among the names whose student it is. With several, "manicm:dp3" says
    from which, and with none it is the first that its row names.
    A number behind a name is that of network evaluations: "simple_dp3_4" plays with the checkpoint of simple_dp3.
    Brackets hold overrides, as `--set` takes them, separated by semicolons: "simple_dp3[head.prediction_type=epsilon]",
    "manicm[training.solver_stride=20]:dp3[training.steps=3000]".

    Raises:
        UnknownNameError: no such method or teacher.
        ConfigError: none, one named twice, one whose teacher is not clear, or one that cannot be evaluated so often.
    """
    read = [read_name(name) for name in names]
    teachers = [name for name in read if name.kind in methods_of("teacher")]
    if not names or len(set(read)) < len(read):
        raise ConfigError(f"name each method once, of {', '.join(method_names())}; got {', '.join(names) or 'none'}")
    return tuple(_method(name, teachers) for name in read)


_WITH_STEPS = re.compile(r"(?P<kind>\w+)_(?P<nfe>[1-9]\d*)")


def _method(name: MethodName, teachers: Sequence[MethodName]) -> Method:
    known, kind = method_names(), name.kind
    if kind not in known and (steps := _WITH_STEPS.fullmatch(kind)) and steps["kind"] in known:
        return _with_steps(name, steps["kind"], int(steps["nfe"]), teachers)
    if kind not in known:
        raise UnknownNameError("method", kind, known)
    if kind == ONE_STEP:
        if name.overrides:
            raise ConfigError(f"{kind} is not trained, so that nothing of it can be overridden: write {kind!r}")
        return OneStep(str(name), _teacher_of(name, teachers))
    if kind in methods_of("student"):
        return Student(str(name), _teacher_of(name, teachers))
    if name.teacher:
        raise ConfigError(f"{kind} is trained on demonstrations, not made from {name.teacher}: use {kind!r}")
    return Trained(str(name))


def _with_steps(name: MethodName, kind: str, nfe: int, teachers: Sequence[MethodName]) -> Steps:
    method = _method(name._replace(kind=kind), teachers)
    if isinstance(method, OneStep):
        raise ConfigError(f"{kind} is evaluated once a decision: to evaluate a teacher {nfe} times write TEACHER_{nfe}")
    assert isinstance(method, Trained | Student)
    method.require_nfe(nfe)
    return Steps(str(name), method, nfe)


def _teacher_of(name: MethodName, teachers: Sequence[MethodName]) -> Trained:
    """Return what a method is made from: the teacher that it names, or that follows from those named beside it."""
    kind = name.kind
    own = METHODS.get(kind).teachers if kind != ONE_STEP else ()
    likely = [str(t) for t in teachers if kind in (ONE_STEP, student_name(t.kind))]
    if not name.teacher and len(likely) > 1:
        raise ConfigError(f"{kind} of which teacher? write {' or '.join(f'{kind}:{t}' for t in likely)}")
    chosen = read_name(name.teacher or (likely[0] if likely else own[0] if own else DEFAULT_TEACHER))
    possible = methods_of("teacher")
    if chosen.kind not in possible:
        raise UnknownNameError("teacher", chosen.kind, possible)
    if kind not in (ONE_STEP, made := student_name(chosen.kind)):
        raise ConfigError(f"{kind} is the student of {' or '.join(own)}, that of {chosen.kind} is {made}: use {made!r}")
    return Trained(str(chosen))
