"""The encoder of voxel grids of Equivariant Diffusion Policy's baseline, and an MLP for proprioception."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn
from torch.nn.functional import adaptive_max_pool3d, max_pool3d, relu

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.encoders.encoder import ENCODERS, Features, FeatureShape, ObsEncoder
from manicm_ms.policies.encoders.state import frame_features, state_mlp
from manicm_ms.spec import AGENT_POS, VOXEL_GRID, ChunkSpec, EnvSpec

_DIVISOR = 16
_WIDTHS = (1, 2, 2, 4, 4, 8, 8, 16)
"""Channels after each convolution, in sixteenths of the features."""
_POOLED_TO = {0: 6, 2: 6, 4: 6, 6: 3}
"""Convolution that a max-pool follows -> side, cells, below which it does not go; the last one ends there."""
_NARROW = (0, 3, 7)
"""Convolutions without padding."""
_LEAST = 6
"""Cells along a side of the smallest grid that is taken."""


class VoxelNet(nn.Module):
    """Eight 3D convolutions (kernel 3, ReLU) with four max-pools between them; grids of any size to a vector.

    The voxel baseline of Wang et al. 2024, Equivariant Diffusion Policy, without the equivariance. On a grid of 58^3 the
    sides are 58, 56, 28, 14, 12, 6, 3, 1 as published. On smaller grids a pool that would leave less than 6 cells
    is left out, and a convolution that would is padded, so that the last stages see as many cells as there; what is
    left over is pooled to 3^3.

    Args:
        channels: of a grid, 1 or 4.
        features: n, a multiple of 16.
    """

    def __init__(self, channels: int, features: int) -> None:
        super().__init__()
        widths = [channels, *(features * w // _DIVISOR for w in _WIDTHS)]
        self.convolutions = nn.ModuleList(nn.Conv3d(a, b, 3) for a, b in zip(widths, widths[1:], strict=False))

    def forward(self, grid: Tensor) -> Tensor:
        """Return (N, n) of grids (N, C, V, V, V) in [0, 1]."""
        for number, convolution in enumerate(self.convolutions):
            narrow = number in _NARROW and (number != 3 or grid.shape[-1] - 2 >= 2 * _POOLED_TO[4])
            padding = 0 if narrow else 1
            grid = relu(nn.functional.conv3d(grid, convolution.weight, convolution.bias, padding=padding))
            if number in _POOLED_TO:
                grid = _pooled(grid, _POOLED_TO[number], exactly=number == 6)
        return grid.flatten(1)


def _pooled(grid: Tensor, least: int, exactly: bool) -> Tensor:
    """Return a grid of half the side, or of `least` cells where that is more; `exactly` as many in any case."""
    side = grid.shape[-1]
    wanted = least if exactly else max(least, side // 2)
    if wanted == side // 2:
        return max_pool3d(grid, 2)
    return grid if wanted >= side and not exactly else adaptive_max_pool3d(grid, wanted)


@dataclass(frozen=True)
class VoxelEncoderConfig:
    """Widths of the encoder.

    Attributes:
        features: n, of a grid: the convolutions have n/16 to n channels.
        state_widths: of the proprioception MLP, the last one its features.
    """

    features: int = 128
    state_widths: tuple[int, ...] = (64, 64)

    def __post_init__(self) -> None:
        if not self.state_widths:
            raise ConfigError("state_widths needs a layer")
        require_at_least(1, features=self.features, state_widths=min(self.state_widths))
        if self.features % _DIVISOR:
            raise ConfigError(f"features of voxel grids must be a multiple of {_DIVISOR}, got {self.features}")


@ENCODERS.register("voxel")
class VoxelEncoder(ObsEncoder):
    """Encodes To frames: per frame the grid's features, then proprioception's, put together as by DP3's encoder.

    Args:
        config: widths.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta.

    Raises:
        ConfigError: the grids are too small.
    """

    Config = VoxelEncoderConfig
    config: VoxelEncoderConfig
    sizes: ClassVar = {"quick": {"features": 64}, "smoke": {"features": 16}}
    keys = (VOXEL_GRID, AGENT_POS)

    def __init__(self, config: VoxelEncoderConfig, spec: EnvSpec, chunk: ChunkSpec) -> None:
        super().__init__(config, spec, chunk)
        if spec.obs.voxel_size < _LEAST:
            raise ConfigError(f"voxel grids have {spec.obs.voxel_size} cells along a side: {_LEAST} are the least")
        self.grids = VoxelNet(spec.observation(VOXEL_GRID).shape[0], config.features)
        self.state = state_mlp(spec.obs.agent_pos_dim, config.state_widths)
        width = config.features + config.state_widths[-1]
        self.shape = FeatureShape(chunk.n_obs_steps * width, (chunk.n_obs_steps, width))

    def forward(self, obs: Mapping[str, Tensor]) -> Features:
        """Return the features of grids (B, To, C, V, V, V) uint8 and normalised proprioception (B, To, D)."""
        grid, agent_pos = obs[VOXEL_GRID], obs[AGENT_POS]
        seen = self.grids(grid.flatten(0, 1).float() / 255)  # (B To, n)
        return frame_features([seen, self.state(agent_pos.flatten(0, 1))], grid.shape[1])
