"""DP3's observation encoder: a per-point MLP, a maximum over points, and an MLP for proprioception."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn


class PointNet(nn.Module):
    """Encodes a cloud as the maximum over points of a shared MLP's features.

    Linear, LayerNorm and ReLU for each width, the maximum over points, then Linear and LayerNorm
    (Ze et al. 2024, 3D Diffusion Policy, section III-B). The order of the points and repeated points
    do not change the result.

    Args:
        in_channels: C, 3 or 6.
        widths: of the shared MLP.
        out_features: F.
    """

    def __init__(self, in_channels: int, widths: Sequence[int] = (64, 128, 256), out_features: int = 64) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise((in_channels, *widths)):
            layers += [nn.Linear(fan_in, fan_out), nn.LayerNorm(fan_out), nn.ReLU()]
        self.point_mlp = nn.Sequential(*layers)
        self.projection = nn.Sequential(nn.Linear(widths[-1], out_features), nn.LayerNorm(out_features))

    def forward(self, cloud: Tensor) -> Tensor:
        """Return features (N, F) of normalised clouds (N, P, C)."""
        # max, not amax: the gradient of one winner costs half of what sharing it among ties costs.
        return self.projection(self.point_mlp(cloud).max(dim=1).values)


class DP3Encoder(nn.Module):
    """Encodes To frames into one conditioning vector: per frame the cloud's features, then proprioception's.

    Args:
        point_channels: C.
        agent_pos_dim: D.
        n_obs_steps: To.
        point_widths: of the per-point MLP.
        point_features: of each frame's cloud.
        state_widths: of the proprioception MLP; the last one is its output.
    """

    def __init__(
        self,
        point_channels: int,
        agent_pos_dim: int,
        n_obs_steps: int,
        point_widths: Sequence[int] = (64, 128, 256),
        point_features: int = 64,
        state_widths: Sequence[int] = (64, 64),
    ) -> None:
        super().__init__()
        self.points = PointNet(point_channels, point_widths, point_features)
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise((agent_pos_dim, *state_widths)):
            layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
        self.state = nn.Sequential(*layers[:-1])  # no activation after the last layer
        self.out_features = n_obs_steps * (point_features + state_widths[-1])

    def forward(self, cloud: Tensor, agent_pos: Tensor) -> Tensor:
        """Return (B, out_features) for normalised clouds (B, To, P, C) and proprioception (B, To, D)."""
        batch = cloud.shape[0]
        cloud_features = self.points(cloud.flatten(0, 1))  # (B To, F)
        state_features = self.state(agent_pos.flatten(0, 1))  # (B To, F')
        return torch.cat([cloud_features, state_features], dim=-1).reshape(batch, self.out_features)
