"""What encoders that go frame by frame share: an MLP for proprioception, and frames put together to features."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from manicm_ms.policies.encoders.encoder import Features


def state_mlp(in_features: int, widths: Sequence[int]) -> nn.Sequential:
    """Return DP3's MLP for proprioception: linear layers of these widths, ReLU between them."""
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise((in_features, *widths)):
        layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])  # no activation after the last layer


def frame_features(parts: Sequence[Tensor], n_obs_steps: int) -> Features:
    """Return the features of To frames: each one's parts side by side make its token, all tokens the vector of a row.

    Args:
        parts: (B To, F) each, frames of a row one after another.
        n_obs_steps: To.
    """
    tokens = torch.cat(list(parts), dim=-1).unflatten(0, (-1, n_obs_steps))  # (B, To, F)
    return Features(tokens.flatten(1), tokens)
