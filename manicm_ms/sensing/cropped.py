"""What is observed of the points within a task's crop box, before any of them is chosen: the cloud, the voxel grid.

A simulator, a recording and a real cell all end at the same `CroppedPoints`; each observation that is made of them is
one function here, so that collection, evaluation and every backend give the same.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manicm_ms.registry import Registry
from manicm_ms.sensing.point_cloud import Box, sample_cloud, sample_cloud_batch
from manicm_ms.spec import POINT_CLOUD, VOXEL_GRID, ObsSpec

Sampler = Callable[[NDArray[np.float32], int], NDArray[np.float32]]
"""(points (M, C), P) -> (P, C)."""


class CroppedPoints(NamedTuple):
    """The points of n rows that lie within the crop box.

    Attributes:
        points: (n, M, C) float32, xyz in metres in the cloud's frame, then rgb in [0, 1] where C is 6.
        valid: (n, M) bool, which of them are there: rows may have different numbers.
    """

    points: Tensor
    valid: Tensor

    @classmethod
    def of_rows(cls, rows: Sequence[NDArray[np.float32]]) -> CroppedPoints:
        """Put the points (K, C) of each row together, on the CPU; rows may differ in K."""
        most = max(len(row) for row in rows)
        points = torch.zeros(len(rows), most, rows[0].shape[1])
        valid = torch.zeros(len(rows), most, dtype=torch.bool)
        for k, row in enumerate(rows):
            points[k, : len(row)] = torch.from_numpy(row)
            valid[k, : len(row)] = True
        return cls(points, valid)

    def rows(self) -> list[NDArray[np.float32]]:
        """Return the points (K, C) of each row; for points on the CPU."""
        return [points[valid].numpy() for points, valid in zip(self.points, self.valid, strict=True)]


CroppedObservation = Callable[[CroppedPoints, Box, ObsSpec], Tensor]
"""(points, the task's crop box, sizes) -> (n, ...), the observation of each row."""

CROPPED: Registry[CroppedObservation] = Registry("observation of cropped points")
"""Observation key -> how it is made of the points within the crop box."""


def observe_cropped(keys: Collection[str], cropped: CroppedPoints, box: Box, obs: ObsSpec) -> dict[str, Tensor]:
    """Return those of the observations `keys` that are made of cropped points, each (n, ...)."""
    return {key: CROPPED.get_registered(key)(cropped, box, obs) for key in keys if key in CROPPED.names()}


@CROPPED.register(POINT_CLOUD)
def point_clouds(cropped: CroppedPoints, box: Box, obs: ObsSpec) -> Tensor:
    """Return clouds (n, P, C); see `clouds_of`."""
    return clouds_of(cropped, obs.num_points)


def clouds_of(cropped: CroppedPoints, num_points: int, sampler: Sampler = sample_cloud) -> Tensor:
    """Return clouds (n, P, C) of `num_points` points: on the CPU a row at a time by `sampler`, which is quick there."""
    if cropped.points.device.type == "cpu":
        return torch.stack([torch.from_numpy(sampler(row, num_points)) for row in cropped.rows()])
    return sample_cloud_batch(cropped.points, cropped.valid, num_points)


@CROPPED.register(VOXEL_GRID)
def voxel_grids(cropped: CroppedPoints, box: Box, obs: ObsSpec) -> Tensor:
    """Return voxel grids (n, C, V, V, V) uint8 over the crop box; see `voxel_grid`."""
    return voxel_grid(cropped.points, cropped.valid, box, obs.voxel_size)


def voxel_grid(points: Tensor, valid: Tensor, box: Box, size: int) -> Tensor:
    """Return which cells of a box hold points, and of which colour.

    Cell (i, j, k) spans [low + (i, j, k) d, low + (i + 1, j + 1, k + 1) d) with d the box's sides / V: along each axis
    its own length. What lies outside counts to the nearest cell. A cell's colour is the mean of its points', rounded to
    bytes; sums are of whole numbers, so that neither the points' order nor the device changes a bit of the result.

    Args:
        points: (N, M, C) float32, xyz in metres in the box's frame, then rgb in [0, 1] where C is 6.
        valid: (N, M) bool, which of them are there.
        box: what the grid spans.
        size: V, cells along a side.

    Returns:
        (N, 1, V, V, V) uint8: 255 where a cell holds a point, else 0; with colours (N, 4, V, V, V), r, g and b behind.
    """
    n, cells = len(points), size**3
    low, high = points.new_tensor(box.low), points.new_tensor(box.high)
    place = ((points[..., :3] - low) * (size / (high - low))).floor().clamp(0, size - 1).long()  # (N, M, 3)
    row = torch.arange(n, device=points.device)[:, None]
    flat = ((row * size + place[..., 0]) * size + place[..., 1]) * size + place[..., 2]  # (N, M)
    flat = flat[valid]
    count = torch.bincount(flat, minlength=n * cells)
    channels = [(count > 0) * 255]
    for color in range(3, points.shape[-1]):
        value = (points[..., color][valid] * 255).round().long()
        total = torch.zeros_like(count).index_add_(0, flat, value)
        channels.append((2 * total + count) // (2 * count).clamp_min(1))  # the mean, halves upward
    return torch.stack([c.to(torch.uint8).view(n, size, size, size) for c in channels], dim=1)
