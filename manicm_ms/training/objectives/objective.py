"""The interface of objectives: on demonstrations, and on what a teacher says of them."""

from __future__ import annotations

from abc import abstractmethod
from typing import Protocol

from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.methods import METHODS
from manicm_ms.registry import TASKS, Registry
from manicm_ms.training.loop import Objective
from manicm_ms.training.optim import DecayRule


class PolicyObjective(Objective):
    """An objective whose outcome is a policy."""

    @property
    @abstractmethod
    def outcome(self) -> ActionPolicy:
        """What the training has made so far: the policy to act with and to save."""


class OnDemonstrations(Protocol):
    """Makes the objective of a training on demonstrations."""

    def __call__(self, policy: ActionPolicy, decay: DecayRule) -> PolicyObjective:
        """Return the objective.

        Args:
            policy: trained in place, its normalizer fitted.
            decay: of averaged weights, for objectives that have them.
        """


class OnTeacher(Protocol):
    """Makes the objective of a distillation."""

    def __call__(self, teacher: ActionPolicy, student: ActionPolicy, ema_decay: float) -> PolicyObjective:
        """Return the objective.

        Args:
            teacher: frozen.
            student: trained in place; starts from the teacher's weights.
            ema_decay: share that a target network keeps at each step.
        """


OBJECTIVES: Registry[OnDemonstrations] = Registry(
    "objective", package="manicm_ms.training.objectives", group="manicm_ms.methods", outside=TASKS
)
"""name -> objective of a training on demonstrations."""
DISTILLATIONS: Registry[OnTeacher] = Registry(
    "distillation objective", package="manicm_ms.training.objectives", group="manicm_ms.methods", outside=TASKS
)
"""name -> objective of a distillation."""


def trained_methods() -> tuple[str, ...]:
    """Return the names of the methods that learn from demonstrations."""
    known = OBJECTIVES.names()
    return tuple(name for name in METHODS.names() if METHODS.get(name).objective in known)
