"""The encoder of voxel grids of Equivariant Diffusion Policy's baseline, and an MLP for proprioception."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from torch import Tensor, nn
from torch.nn.functional import adaptive_max_pool3d, max_pool3d, pad, relu

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.encoders.encoder import ENCODERS, Features, FeatureShape, ObsEncoder
from manicm_ms.policies.encoders.state import frame_features, state_mlp
from manicm_ms.spec import AGENT_POS, VOXEL_GRID, ChunkSpec, EnvSpec

_DIVISOR = 16


class _Layer(NamedTuple):
    """A convolution of the published sequence.

    Attributes:
        width: its channels, in sixteenths of the features.
        narrow: it has no padding, where enough cells are left without.
        pooled: a max-pool follows.
    """

    width: int
    narrow: bool = False
    pooled: bool = False


_LAYERS = (
    _Layer(1, narrow=True, pooled=True), _Layer(2), _Layer(2, pooled=True), _Layer(4, narrow=True),
    _Layer(4, pooled=True), _Layer(8), _Layer(8, pooled=True),
)  # fmt: skip
"""All but the last one, which spans the cells that the last pool leaves."""
_FEWEST, _LAST = 6, 3
"""Cells along a side that the pools before the last one leave at least, and that the last one leaves."""
_LEAST = 6
"""Cells along a side of the smallest grid that is taken."""


class VoxelNet(nn.Module):
    """Eight 3D convolutions (kernel 3, ReLU) with four max-pools between them; grids of any size to a vector.

    The voxel baseline of Wang et al. 2024, Equivariant Diffusion Policy, without the equivariance. On a grid of 58^3
    the sides are 58, 56, 28, 14, 12, 6, 3, 1 as published. On smaller grids a pool that would leave less than 6
    cells leaves 6, and a convolution is padded that would bring a pool there, so that the last stages see as many cells
    as in the published size: 29, 27, 13, 6, 6, 6, 3, 1. What is left in the end is pooled to 3^3.

    Args:
        channels: of a grid, 1 or 4.
        features: n, a multiple of 16.
    """

    def __init__(self, channels: int, features: int) -> None:
        super().__init__()
        widths = [channels, *(features * layer.width // _DIVISOR for layer in _LAYERS), features]
        self.convolutions = nn.ModuleList(nn.Conv3d(a, b, 3) for a, b in itertools.pairwise(widths))

    def forward(self, grid: Tensor) -> Tensor:
        """Return (N, n) of grids (N, C, V, V, V) in [0, 1]."""
        last_pool = max(k for k, layer in enumerate(_LAYERS) if layer.pooled)
        for number, (layer, convolution) in enumerate(zip(_LAYERS, self.convolutions, strict=False)):
            if not (layer.narrow and grid.shape[-1] - 2 >= 2 * _FEWEST):
                grid = pad(grid, (1,) * 6)
            grid = relu(convolution(grid))
            if layer.pooled:
                side = grid.shape[-1]
                grid = _pooled(grid, _LAST if number == last_pool else min(side, max(_FEWEST, side // 2)))
        return relu(self.convolutions[-1](grid)).flatten(1)


def _pooled(grid: Tensor, side: int) -> Tensor:
    """Return the largest values of (N, C, V, V, V) in as many regions along each axis as `side` says."""
    if grid.shape[-1] == side:
        return grid
    return max_pool3d(grid, 2) if grid.shape[-1] == 2 * side else adaptive_max_pool3d(grid, side)


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
