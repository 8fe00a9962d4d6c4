"""From the rendered position picture to what a depth camera and its driver would give: depth, noise, cloud."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import sapien
import torch
from torch import Tensor

from manicm_ms.envs.cameras import MICROMETRE
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.cropped import CroppedPoints, clouds_of
from manicm_ms.sensing.depth_cloud import CLOUD_SIZE, depth_to_points
from manicm_ms.sensing.point_cloud import Box
from manicm_ms.sensing.stereo_depth import StereoDepth


class DepthFrame(NamedTuple):
    """What the camera and its driver give of n rows.

    Attributes:
        depth: (n, h, w) float32, metres, of the crop at native resolution; 0 = no reading.
        cloud: (n, P, 3) float32, metres, robot-base frame, or (n, P, 6) with rgb in [0, 1].
    """

    depth: Tensor
    cloud: Tensor


class DepthClouds:
    """Clouds of n rows as a real depth camera would give them; the same points as of its recordings.

    A simulator renders the position picture of `camera.crop` at native resolution (`camera.crop_intrinsic`,
    `sapien_pose(camera)`), calls `start` for the rows that it resets and `observe` for a frame::

        clouds = DepthClouds(camera, StereoDepth(), env.workspace, config.num_points, num_rows=n)
        clouds.start(rows, seeds, scale=..., T_base_camera=...)
        frame = clouds.observe(pictures[CLOUD_POSITION], steps, pictures[COLOR] if clouds.needs_color else None)

    Args:
        camera: what the driver believes of the camera: the calibration.
        noise: the camera's errors; None gives the exact depth, not even rounded to units.
        workspace: crop box, robot-base frame, metres.
        num_points: P.
        num_rows: n.
        colors: append rgb to xyz.
        size: (H, W) that the crop is resized to.
        device: where pictures are rendered.
    """

    def __init__(
        self,
        camera: CameraModel,
        noise: StereoDepth | None,
        workspace: Box,
        num_points: int,
        num_rows: int,
        *,
        colors: bool = False,
        size: tuple[int, int] = CLOUD_SIZE,
        device: torch.device | str = "cpu",
    ) -> None:
        self.camera, self.noise, self.workspace = camera, noise, workspace
        self._num_points, self._size, self._colors = num_points, size, colors
        self._seeds = [0] * num_rows
        self._scale = torch.ones(num_rows, device=device)
        pose = torch.tensor(camera.T_base_camera, dtype=torch.float32, device=device)
        self._T_base_camera = pose.repeat(num_rows, 1, 1)

    @property
    def needs_color(self) -> bool:
        """Whether `observe` wants the colour picture: for coloured clouds, and for dark surfaces that lose readings."""
        return self._colors or (self.noise is not None and self.noise.dark_level > 0 and self.noise.dark_dropout > 0)

    def start(
        self,
        rows: Tensor,
        seeds: Sequence[int],
        *,
        scale: Tensor | None = None,
        T_base_camera: Tensor | None = None,
    ) -> None:
        """Begin episodes in `rows`; the other rows go on.

        Args:
            rows: (k,) int64.
            seeds: (k,) the episodes' seeds.
            scale: (k,) factor on all readings, the camera's scale error in this episode; None = 1.
            T_base_camera: (k, 4, 4) float32, OpenCV axes: the pose that the driver believes, where it differs from the
                camera's file; None takes the file's. (Where the camera really stands is the renderer's business.)
        """
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            self._seeds[row] = int(seed)
        rows = rows.to(self._scale.device)
        self._scale[rows] = 1.0 if scale is None else scale.to(self._scale)
        if T_base_camera is None:
            T_base_camera = torch.tensor(self.camera.T_base_camera)
        self._T_base_camera[rows] = T_base_camera.to(self._T_base_camera)

    def observe(
        self,
        position: Tensor,
        steps: Sequence[int] | Tensor,
        color: Tensor | None = None,
        *,
        lit: Tensor | None = None,
    ) -> DepthFrame:
        """Return depth and clouds of the present pictures; arguments as those of `observe_points`."""
        depth, points = self.observe_points(position, steps, color, lit=lit)
        return DepthFrame(depth, clouds_of(points, self._num_points))

    def observe_points(
        self,
        position: Tensor,
        steps: Sequence[int] | Tensor,
        color: Tensor | None = None,
        *,
        lit: Tensor | None = None,
    ) -> tuple[Tensor, CroppedPoints]:
        """Return depth, as in `DepthFrame`, and the points in the workspace that clouds and grids are made of.

        Args:
            position: (n, h, w, 4) int32: camera-space x, y, z in micrometres (OpenGL axes: z backward) of the crop at
                native resolution, and the segmentation id, 0 where nothing was hit.
            steps: (n,) control steps since each row's reset: the number of the frame, so that the noise of a frame does
                not depend on which frames were asked for before.
            color: (n, h, w, 3 or 4) uint8, of the same pixels, as the camera's own projector lights them; needed where
                `needs_color`.
            lit: (n, h, w, 3) uint8, the same under the room's light: what coloured clouds carry; None takes `color`.
        """
        hit = position[..., 3] != 0
        depth = torch.where(hit, position[..., 2] * -MICROMETRE, 0.0)
        rgb = None if color is None else color[..., :3].to(torch.float32) / 255
        if self.noise is not None:
            frames = steps.tolist() if isinstance(steps, Tensor) else list(steps)
            depth = self.noise.apply(
                depth, self.camera, self._seeds, frames,
                intensity=None if rgb is None else rgb.mean(dim=-1), scale=self._scale,
            )  # fmt: skip
        else:
            depth = depth * self._scale[:, None, None]
        painted = rgb if lit is None else lit.to(torch.float32) / 255
        points = depth_to_points(
            depth, self.camera, self.workspace, self._size,
            T_base_camera=self._T_base_camera, rgb=painted if self._colors else None,
        )  # fmt: skip
        return depth, points


def sapien_pose(camera: CameraModel) -> sapien.Pose:
    """Return the camera's pose in SAPIEN's axes (x forward, y left, z up), robot-base frame."""
    T = camera.pose
    T[:3, :3] = T[:3, :3] @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])  # columns: forward, left, up in OpenCV axes
    return sapien.Pose(T)
