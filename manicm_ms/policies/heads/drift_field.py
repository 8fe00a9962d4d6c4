"""The drift field: where samples are drawn to data and away from one another (Deng et al. 2026, arXiv:2602.04770)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

LEAST_SCALE = 1e-3  # of the mean distance, in normalised actions
LEAST_AFFINITY = 1e-6  # of a product of two soft-maxima: data beyond the reach of every temperature still attract
LEAST_RMS = 1e-6  # of a force: where all points lie on the data it is 0 and stays 0
BEYOND_REACH = 100.0  # mean distances, hundreds of temperatures


class Drift(NamedTuple):
    """A drift and its unit.

    Attributes:
        field: (B, Q, N), the drift of each point in units of `unit`.
        unit: scalar, mean distance over sqrt(N): actions x drift in x / unit.
    """

    field: Tensor
    unit: Tensor


def drift_field(
    points: Tensor,
    samples: Tensor,
    data: Tensor,
    temperatures: Sequence[float],
    self_distance: float = BEYOND_REACH,
) -> Drift:
    """Return the drift of points among samples and data, as DBP's public code has it (arXiv:2604.03540).

    For each observation: let the targets be its samples and its data, d the distances from points to targets over
    their mean s, and for a temperature T

        A_iy = sqrt(max(softmax_y(-d_iy / T) softmax_i(-d_iy / T), 1e-6)),   N = A of the samples, P = A of the data,
        force_i = sum_y P_iy (sum_j N_ij) (y - x_i) - sum_j N_ij (sum_y P_iy) (a_j - x_i)

    in units of s / sqrt(N). Each temperature's force is divided by its root mean square, and they add up. The mean
    distance and the root mean square are those of all B observations together, so that one which is solved drifts less.

    With `self_distance` 0 the field is antisymmetric under exchange of samples and data, and so 0 where they are equal.

    Args:
        points: (B, Q, N), where the field is asked for; Q observed together, as the second softmax runs over them.
        samples: (B, G, N), what the points are repelled by.
        data: (B, P, N), what they are attracted by.
        temperatures: T, in mean distances.
        self_distance: added to the distance of point i to sample i, in mean distances, where points are the samples: a
            sample beyond its own reach is repelled by the others alone.

    Returns:
        The field, detached.
    """
    with torch.no_grad(), torch.autocast(points.device.type, enabled=False):
        targets = torch.cat([samples, data], dim=1)  # (B, G + P, N)
        towards = targets[:, None] - points[:, :, None]  # (B, Q, G + P, N)
        distance = torch.linalg.vector_norm(towards, dim=-1)
        scale = distance.mean().clamp_min(LEAST_SCALE)
        unit = scale / points.shape[-1] ** 0.5
        own = torch.eye(points.shape[1], targets.shape[1], device=points.device, dtype=points.dtype)
        relative = distance / scale + self_distance * own
        field = torch.zeros_like(points)
        for temperature in temperatures:
            force = _force(-relative / temperature, towards / unit, samples.shape[1])
            field = field + force / force.square().mean().sqrt().clamp_min(LEAST_RMS)
        return Drift(field, unit)


def _force(logits: Tensor, towards: Tensor, samples: int) -> Tensor:
    """Return the force (B, Q, N) of one temperature.

    Args:
        logits: (B, Q, G + P), -distance over temperature.
        towards: (B, Q, G + P, N), target less point.
        samples: G, the targets that come first.
    """
    affinity = (logits.softmax(2) * logits.softmax(1)).clamp_min(LEAST_AFFINITY).sqrt()
    repelling, attracting = affinity[:, :, :samples], affinity[:, :, samples:]
    weights = torch.cat(
        [-repelling * attracting.sum(2, keepdim=True), attracting * repelling.sum(2, keepdim=True)], dim=2
    )
    return (weights[..., None] * towards).sum(2)
