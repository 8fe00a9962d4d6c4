"""Consistency distillation, by the corrected formula and, for comparison, by that of the public code."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.heads.consistency import ConsistencyHead
from manicm_ms.policies.heads.consistency_solver import (
    ConsistencySolver,
    CorrectedSolver,
    PublicSolver,
    consistency_pair,
)
from manicm_ms.policies.heads.diffusion import DiffusionHead, Guess
from manicm_ms.training.features import CLEAN_ACTION, chosen_features
from manicm_ms.training.objectives.objective import DISTILLATIONS, PolicyObjective
from manicm_ms.training.optim import ConstantDecay, averaged


class Distillation(PolicyObjective):
    """Makes a student agree with its own moving average one solver step further down the teacher's path.

    L = E |f(x_{n+k}, t_{n+k}) - f^-(x_n, t_n)|^2 (Gao, Lu et al., ManiCM, equation 3), with noise added to
    demonstrated actions, x_n from the teacher, and f^- the target network. Only the U-Net is trained: the
    encoder stays the teacher's, so that windows come as features (`FeatureDataset`). The outcome is f, not f^-.

    Args:
        teacher: frozen.
        student: trained in place; starts from the teacher's weights.
        ema_decay: share that the target network keeps at each step.
    """

    constant = ("teacher.",)

    def __init__(self, teacher: ActionPolicy, student: ActionPolicy, ema_decay: float) -> None:
        super().__init__()
        self.teacher = teacher.requires_grad_(False)
        self.student = student
        self.student.encoder.requires_grad_(False)
        self.target = averaged(student, ConstantDecay(ema_decay))

    @abstractmethod
    def solver(self) -> ConsistencySolver:
        """Return the grid of times and the step back along the teacher's path."""

    @abstractmethod
    def teach(self, x_t: Tensor, t: Tensor, features: Features) -> Guess:
        """Return what leads the solver, each (B, Tp, Da), for x_t (B, Tp, Da), t (B,) and the features of B rows."""

    def forward(self, batch: Mapping[str, Tensor], generator: torch.Generator) -> Tensor:
        """Return the loss of a batch of `FeatureDataset`."""
        x0, device = batch[CLEAN_ACTION], batch[CLEAN_ACTION].device
        features = chosen_features(batch, generator)
        solver, student = self.solver(), cast(ConsistencyHead, self.student.head)
        follower = cast(ConsistencyHead, cast(ActionPolicy, self.target.module).head)
        index = torch.randint(len(solver), (len(x0),), generator=generator, device=device)
        epsilon = torch.randn(x0.shape, generator=generator, device=device)
        prediction, wanted = consistency_pair(
            solver,
            teacher=lambda x_t, t: self.teach(x_t, t, features),
            online=lambda x_t, t: student.consistency_function(x_t, t, features),
            target=lambda x_t, t: follower.consistency_function(x_t, t, features),
            x_t=self.teacher_head.add_noise(x0, epsilon, solver.timesteps[index]),
            index=index,
        )
        return mse_loss(prediction, wanted)

    def after_step(self) -> None:
        """Move the target network."""
        self.target.update_parameters(self.student)

    @property
    def teacher_head(self) -> DiffusionHead:
        """The teacher's head."""
        return cast(DiffusionHead, self.teacher.head)

    @property
    def outcome(self) -> ActionPolicy:
        """The student."""
        return self.student


@DISTILLATIONS.register("consistency")
class ConsistencyDistillation(Distillation):
    """Distillation along the path of the teacher's own DDIM step, down to the clean action itself."""

    def solver(self) -> ConsistencySolver:
        """Return DDIM, ending at alpha_bar = 1."""
        return _on_grid_of(CorrectedSolver, self.student)

    def teach(self, x_t: Tensor, t: Tensor, features: Features) -> Guess:
        """Return the teacher's x0, clipped, and the epsilon of its unclipped output, as in its sampling."""
        return self.teacher_head.guess(x_t, t, features)


@DISTILLATIONS.register("public-consistency")
class PublicConsistencyDistillation(Distillation):
    """Distillation by the formula of the public ManiCM code, for comparison only.

    It steps with x0 in the place of noise, ends at alphas_cumprod[0] and does not clip; on actions with two
    modes the student keeps one. The public code also starts from raw, not averaged, teacher weights.
    """

    def solver(self) -> ConsistencySolver:
        """Return the public code's step."""
        return _on_grid_of(PublicSolver, self.student)

    def teach(self, x_t: Tensor, t: Tensor, features: Features) -> Guess:
        """Return the teacher's x0 as the network gives it, and its epsilon, which this solver does not use."""
        return self.teacher_head.raw_guess(x_t, t, features)


def _on_grid_of(solver: type[CorrectedSolver] | type[PublicSolver], student: ActionPolicy) -> ConsistencySolver:
    """Return a solver on the grid of times on which the student is defined."""
    head = cast(ConsistencyHead, student.head)
    return solver(head.alphas_cumprod, head.config.num_solver_steps, timestep_spacing=head.config.timestep_spacing)
