"""The MeanFlow head: one step from noise to actions, learnt from demonstrations alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.backbones.backbone import BACKBONES, Backbone
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.policies.heads.average_velocity import AverageVelocityConfig, AverageVelocityHead, over_chunks
from manicm_ms.policies.heads.head import HEADS
from manicm_ms.registry import Registry
from manicm_ms.spec import ChunkSpec


class Course(NamedTuple):
    """How a target comes about: target = wanted - (t - r) du/dt along `direction`.

    Attributes:
        direction: (B, Tp, Da), dz/dt in the derivative of u.
        wanted: (B, Tp, Da), what stands for the velocity in the target.
    """

    direction: Tensor
    wanted: Tensor


class VelocityTarget(Protocol):
    """What stands for the velocity, which a demonstration gives as e - x alone."""

    def course(self, v: Tensor, own: Callable[[], Tensor]) -> Course:
        """Return direction and wanted velocity.

        Args:
            v: (B, Tp, Da), e - x.
            own: evaluates the network's own velocity u(z, t, t), (B, Tp, Da), without a gradient.
        """


VELOCITY_TARGETS: Registry[type[VelocityTarget]] = Registry("velocity_target")


@VELOCITY_TARGETS.register("plain")
class PlainTarget:
    """The velocity v of the demonstration, as in MeanFlow (arXiv:2505.13447, equation 10)."""

    def course(self, v: Tensor, own: Callable[[], Tensor]) -> Course:
        """Return v twice."""
        del own
        return Course(v, v)


@VELOCITY_TARGETS.register("extrapolated")
class ExtrapolatedTarget:
    """2 v - u(z, t, t), as in MP1's public code (arXiv:2507.10543).

    It is called guidance there; but the call that should know nothing gets the observation as well, so that it
    extrapolates from the network's own velocity beyond the demonstration's.
    """

    def course(self, v: Tensor, own: Callable[[], Tensor]) -> Course:
        """Return 2 v - u(z, t, t) twice."""
        beyond = 2 * v - own()
        return Course(beyond, beyond)


@VELOCITY_TARGETS.register("improved")
class ImprovedTarget:
    """v, with the derivative along u(z, t, t), as in improved MeanFlow (arXiv:2512.02012).

    Its loss regresses u + (t - r) sg(du/dt) on v, which is the same error as that of u to v - (t - r) du/dt. The
    derivative no longer depends on which e - x was drawn, so that the target scatters less.
    """

    def course(self, v: Tensor, own: Callable[[], Tensor]) -> Course:
        """Return u(z, t, t) as the direction and v."""
        return Course(own(), v)


@dataclass(frozen=True)
class MeanFlowConfig(AverageVelocityConfig):
    """MeanFlow's target beside times, weights and sampling.

    Attributes:
        velocity_target: what stands for the velocity, a name in `VELOCITY_TARGETS`.
        dispersive_weight: of `dispersive_loss` on the backbone's stages but the last; 0 leaves it out, MP1 has 0.5.
    """

    velocity_target: str = "plain"
    dispersive_weight: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        VELOCITY_TARGETS.get(self.velocity_target)
        if not self.dispersive_weight >= 0:
            raise ConfigError(f"dispersive_weight must be at least 0, got {self.dispersive_weight}")


@HEADS.register("meanflow")
class MeanFlowHead(AverageVelocityHead):
    """Learns u = v - (t - r) du/dt, the identity that defines an average velocity (Geng et al. 2025).

    Args:
        config: target, times, weights, sampling.
        backbone: gives u from z, the times t and r, and the features.
        chunk: To, Tp, Ta.
        action_dim: Da.
        features: sizes of the observation's features.

    Raises:
        ConfigError: a dispersive loss is asked for, and the backbone lets no two stages be read.
    """

    Config = MeanFlowConfig
    config: MeanFlowConfig

    def __init__(
        self, config: MeanFlowConfig, backbone: Backbone, chunk: ChunkSpec, action_dim: int, features: FeatureShape
    ) -> None:
        super().__init__(config, backbone, chunk, action_dim, features)
        self.target: VelocityTarget = VELOCITY_TARGETS.get(config.velocity_target)()
        if config.dispersive_weight > 0:
            self.taps = _all_but_the_last(backbone)

    def times_of(self, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return t and r."""
        return t, r

    def loss(self, features: Features, action: Tensor, generator: torch.Generator) -> Tensor:
        """Return the weighted error of u to its target, and the dispersive loss; see `TrainableHead.loss`."""
        path = self.drawn_path(action, generator)

        @torch.no_grad()
        def own() -> Tensor:
            return self.velocity(path.z, path.t, path.t, features)

        course = self.target.course(path.v, own)
        u, du_dt, stages = self.derivative(path, course.direction, features)
        loss = self.weighted(u - (course.wanted - over_chunks(path.t - path.r) * du_dt))
        for values in stages.values():
            loss = loss + self.config.dispersive_weight * dispersive_loss(values)
        return loss


def dispersive_loss(values: Tensor) -> Tensor:
    """Return log mean exp(-D_ij) over all pairs of rows, D_ij their squared distance over the largest one.

    It falls where rows part: MP1's regulariser (arXiv:2507.10543), after Wang and He 2025 (arXiv:2506.09027). Pairs of
    a row with itself count, as there, so that it lies between -1 and 0.

    Args:
        values: (B, ...) of B rows.
    """
    rows = len(values)
    squared = torch.pdist(values.float().flatten(1)).square()  # each pair once
    if squared.numel() == 0:
        return squared.sum()  # one row alone
    near = torch.exp(-squared / squared.max().clamp_min(torch.finfo(squared.dtype).tiny))
    return torch.log((2 * near.sum() + rows) / rows**2)


def _all_but_the_last(backbone: Backbone) -> tuple[str, ...]:
    """Return the stages that a dispersive loss reads; raise ConfigError where there are none."""
    if len(backbone.stages) < 2:
        name = BACKBONES.name_of(type(backbone)) or type(backbone).__name__
        raise ConfigError(
            f"dispersive_weight needs a backbone with two stages or more that can be read, and {name} has "
            f"{len(backbone.stages)}: use unet1d with two down_dims, or head.dispersive_weight=0"
        )
    return backbone.stages[:-1]
