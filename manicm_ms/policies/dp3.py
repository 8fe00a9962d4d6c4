"""The DP3 teacher (Ze et al. 2024): a 255-million-parameter U-Net over four actions, conditioned on a point cloud."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from manicm_ms.policies.base import POLICIES, check_sections, updated_config
from manicm_ms.policies.denoiser import ConditionedDenoiser, NetworkConfig
from manicm_ms.policies.diffusion import DiffusionConfig, DiffusionPolicy
from manicm_ms.spec import ChunkSpec, EnvSpec

DP3_NETWORK = NetworkConfig(down_dims=(512, 1024, 2048), resnets_per_stage=2, mid_blocks=2)
"""The published shape."""


@POLICIES.register("dp3", tags=("teacher",))
def dp3(config: Mapping[str, Any], spec: EnvSpec, chunk: ChunkSpec) -> DiffusionPolicy:
    """Build DP3; `config` may change fields in its sections `network` and `diffusion`."""
    return diffusion_teacher("dp3", DP3_NETWORK, config, spec, chunk)


def diffusion_teacher(
    name: str, default: NetworkConfig, config: Mapping[str, Any], spec: EnvSpec, chunk: ChunkSpec
) -> DiffusionPolicy:
    """Build a diffusion policy called `name` whose network is `default` but for what `config` changes.

    Raises ConfigError where a field is unknown or does not fit `spec` or `chunk`.
    """
    check_sections(config, ("network", "diffusion"), name)
    network = updated_config(default, config.get("network", {}), f"the network of {name}")
    diffusion = updated_config(DiffusionConfig(), config.get("diffusion", {}), f"the diffusion process of {name}")
    return DiffusionPolicy(name, ConditionedDenoiser(network, spec, chunk), spec, chunk, diffusion)
