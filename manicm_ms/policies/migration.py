"""Checkpoints and training states of format 1, translated to format 2.

Format 1 had one flat section `network`, with fields of the U-Net, the encoder, the cloud's frame and the choice of
points, beside `diffusion` and `consistency`; its tensors lay under `network.`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from manicm_ms.errors import ConfigError
from manicm_ms.policies.configuration import NAME, Nested, at, merged

_PLACES = {
    "down_dims": "backbone.down_dims",
    "resnets_per_stage": "backbone.resnets_per_stage",
    "mid_blocks": "backbone.mid_blocks",
    "kernel_size": "backbone.kernel_size",
    "n_groups": "backbone.n_groups",
    "step_embed_dim": "backbone.step_embed_dim",
    "point_widths": "encoder.point_widths",
    "point_features": "encoder.point_features",
    "state_widths": "encoder.state_widths",
    "cloud_frame": "inputs.cloud_frame.frame",
    "cloud_scale": "inputs.cloud_frame.scale",
    "max_points": "inputs.points.max_points",
    "acting_points": "inputs.points.acting",
    "training_points": "inputs.points.training",
    "min_state_range": "normalizer.min_state_range",
}
"""Field of the section `network` -> its place now."""

_TENSORS = (
    ("network.normalizer.", "normalizer."),
    ("network.encoder.", "encoder."),
    ("network.unet.time_embedding.", "head.backbone.time_embeddings.0."),
    ("network.unet.", "head.backbone."),
)
"""Beginning of a tensor's name -> its beginning now."""


def present_config(config: Nested) -> dict[str, Any]:
    """Return the sections of format 2 for those of format 1; raise ConfigError where these are no such sections."""
    if unknown := sorted(set(config) - {"network", "diffusion", "consistency"}):
        raise ConfigError(f"format 1 has no section {', '.join(unknown)}")
    head = "consistency" if "consistency" in config else "diffusion"
    result: dict[str, Any] = {
        "inputs": {"points": {}, "cloud_frame": {}},
        "normalizer": {},
        "encoder": {NAME: "dp3"},
        "backbone": {NAME: "unet1d"},
        "head": {NAME: head, **config.get("diffusion", {}), **config.get("consistency", {})},
    }
    for key, value in config.get("network", {}).items():
        if key not in _PLACES:
            raise ConfigError(f"the network of format 1 has no field {key}")
        result = merged(result, at(_PLACES[key], value))
    return result


def present_tensor_name(name: str) -> str:
    """Return today's name of a tensor of format 1, whatever module it lies in; any other name as it is."""
    for former, present in _TENSORS:
        before, found, after = name.partition(former)
        if found and (not before or before.endswith(".")):
            return before + present + after
    return name


def present_tensors(tensors: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tensors of format 1 under today's names."""
    return {present_tensor_name(name): value for name, value in tensors.items()}
