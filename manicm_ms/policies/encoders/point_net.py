"""DP3's observation encoder: a per-point MLP, a maximum over points, and an MLP for proprioception."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from torch import Tensor, nn

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.encoders.encoder import ENCODERS, Features, FeatureShape, ObsEncoder
from manicm_ms.policies.encoders.state import frame_features, state_mlp
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, ChunkSpec, EnvSpec


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


@dataclass(frozen=True)
class DP3EncoderConfig:
    """Widths of DP3's encoder.

    Attributes:
        point_widths: of the per-point MLP.
        point_features: of a cloud.
        state_widths: of the proprioception MLP, the last one its features.
    """

    point_widths: tuple[int, ...] = (64, 128, 256)
    point_features: int = 64
    state_widths: tuple[int, ...] = (64, 64)

    def __post_init__(self) -> None:
        if not self.point_widths or not self.state_widths:
            raise ConfigError("point_widths and state_widths need a layer each")
        require_at_least(
            1,
            point_widths=min(self.point_widths),
            point_features=self.point_features,
            state_widths=min(self.state_widths),
        )


@ENCODERS.register("dp3")
class DP3Encoder(ObsEncoder):
    """Encodes To frames: per frame the cloud's features, then proprioception's.

    The vector of a row is that of its frames one after another, and its tokens are the frames'.

    Args:
        config: widths.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta.
    """

    Config = DP3EncoderConfig
    keys = (POINT_CLOUD, AGENT_POS)

    def __init__(self, config: DP3EncoderConfig, spec: EnvSpec, chunk: ChunkSpec) -> None:
        super().__init__(config, spec, chunk)
        self.points = PointNet(spec.obs.point_channels, config.point_widths, config.point_features)
        self.state = state_mlp(spec.obs.agent_pos_dim, config.state_widths)
        width = config.point_features + config.state_widths[-1]
        self.shape = FeatureShape(chunk.n_obs_steps * width, (chunk.n_obs_steps, width))

    def forward(self, obs: Mapping[str, Tensor]) -> Features:
        """Return the features of normalised clouds (B, To, P, C) and proprioception (B, To, D)."""
        cloud, agent_pos = obs[POINT_CLOUD], obs[AGENT_POS]
        cloud_features = self.points(cloud.flatten(0, 1))  # (B To, F)
        state_features = self.state(agent_pos.flatten(0, 1))  # (B To, F')
        return frame_features([cloud_features, state_features], cloud.shape[1])
