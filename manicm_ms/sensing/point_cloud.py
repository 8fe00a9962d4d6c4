"""Geometry of point clouds: position image to base frame, crop, farthest-point order, deterministic padding.

One CPU row goes through NumPy and fpsample; a batch on an accelerator goes through torch. Both are exact farthest-point
sampling and deterministic; they differ in the point that they start from (see `farthest_point_order`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

try:
    from fpsample import bucket_fps_kdline_sampling
except ImportError:  # no wheel for this platform: the NumPy loop is exact too, only slower
    bucket_fps_kdline_sampling = None

# Depth of fpsample's bucket tree; 5 is the fastest for a few thousand points and the result does not depend on it.
_BUCKET_TREE_HEIGHT = 5
# Below this many points the plain loop is as fast, and the tree needs a few points a bucket.
_FEW_POINTS = 64


class Box(NamedTuple):
    """An axis-aligned box, metres, in the frame of the cloud it crops."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def raised(self, floor: float) -> Box:
        """Return the same box, cut off below the height `floor`, m."""
        x, y, z = self.low
        return Box((x, y, max(z, floor)), self.high)


def transform(points: Tensor, T_out_in: Tensor) -> Tensor:
    """Map points (..., M, 3) by homogeneous transforms (..., 4, 4) from frame `in` to frame `out`."""
    return points @ T_out_in[..., :3, :3].mT + T_out_in[..., None, :3, 3]


def inside(points: Tensor, box: Box) -> Tensor:
    """Return which points (..., 3) lie strictly inside `box`, (...) bool."""
    low, high = points.new_tensor(box.low), points.new_tensor(box.high)
    return ((points > low) & (points < high)).all(dim=-1)


_HEIGHT_MARGIN = 1e-4  # m: the height test below rounds differently from the full transform


def crop_transformed(
    points: NDArray[np.float32], T_out_in: NDArray[np.float32], box: Box
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Map points (M, 3) to frame `out` and keep those strictly inside `box`: their indices (K,) and xyz (K, 3).

    The same as `transform` and `inside`, but most points, those of the table, are dropped by their height alone.
    """
    height = points @ T_out_in[2, :3] + T_out_in[2, 3]
    near = np.flatnonzero((height > box.low[2] - _HEIGHT_MARGIN) & (height < box.high[2] + _HEIGHT_MARGIN))
    mapped = points[near] @ T_out_in[:3, :3].T + T_out_in[:3, 3]
    low, high = np.array(box.low, np.float32), np.array(box.high, np.float32)
    kept = ((mapped > low) & (mapped < high)).all(axis=1)
    return near[kept], mapped[kept]


def farthest_point_order(xyz: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    """Return the indices of `count` points in farthest-point order.

    Farthest point sampling (Eldar et al. 1997; Qi et al. 2017, PointNet++): each next point is the one
    farthest from all chosen before, so that every prefix of the result is itself an even subsample.
    The first point depends on the cloud alone: fpsample's tree decides it (its `start_idx` counts in the
    tree's order, not the caller's); without fpsample it is point 0.

    Args:
        xyz: (M, 3) float32, metres.
        count: number of points to choose, at most M.
    """
    if bucket_fps_kdline_sampling is None or len(xyz) < _FEW_POINTS:
        return _farthest_point_loop(xyz, count)
    order = bucket_fps_kdline_sampling(xyz, count, h=_BUCKET_TREE_HEIGHT, start_idx=0)
    return order.astype(np.int64)  # fpsample returns uint64, which mixes with int64 into floats


def _farthest_point_loop(xyz: NDArray[np.float32], count: int) -> NDArray[np.int64]:
    order = np.zeros(count, dtype=np.int64)
    distance = np.full(len(xyz), np.inf, dtype=np.float32)
    for k in range(1, count):
        step = xyz - xyz[order[k - 1]]
        np.minimum(distance, np.einsum("mc,mc->m", step, step), out=distance)
        order[k] = distance.argmax()
    return order


def sample_cloud(points: NDArray[np.float32], num_points: int) -> NDArray[np.float32]:
    """Return exactly `num_points` of the points (M, C), C >= 3, in farthest-point order.

    Where M is smaller, the ordered points are repeated cyclically behind themselves: deterministic, and invisible
    to an encoder that pools by maximum. An empty cloud becomes zeros, the frame's origin.
    """
    if len(points) == 0:
        return np.zeros((num_points, points.shape[1]), dtype=np.float32)
    count = min(num_points, len(points))
    order = farthest_point_order(np.ascontiguousarray(points[:, :3]), count)
    return points[np.resize(order, num_points)]


def sample_cloud_batch(points: Tensor, valid: Tensor, num_points: int) -> Tensor:
    """Return what `sample_cloud` returns for each row, on the rows' own device and without a loop over rows.

    Args:
        points: (N, M, C) float32, C >= 3.
        valid: (N, M) bool, which points belong to the cloud.
        num_points: points wanted, P.

    Returns:
        (N, P, C) float32.
    """
    order = _farthest_point_order_batch(points[..., :3], valid, num_points)  # (N, P)
    rank = torch.arange(num_points, device=points.device)
    count = valid.sum(dim=1, keepdim=True).clamp(1, num_points)  # (N, 1)
    order = torch.gather(order, 1, rank.expand(len(points), -1) % count)
    chosen = torch.gather(points, 1, order[..., None].expand(-1, -1, points.shape[-1]))
    return torch.where(valid.any(dim=1)[:, None, None], chosen, torch.zeros_like(chosen))


def _farthest_point_order_batch(xyz: Tensor, valid: Tensor, num_points: int) -> Tensor:
    rows = torch.arange(len(xyz), device=xyz.device)
    order = torch.zeros(len(xyz), num_points, dtype=torch.int64, device=xyz.device)
    # A point outside the cloud is never the farthest one: its distance stays below every real one.
    distance = torch.where(valid, torch.inf, -1.0)
    chosen = valid.to(torch.uint8).argmax(dim=1)  # first valid point of each row
    for k in range(num_points):
        order[:, k] = chosen
        step = xyz - xyz[rows, chosen][:, None]
        distance = torch.minimum(distance, (step * step).sum(dim=-1))
        distance = torch.where(valid, distance, -1.0)
        chosen = distance.argmax(dim=1)
    return order
