"""Methods that a benchmark compares: how each gets its checkpoint, and what it plays with."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rich.console import Console

from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.policies.methods import methods_of
from manicm_ms.training.presets import CHUNK, STUDENT_PRESETS, preset_for

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
        """Name of its folder: with its teacher's, so that the students of two teachers never take one another's."""
        kind = self.name.partition(":")[0]
        return kind if self.made_from is None else f"{kind}-{self.made_from.name}"

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

    def reads(self, preset: str, spec: EnvSpec) -> tuple[str, ...]:
        """Return the observations that its training reads, where it learns from demonstrations alone."""
        del preset, spec
        return ()

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
        name: in `METHODS`.
    """

    name: str

    def reads(self, preset: str, spec: EnvSpec) -> tuple[str, ...]:
        """See `Method.reads`."""
        from manicm_ms.policies.action_policy import keys_read

        config = preset_for(self.name, preset).configuration(self.name)
        return keys_read({key: value for key, value in config.items() if key != CHUNK}, spec)

    def train(self, out: Path, source: Path | None, training: Training) -> None:
        """See `Method.train`."""
        from manicm_ms.training.train import train

        train(
            self.name, training.data, out, preset_for(self.name, training.preset), device=training.device,
            seed=training.seed, snapshots=training.snapshots, console=training.console, command=training.command,
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
    """A ManiCM student.

    Attributes:
        teacher: what it is distilled from.
        nfe: its network evaluations.
    """

    name: str
    teacher: Trained
    nfe: int

    @property
    def made_from(self) -> Method | None:
        """See `Method.made_from`."""
        return self.teacher

    def train(self, out: Path, source: Path | None, training: Training) -> None:
        """See `Method.train`."""
        from manicm_ms.training.distill import distill

        assert source is not None
        distill(
            source, training.data, out, replace(STUDENT_PRESETS.get(training.preset), nfe=self.nfe),
            device=training.device, seed=training.seed, snapshots=training.snapshots, console=training.console,
            command=training.command,
        )  # fmt: skip

    def load(self, checkpoint: Path, device: str) -> Policy:
        """See `Method.load`."""
        return _load(checkpoint, device)


def _load(checkpoint: Path, device: str) -> ActionPolicy:
    from manicm_ms.policies.checkpoint import load_checkpoint

    return load_checkpoint(checkpoint, device=device)


# name -> (teacher, name) -> method
_MADE_FROM_TEACHER = {
    "one_step": lambda teacher, name: OneStep(name, teacher),
    "manicm": lambda teacher, name: Student(name, teacher, nfe=1),
    "manicm_4": lambda teacher, name: Student(name, teacher, nfe=4),
}


def method_names() -> tuple[str, ...]:
    """Return the names of all methods: what is trained on demonstrations, and what is made of a teacher."""
    from manicm_ms.training.objectives.objective import trained_methods

    return (*trained_methods(), *_MADE_FROM_TEACHER)


def parse_methods(names: Sequence[str]) -> tuple[Method, ...]:
    """Return the methods of these names, in their order.

    "manicm" is distilled from the one teacher among the names, or from simple_dp3 where there is none; with several,
    "manicm:dp3" says from which.

    Raises:
        UnknownNameError: no such method or teacher.
        ConfigError: none, one named twice, or a method whose teacher is not clear.
    """
    teachers = [name for name in names if name in methods_of("teacher")]
    if not names or len(set(names)) < len(names):
        raise ConfigError(f"name each method once, of {', '.join(method_names())}; got {', '.join(names) or 'none'}")
    return tuple(_method(name, teachers) for name in names)


def _method(name: str, teachers: Sequence[str]) -> Method:
    kind, _, teacher = name.partition(":")
    known = method_names()
    if kind not in known:
        raise UnknownNameError("method", name, known)
    if kind not in _MADE_FROM_TEACHER:
        if teacher:
            raise ConfigError(f"{kind} is trained on demonstrations, not made from {teacher}: use {kind!r}")
        return Trained(kind)
    if not teacher and len(teachers) > 1:
        raise ConfigError(f"{kind} of which teacher? write {' or '.join(f'{kind}:{t}' for t in teachers)}")
    chosen = teacher or (teachers[0] if teachers else DEFAULT_TEACHER)
    possible = methods_of("teacher")
    if chosen not in possible:
        raise UnknownNameError("teacher", chosen, possible)
    return _MADE_FROM_TEACHER[kind](Trained(chosen), name)
