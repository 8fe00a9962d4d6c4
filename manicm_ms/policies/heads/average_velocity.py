"""What heads share that learn the average velocity between noise and action, and cross from one to the other in a step.

z_t = (1 - t) x + t e lies between an action x (t = 0) and noise e (t = 1) and moves with the velocity v = e - x. The
network gives the average velocity u(z, r, t) over the times from r to t, so that z_r = z_t - (t - r) u(z_t, r, t)
(Geng et al. 2025, Mean Flows, arXiv:2505.13447).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.backbones.backbone import Backbone
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.heads.head import State, TrainableHead


@dataclass(frozen=True)
class AverageVelocityConfig:
    """Times, weights and sampling of an average velocity.

    Attributes:
        num_inference_steps: network evaluations of one decision: equal steps from time 1 to time 0.
        time_mean: times are the logistic function of Gaussian numbers, this is their mean.
        time_std: and this their standard deviation.
        equal_share: share of a batch in which r is t, where the average velocity is the velocity itself.
        weight_power: an error's weight is 1 / (D + weight_floor)^weight_power, D its mean square; 0 weighs all alike.
        weight_floor: see there.
    """

    num_inference_steps: int = 1
    time_mean: float = -0.4
    time_std: float = 1.0
    equal_share: float = 0.5
    weight_power: float = 0.5
    weight_floor: float = 1e-3

    def __post_init__(self) -> None:
        require_at_least(1, num_inference_steps=self.num_inference_steps)
        if not 0 <= self.equal_share <= 1:
            raise ConfigError(f"equal_share must lie between 0 and 1, got {self.equal_share}")
        if not (self.time_std > 0 and self.weight_floor > 0 and self.weight_power >= 0):
            raise ConfigError(
                "time_std and weight_floor must be above 0 and weight_power not below, got "
                f"{self.time_std}, {self.weight_floor}, {self.weight_power}"
            )


class Path(NamedTuple):
    """Points between noise and actions.

    Attributes:
        z: (B, Tp, Da), where the actions are at t.
        v: (B, Tp, Da), velocity e - x.
        r: (B,) in [0, 1], start of the interval.
        t: (B,) in [0, 1], its end, at or after r.
    """

    z: Tensor
    v: Tensor
    r: Tensor
    t: Tensor


class Derivative(NamedTuple):
    """The average velocity and how it changes along a path.

    Attributes:
        u: (B, Tp, Da), with the gradient of the weights.
        du_dt: (B, Tp, Da), detached.
        stages: outputs of the backbone's `taps`.
    """

    u: Tensor
    du_dt: Tensor
    stages: dict[str, Tensor]


class AverageVelocityHead(TrainableHead):
    """Crosses from noise to actions by the average velocity, in one evaluation or in several.

    Args:
        config: times, weights, sampling.
        backbone: gives u from z, two times and the features.
        chunk: To, Tp, Ta.
        action_dim: Da.
        features: sizes of the observation's features.

    Attributes:
        taps: stages of the backbone whose outputs the loss reads.
    """

    needs_backbone = True
    nfe_field = "num_inference_steps"
    times = 2
    config: AverageVelocityConfig
    backbone: Backbone
    taps: tuple[str, ...] = ()

    @abstractmethod
    def times_of(self, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return the two times (B,) that the backbone is told of the interval from r to t, (B,) each."""

    @property
    def nfe(self) -> int:
        """Number of steps from noise to actions."""
        return self.config.num_inference_steps

    def velocity(self, z: Tensor, r: Tensor, t: Tensor, features: Features) -> Tensor:
        """Return u(z, r, t), (B, Tp, Da), in the precision of z, for z (B, Tp, Da) and times (B,) in [0, 1]."""
        return self.backbone(z, self.times_of(r, t), features).to(z.dtype)

    def derivative(self, path: Path, direction: Tensor, features: Features) -> Derivative:
        """Return u at a path's points and du/dt = (direction dz + dt) u, r being fixed, by one forward-mode product.

        It is computed in the precision of z: autocast does not reach what forward mode wraps (torch 2.13 refuses the
        convolution), and a target of 3 digits would be a poor one.

        Args:
            path: z, r and t.
            direction: (B, Tp, Da), dz/dt.
            features: of the observations.
        """
        z, _, r, t = path
        precise = features.changed(lambda part: part.to(z.dtype))

        def u(z: Tensor, r: Tensor, t: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
            return self.backbone.tapped(z, self.times_of(r, t), precise, self.taps)

        tangents = (direction, torch.zeros_like(r), torch.ones_like(t))
        with torch.autocast(z.device.type, enabled=False):
            value, du_dt, stages = torch.func.jvp(u, (z, r, t), tangents, has_aux=True)  # type: ignore[misc]
        return Derivative(value, du_dt.detach(), stages)

    def drawn_path(self, action: Tensor, generator: torch.Generator) -> Path:
        """Return random points between random noise and actions (B, Tp, Da), one a row; chance from `generator`."""
        rows, device, dtype = len(action), action.device, action.dtype
        e = torch.randn(action.shape, generator=generator, device=device, dtype=dtype)
        drawn = torch.randn(2, rows, generator=generator, device=device, dtype=dtype)
        two = torch.sigmoid(self.config.time_mean + self.config.time_std * drawn)  # (2, B)
        r, t = two.amin(0), two.amax(0)
        chance = torch.rand(rows, generator=generator, device=device, dtype=dtype)
        r = torch.where(chance < self.config.equal_share, t, r)
        return Path(torch.lerp(action, e, over_chunks(t)), e - action, r, t)

    def weighted(self, error: Tensor) -> Tensor:
        """Return the mean over rows of w D, D the mean square of error (B, Tp, Da) and w = 1 / (D + floor)^power.

        The weight has no gradient: with a power of 0.5 a row counts by about the root of its error.
        """
        squares = error.square().mean((1, 2))  # (B,)
        weights = (squares.detach() + self.config.weight_floor) ** -self.config.weight_power
        return (weights * squares).mean()

    def sample(self, features: Features, noise: Tensor) -> Tensor:
        """Return normalised chunks (B, Tp, Da): with one step x = e - u(e, 0, 1) for noise e (B, Tp, Da)."""
        z, grid = noise, [1 - step / self.nfe for step in range(self.nfe + 1)]
        for end, start in pairwise(grid):
            r, t = (noise.new_full((len(noise),), time) for time in (start, end))
            z = z - (end - start) * self.velocity(z, r, t, features)
        return z

    def act(self, features: Features, noise: tuple[Tensor, ...], state: State | None) -> tuple[Tensor, State | None]:
        """Choose chunks by `sample`; see `ActionHead.act`."""
        del state
        return self.sample(features, noise[0]), None


def over_chunks(value: Tensor) -> Tensor:
    """Return a number a row, (B,), as (B, 1, 1), which multiplies chunks."""
    return value[:, None, None]
