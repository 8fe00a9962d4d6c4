"""The Simple DP3 teacher (Ze et al. 2024): narrower stages of one residual block each, 7.5 million parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from manicm_ms.policies.base import POLICIES
from manicm_ms.policies.denoiser import NetworkConfig
from manicm_ms.policies.diffusion import DiffusionPolicy
from manicm_ms.policies.dp3 import diffusion_teacher
from manicm_ms.spec import ChunkSpec, EnvSpec

SIMPLE_DP3_NETWORK = NetworkConfig(down_dims=(128, 256, 384), resnets_per_stage=1, mid_blocks=1)
"""The published shape."""


@POLICIES.register("simple_dp3", tags=("teacher",))
def simple_dp3(config: Mapping[str, Any], spec: EnvSpec, chunk: ChunkSpec) -> DiffusionPolicy:
    """Build Simple DP3; `config` may change fields in its sections `network` and `diffusion`."""
    return diffusion_teacher("simple_dp3", SIMPLE_DP3_NETWORK, config, spec, chunk)
