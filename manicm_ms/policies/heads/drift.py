"""The drifting head: noise to actions in one evaluation, without teacher and without times (DBP, arXiv:2604.03540)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import mse_loss

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.backbones.backbone import Backbone
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.heads.drift_field import drift_field
from manicm_ms.policies.heads.head import HEADS, State, TrainableHead


@dataclass(frozen=True)
class DriftConfig:
    """How samples are compared with demonstrations.

    Attributes:
        samples: G, chunks that are made for each observation in training; they repel one another, so at least 2.
        temperatures: reach of attraction and repulsion, each in mean distances; their forces add up.
    """

    samples: int = 4
    temperatures: tuple[float, ...] = (0.02, 0.05, 0.2)

    def __post_init__(self) -> None:
        require_at_least(2, samples=self.samples)
        if not self.temperatures or min(self.temperatures) <= 0:
            raise ConfigError(f"temperatures must be above 0, one or several, got {self.temperatures}")


@HEADS.register("drift")
class DriftHead(TrainableHead):
    """A chunk is f(noise, observation); training moves samples along the drift field, which vanishes at the data's law.

    Args:
        config: samples and temperatures.
        backbone: f, which gets no time.
        chunk: To, Tp, Ta.
        action_dim: Da.
        features: sizes of the observation's features.
    """

    Config = DriftConfig
    needs_backbone = True
    times = 0
    config: DriftConfig
    backbone: Backbone

    @property
    def nfe(self) -> int:
        """One."""
        return 1

    def generate(self, features: Features, noise: Tensor) -> Tensor:
        """Return normalised chunks (B, Tp, Da) made of noise (B, Tp, Da) and the features of B rows."""
        return self.backbone(noise, (), features).to(noise.dtype)

    def loss(self, features: Features, action: Tensor, generator: torch.Generator) -> Tensor:
        """Return the mean of |a - sg(a + drift)|^2 over the samples a, in units of the field; see `TrainableHead.loss`.

        Its value is the field's mean square, which does not fall as the samples get better: every force is divided
        by its root mean square. Its gradient is what moves them.
        """
        rows, count = len(action), self.config.samples
        noise = torch.randn(
            (rows * count, *action.shape[1:]), generator=generator, device=action.device, dtype=action.dtype
        )
        repeated = features.changed(lambda part: part.repeat_interleave(count, dim=0))
        made = self.generate(repeated, noise).reshape(rows, count, -1)  # (B, G, Tp Da)
        now = made.detach()
        field, unit = drift_field(now, now, action.flatten(1)[:, None], self.config.temperatures)
        return mse_loss(made / unit, now / unit + field)

    def act(self, features: Features, noise: tuple[Tensor, ...], state: State | None) -> tuple[Tensor, State | None]:
        """Choose chunks by `generate`; see `ActionHead.act`."""
        del state
        return self.generate(features, noise[0]), None
