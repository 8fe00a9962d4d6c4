"""The head of UCA-Flow (arXiv:2608.16153): an average velocity that is learnt beside the velocity itself."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.heads.average_velocity import AverageVelocityConfig, AverageVelocityHead, over_chunks
from manicm_ms.policies.heads.head import HEADS


@dataclass(frozen=True)
class UCAFlowConfig(AverageVelocityConfig):
    """Times, weights and sampling; no share of a batch is made r = t, because the second part of the loss is that."""

    equal_share: float = 0.0


@HEADS.register("uca_flow")
class UCAFlowHead(AverageVelocityHead):
    """Learns u(z, t, h) over an interval of length h = t - r, and the velocity u(z, t, 0), from the same actions.

    V = u + h sg(du/dt), the derivative taken at (z, t, h) along (u(z, t, 0), 1, 1): r is fixed, so that h grows with t.
    The loss is rho(V - v) + rho(u(z, t, 0) - v), rho the adaptive weight. The gradient of the first part goes through
    u alone, that of the second through u(z, t, 0).
    """

    Config = UCAFlowConfig
    config: UCAFlowConfig

    def times_of(self, r: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return t and h = t - r."""
        return t, t - r

    def loss(self, features: Features, action: Tensor, generator: torch.Generator) -> Tensor:
        """Return both parts, one to one; see `TrainableHead.loss`."""
        path = self.drawn_path(action, generator)
        own = self.velocity(path.z, path.t, path.t, features)
        u, du_dt, _ = self.derivative(path, own.detach(), features)
        implied = u + over_chunks(path.t - path.r) * du_dt
        return self.weighted(implied - path.v) + self.weighted(own - path.v)
