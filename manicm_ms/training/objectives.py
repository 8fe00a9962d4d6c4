"""What teachers and students minimise: the diffusion loss, and consistency distillation."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from manicm_ms.policies.base import Policy
from manicm_ms.policies.consistency import ConsistencySolver, CorrectedSolver, PublicSolver, consistency_pair
from manicm_ms.policies.diffusion import DiffusionPolicy, Guess
from manicm_ms.policies.manicm import ManiCM
from manicm_ms.registry import Registry
from manicm_ms.spec import ACTION
from manicm_ms.training.features import CLEAN_ACTION, COND, draw_points
from manicm_ms.training.loop import Objective
from manicm_ms.training.optim import ConstantDecay, DecayRule, averaged


class PolicyObjective(Objective):
    """An objective whose outcome is a policy."""

    @property
    @abstractmethod
    def outcome(self) -> Policy:
        """What the training has made so far: the policy to act with and to save."""


class DiffusionObjective(PolicyObjective):
    """Denoising loss (Ho et al. 2020, equation 14): E |output(x_t, t, obs) - target|^2 over t, noise and windows.

    The target is x0 or epsilon, as the policy's `prediction_type` has it.

    Args:
        policy: trained in place, its normaliser fitted.
        points: points taken of each cloud in each step, as the network's `training_points` says; None for all.
        decay: of the averaged weights, which are the outcome.
    """

    def __init__(self, policy: DiffusionPolicy, points: int | None, decay: DecayRule) -> None:
        super().__init__()
        self.policy, self.points = policy, points
        self.average = averaged(policy, decay)

    def forward(self, batch: Mapping[str, Tensor], generator: torch.Generator) -> Tensor:
        """Return the loss of raw windows: `point_cloud`, `agent_pos` and `action` as `Windows.batch` gives them."""
        policy, network = self.policy, self.policy.network
        obs = draw_points(batch, self.points, generator, network.config.training_points)
        x0 = network.normalizer.normalize(ACTION, batch[ACTION])  # (B, Tp, Da)
        epsilon = torch.randn(x0.shape, generator=generator, device=x0.device)
        last = policy.diffusion.num_train_timesteps
        t = torch.randint(last, (len(x0),), generator=generator, device=x0.device)
        x_t = policy.add_noise(x0, epsilon, t)
        output = network.denoise(x_t, t, network.encode(obs)).float()
        return mse_loss(output, policy.prediction.target(x0, epsilon))

    def after_step(self) -> None:
        """Average the weights."""
        self.average.update_parameters(self.policy)

    @property
    def outcome(self) -> DiffusionPolicy:
        """The policy with averaged weights."""
        return cast(DiffusionPolicy, self.average.module)


class Distillation(PolicyObjective):
    """Makes a student agree with its own moving average one solver step further down the teacher's path.

    L = E |f(x_{n+k}, t_{n+k}) - f^-(x_n, t_n)|^2 (Gao, Lu et al., ManiCM, equation 3), with noise added to
    demonstrated actions, x_n from the teacher, and f^- the target network. Only the U-Net is trained: the
    encoder stays the teacher's, so that windows come as features (`FeatureWindows`). The outcome is f, not f^-.

    Args:
        teacher: frozen.
        student: trained in place; starts from the teacher's weights.
        mu: share that the target network keeps at each step.
    """

    constant = ("teacher.",)

    def __init__(self, teacher: DiffusionPolicy, student: ManiCM, mu: float) -> None:
        super().__init__()
        self.teacher = teacher.requires_grad_(False)
        self.student = student
        self.student.network.encoder.requires_grad_(False)
        self.target = averaged(student, ConstantDecay(mu))

    @abstractmethod
    def solver(self) -> ConsistencySolver:
        """Return the grid of times and the step back along the teacher's path."""

    @abstractmethod
    def teach(self, x_t: Tensor, t: Tensor, cond: Tensor) -> Guess:
        """Return what leads the solver, each (B, Tp, Da), for x_t (B, Tp, Da), t (B,), cond (B, F)."""

    def forward(self, batch: Mapping[str, Tensor], generator: torch.Generator) -> Tensor:
        """Return the loss of a batch of `FeatureWindows`."""
        x0, device = batch[CLEAN_ACTION], batch[CLEAN_ACTION].device
        rows, subsets, _ = batch[COND].shape
        subset = torch.randint(subsets, (rows,), generator=generator, device=device)
        cond = batch[COND][torch.arange(rows, device=device), subset]  # (B, F)
        solver, follower = self.solver(), cast(ManiCM, self.target.module)
        index = torch.randint(len(solver), (rows,), generator=generator, device=device)
        epsilon = torch.randn(x0.shape, generator=generator, device=device)
        prediction, wanted = consistency_pair(
            solver,
            teacher=lambda x_t, t: self.teach(x_t, t, cond),
            online=lambda x_t, t: self.student.consistency_function(x_t, t, cond),
            target=lambda x_t, t: follower.consistency_function(x_t, t, cond),
            x_t=self.teacher.add_noise(x0, epsilon, solver.timesteps[index]),
            index=index,
        )
        return mse_loss(prediction, wanted)

    def after_step(self) -> None:
        """Move the target network."""
        self.target.update_parameters(self.student)

    @property
    def outcome(self) -> ManiCM:
        """The student."""
        return self.student


DISTILLATIONS: Registry[type[Distillation]] = Registry("distillation objective")


@DISTILLATIONS.register("consistency")
class ConsistencyDistillation(Distillation):
    """Distillation along the path of the teacher's own DDIM step, down to the clean action itself."""

    def solver(self) -> ConsistencySolver:
        """Return DDIM, ending at alpha_bar = 1."""
        config = self.student.consistency
        return CorrectedSolver(
            self.student.alphas_cumprod, config.num_solver_steps, timestep_spacing=config.timestep_spacing
        )

    def teach(self, x_t: Tensor, t: Tensor, cond: Tensor) -> Guess:
        """Return the teacher's x0, clipped, and the epsilon of its unclipped output, as in its sampling."""
        return self.teacher.guess(x_t, t, cond)


@DISTILLATIONS.register("public-consistency")
class PublicConsistencyDistillation(Distillation):
    """Distillation by the formula of the public ManiCM code, for comparison only.

    It steps with x0 in the place of noise, ends at alphas_cumprod[0] and does not clip; on actions with two
    modes the student keeps one. The public code also starts from raw, not averaged, teacher weights.
    """

    def solver(self) -> ConsistencySolver:
        """Return the public code's step."""
        config = self.student.consistency
        return PublicSolver(
            self.student.alphas_cumprod, config.num_solver_steps, timestep_spacing=config.timestep_spacing
        )

    def teach(self, x_t: Tensor, t: Tensor, cond: Tensor) -> Guess:
        """Return the teacher's x0 as the network gives it, and its epsilon, which this solver does not use."""
        output, prediction = self.teacher.network.denoise(x_t, t, cond).float(), self.teacher.prediction
        alpha_bar = self.teacher.alphas_cumprod[t][:, None, None]
        return Guess(prediction.x0(output, x_t, alpha_bar), prediction.epsilon(output, x_t, alpha_bar))
