"""Consistency distillation as pure functions: boundary scalings, one solver step back, and the pair that is compared.

The student f(x_t, t) should return one and the same clean action from every point of the teacher's
deterministic path. It is trained on neighbouring points of a coarse grid of times, t_n and t_{n+k}:
the teacher's guess at x0 takes x at t_{n+k} back to t_n, and f of both ends is compared.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.heads.diffusion import Guess
from manicm_ms.registry import Registry

Denoise = Callable[[Tensor, Tensor], Tensor]
"""(x_t (B, ...), t (B,) int64) -> x0 (B, ...): conditioning is closed over."""
Teach = Callable[[Tensor, Tensor], Guess]
"""(x_t (B, ...), t (B,) int64) -> the teacher's x0 and epsilon, each (B, ...)."""

SIGMA_DATA = 0.5
TIMESTEP_SCALING = 10.0


def boundary_scalings(
    t: Tensor, sigma_data: float = SIGMA_DATA, timestep_scaling: float = TIMESTEP_SCALING
) -> tuple[Tensor, Tensor]:
    """Return c_skip and c_out of f(x, t) = c_skip(t) x + c_out(t) F(x, t), which make f(x, 0) = x.

    c_skip = sigma^2 / ((beta t)^2 + sigma^2), c_out = beta t / sqrt((beta t)^2 + sigma^2)
    (Gao, Lu et al., ManiCM, equation 2; Luo et al. 2023, Latent Consistency Models).

    Args:
        t: (B,) times in training steps.
        sigma_data: sigma, balance value.
        timestep_scaling: beta.

    Returns:
        Two (B,) float32 tensors.
    """
    scaled = timestep_scaling * t.float()
    power = scaled**2 + sigma_data**2
    return sigma_data**2 / power, scaled / power.sqrt()


SPACINGS: Registry[Callable[[int, int], Tensor]] = Registry("timestep_spacing")
"""name (diffusers' words) -> (T, K) -> ascending times (int64) that a student is trained on and starts from."""


@SPACINGS.register("trailing")
def trailing(num_train_timesteps: int, num_solver_steps: int) -> Tensor:
    """Return K times up to the last one, T - 1: 9, 19, ..., 99 for 10 of 100."""
    return torch.arange(1, num_solver_steps + 1) * (num_train_timesteps // num_solver_steps) - 1


@SPACINGS.register("leading")
def leading(num_train_timesteps: int, num_solver_steps: int) -> Tensor:
    """Return the K - 1 times of the teacher's DDIM of K steps, 10, 20, ..., 90 for 10 of 100.

    Its last time, 0, is left out: there the student returns its input, by the boundary condition.
    """
    if num_solver_steps < 2:
        raise ConfigError("timestep_spacing 'leading' needs num_solver_steps of at least 2")
    return torch.arange(1, num_solver_steps) * (num_train_timesteps // num_solver_steps)


def solver_timesteps(
    num_train_timesteps: int = 100, num_solver_steps: int = 10, timestep_spacing: str = "trailing"
) -> Tensor:
    """Return the ascending grid (int64) of times on which a student is trained; see `SPACINGS`.

    Raises ConfigError unless the second number divides the first.
    """
    if num_solver_steps < 1 or num_train_timesteps % num_solver_steps:
        raise ConfigError(
            f"num_solver_steps={num_solver_steps} must divide num_train_timesteps={num_train_timesteps}: try 10 of 100"
        )
    return SPACINGS.get(timestep_spacing)(num_train_timesteps, num_solver_steps)


def ddim_step(guess: Guess, alpha_bar_prev: Tensor) -> Tensor:
    """Return x at the previous time of the path by DDIM (Song et al. 2021, equation 12, sigma = 0).

    x_prev = sqrt(abar_prev) x0 + sqrt(1 - abar_prev) epsilon.

    Args:
        guess: the teacher's clean actions and noise, each (B, ...).
        alpha_bar_prev: broadcastable, at the time gone to.
    """
    return alpha_bar_prev.sqrt() * guess.x0 + (1 - alpha_bar_prev).sqrt() * guess.epsilon


def public_solver_step(x0: Tensor, alpha_bar_prev: Tensor) -> Tensor:
    """Return the "previous x" of the public ManiCM code, for comparison only.

    There the network's clean action goes where the solver expects noise, so that
    x_prev = (sqrt(abar_prev) + sqrt(1 - abar_prev)) x0: x_t has no part in it, and the path collapses
    onto the teacher's mean guess. `alpha_bar_prev` as for `ddim_step`.
    """
    return (alpha_bar_prev.sqrt() + (1 - alpha_bar_prev).sqrt()) * x0


class ConsistencySolver(ABC):
    """One step back along the teacher's path, on the grid of `solver_timesteps`, which has N points.

    Args:
        alphas_cumprod: (T,) cumulative products of the alphas.
        num_solver_steps: K, steps of the grid.
        final_alpha_bar: alpha_bar at the end of the path, where the first grid point steps to.
        timestep_spacing: of the grid, a name in `SPACINGS`.

    Attributes:
        timesteps: (N,) int64, ascending.
        timesteps_prev: (N,) int64, where each grid point steps to; 0 for the first.
        alpha_bar: (N,) at `timesteps`.
        alpha_bar_prev: (N,) at `timesteps_prev`, but `final_alpha_bar` for the first.
    """

    def __init__(
        self, alphas_cumprod: Tensor, num_solver_steps: int, final_alpha_bar: float, timestep_spacing: str
    ) -> None:
        grid = solver_timesteps(len(alphas_cumprod), num_solver_steps, timestep_spacing).to(alphas_cumprod.device)
        self.timesteps = grid
        self.timesteps_prev = torch.cat([torch.zeros_like(grid[:1]), grid[:-1]])
        self.alpha_bar = alphas_cumprod[grid]
        self.alpha_bar_prev = torch.cat([torch.full_like(self.alpha_bar[:1], final_alpha_bar), self.alpha_bar[:-1]])

    def __len__(self) -> int:
        """Return N, the number of grid points."""
        return len(self.timesteps)

    @abstractmethod
    def previous(self, guess: Guess, index: Tensor) -> Tensor:
        """Return x (B, ...) at the previous grid point.

        Args:
            guess: the teacher's x0 and epsilon, each (B, ...), at times `timesteps[index]`.
            index: (B,) int64 in [0, N).
        """


class CorrectedSolver(ConsistencySolver):
    """DDIM with x0 and epsilon in their places, ending at the clean action itself (alpha_bar = 1).

    Both depart from the public code: the first keeps the modes of a multimodal action apart, the second
    removes noise of standard deviation sqrt(1 - alphas_cumprod[0]) (about 0.025) from the targets.
    """

    def __init__(
        self,
        alphas_cumprod: Tensor,
        num_solver_steps: int = 10,
        final_alpha_bar: float = 1.0,
        timestep_spacing: str = "trailing",
    ) -> None:
        super().__init__(alphas_cumprod, num_solver_steps, final_alpha_bar, timestep_spacing)

    def previous(self, guess: Guess, index: Tensor) -> Tensor:
        """Return x at the previous grid point; see `ddim_step`."""
        return ddim_step(guess, _per_row(self.alpha_bar_prev, index, guess.x0))


class PublicSolver(ConsistencySolver):
    """The public ManiCM code's step, kept for comparison; it ends at alphas_cumprod[0], as that code does."""

    def __init__(
        self,
        alphas_cumprod: Tensor,
        num_solver_steps: int = 10,
        final_alpha_bar: float | None = None,
        timestep_spacing: str = "trailing",
    ) -> None:
        final = float(alphas_cumprod[0]) if final_alpha_bar is None else final_alpha_bar
        super().__init__(alphas_cumprod, num_solver_steps, final, timestep_spacing)

    def previous(self, guess: Guess, index: Tensor) -> Tensor:
        """Return x at the previous grid point; see `public_solver_step`."""
        return public_solver_step(guess.x0, _per_row(self.alpha_bar_prev, index, guess.x0))


def consistency_pair(
    solver: ConsistencySolver, teacher: Teach, online: Denoise, target: Denoise, x_t: Tensor, index: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the two clean actions that consistency distillation makes agree (ManiCM, equation 3).

    Args:
        solver: grid and step back.
        teacher: the frozen teacher's x0 and epsilon.
        online: the student f being trained, boundary scalings included.
        target: its moving average, boundary scalings included.
        x_t: (B, ...) demonstrated actions with noise of times `solver.timesteps[index]` added.
        index: (B,) int64 in [0, N).

    Returns:
        f(x_t, t), with gradient, and the target's f(x_prev, t_prev), without; each (B, ...).
    """
    t, t_prev = solver.timesteps[index], solver.timesteps_prev[index]
    prediction = online(x_t, t)
    with torch.no_grad():
        x_prev = solver.previous(teacher(x_t, t), index)
        wanted = target(x_prev, t_prev)
    return prediction, wanted


def _per_row(values: Tensor, index: Tensor, like: Tensor) -> Tensor:
    return values[index].reshape(-1, *[1] * (like.dim() - 1))
