"""How depth becomes a point cloud: the one way for simulator, recordings and a real robot."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manicm_ms.errors import CameraError
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.cropped import CroppedPoints, clouds_of
from manicm_ms.sensing.point_cloud import Box, crop_transformed, inside, transform

CLOUD_SIZE = (84, 84)
"""(H, W) of the picture that a depth image is resized to before it becomes points."""


def nearest_pixels(count: int, wanted: int) -> NDArray[np.int64]:
    """Return which of `count` pixels of a row a nearest-neighbour resize to `wanted` pixels takes, (wanted,)."""
    return np.floor((np.arange(wanted) + 0.5) * count / wanted).astype(np.int64)


@lru_cache(maxsize=16)
def _rays(camera: CameraModel, size: tuple[int, int]) -> Tensor:
    """Return the rays (h * w, 3) float32 of the sampled pixels, in camera axes, with z = 1."""
    rows, columns = (nearest_pixels(n, k) for n, k in zip((camera.crop.height, camera.crop.width), size, strict=True))
    y = (rows + camera.crop.top - camera.cy) / camera.fy
    x = (columns + camera.crop.left - camera.cx) / camera.fx
    grid = np.stack([*np.meshgrid(x, y), np.ones(size)], axis=-1)
    return torch.from_numpy(grid.reshape(-1, 3).astype(np.float32))


def depth_to_cloud(
    depth: Tensor,
    camera: CameraModel,
    workspace: Box,
    num_points: int,
    size: tuple[int, int] = CLOUD_SIZE,
    *,
    T_base_camera: Tensor | None = None,
    rgb: Tensor | None = None,
) -> Tensor:
    """Return the clouds that a policy sees, from depth images: the one way for simulator, recordings and a real robot.

    `depth_to_points`, then farthest-point order.

    Args:
        depth: as the other arguments, see `depth_to_points`.
        camera: intrinsics, crop and pose.
        workspace: crop box, robot-base frame, metres.
        num_points: P.
        size: (H, W) that the crop is resized to.
        T_base_camera: (N, 4, 4) float32, a pose for each row.
        rgb: (N, h, w, 3) in [0, 1], appended to xyz.

    Returns:
        (N, P, 3) float32 in the robot-base frame, metres, or (N, P, 6) with rgb; zeros where no point is in the box.

    Raises:
        CameraError: `depth` has not the crop's size.
    """
    points = depth_to_points(depth, camera, workspace, size, T_base_camera=T_base_camera, rgb=rgb)
    return clouds_of(points, num_points)


def depth_to_points(
    depth: Tensor,
    camera: CameraModel,
    workspace: Box,
    size: tuple[int, int] = CLOUD_SIZE,
    *,
    T_base_camera: Tensor | None = None,
    rgb: Tensor | None = None,
) -> CroppedPoints:
    """Return the points within the workspace, from depth images: what clouds and voxel grids are made of.

    Nearest-neighbour resize of the crop (averaging would invent points between surfaces), pinhole model with the
    native intrinsics of the sampled pixels, robot-base frame, workspace box.

    Args:
        depth: (N, h, w) float32, metres along the optical axis, of `camera.crop` at native resolution; 0 = no
            reading.
        camera: intrinsics, crop and pose.
        workspace: crop box, robot-base frame, metres.
        size: (H, W) that the crop is resized to.
        T_base_camera: (N, 4, 4) float32, a pose for each row in OpenCV axes; None takes the camera's.
        rgb: (N, h, w, 3) in [0, 1], appended to xyz.

    Raises:
        CameraError: `depth` has not the crop's size.
    """
    h, w = camera.crop.height, camera.crop.width
    if depth.ndim != 3 or depth.shape[1:] != (h, w):
        raise CameraError(f"depth of the crop must be (N, {h}, {w}), got {tuple(depth.shape)}")
    n, device = len(depth), depth.device
    rows, columns = (torch.from_numpy(nearest_pixels(a, b)).to(device) for a, b in ((h, size[0]), (w, size[1])))
    z = depth[:, rows[:, None], columns].reshape(n, -1)
    xyz = _rays(camera, size).to(device) * z[..., None]  # (N, M, 3)
    colors = None if rgb is None else rgb[:, rows[:, None], columns].reshape(n, -1, 3).to(torch.float32)
    if T_base_camera is None:
        T_base_camera = torch.tensor(camera.T_base_camera, dtype=torch.float32, device=device).expand(n, 4, 4)
    if device.type == "cpu":
        return _points_by_row(xyz, colors, T_base_camera, workspace)
    return _points_together(xyz, colors, T_base_camera, workspace)


def _points_by_row(xyz: Tensor, colors: Tensor | None, T: Tensor, workspace: Box) -> CroppedPoints:
    """Return the cropped ones of points (N, M, 3) in camera axes: a row at a time, the quick way on a CPU."""
    rows = []
    for k in range(len(xyz)):
        camera_points = xyz[k].numpy()
        read = np.flatnonzero(camera_points[:, 2])
        index, points = crop_transformed(camera_points[read], T[k].numpy(), workspace)
        if colors is not None:
            points = np.concatenate([points, colors[k].numpy()[read[index]]], axis=1)
        rows.append(points)
    return CroppedPoints.of_rows(rows)


def _points_together(xyz: Tensor, colors: Tensor | None, T: Tensor, workspace: Box) -> CroppedPoints:
    """Return the same without a loop over rows, for a device."""
    base = transform(xyz, T)
    points = base if colors is None else torch.cat([base, colors], dim=-1)
    return CroppedPoints(points, (xyz[..., 2] > 0) & inside(base, workspace))
