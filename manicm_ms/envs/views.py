"""From rendered pictures to the observation of a frame: as an ideal camera sees, or as the cell's depth camera."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manicm_ms.envs.cameras import CLOUD_POSITION, COLOR, MICROMETRE
from manicm_ms.envs.depth_clouds import DepthClouds
from manicm_ms.envs.lighting import Lamp, relight, tint
from manicm_ms.envs.simulator import SimulatorConfig
from manicm_ms.envs.ur3e_tabletop import UR3eTabletopEnv
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.cropped import CROPPED, CroppedPoints, observe_cropped
from manicm_ms.sensing.depth_cloud import nearest_pixels
from manicm_ms.sensing.point_cloud import crop_transformed, inside, transform
from manicm_ms.sensing.realism import RealismRows, believed_poses, true_cameras
from manicm_ms.spec import DEPTH, IMAGE, ObsSpec

CROPPED_KEYS = frozenset(CROPPED.names())
"""Observations that are made of the points within the workspace."""
Pictures = dict[str, Tensor]
"""The cloud shader's pictures by name: `CLOUD_POSITION` (n, h, w, 4) int32, `COLOR` (n, h, w, 4) uint8."""


class View(ABC):
    """Makes clouds, depth and images of n rows from pictures."""

    @abstractmethod
    def needs_color(self, wanted: Sequence[str]) -> bool:
        """Return whether `frame` reads the colour picture for the observation keys `wanted`."""

    @abstractmethod
    def start(self, rows: Tensor, seeds: Sequence[int], values: RealismRows) -> None:
        """Begin episodes in `rows` (k,) with these seeds and sampled values, k of each; the scene stands already."""

    @abstractmethod
    def frame(self, wanted: Sequence[str], pictures: Pictures, steps: Tensor) -> dict[str, Tensor]:
        """Return what is `wanted` of clouds, grids, depth and image, (n, ...); `steps` (n,) since each row's reset."""


class IdealView(View):
    """Exact positions, rendered at the size of the observation.

    Args:
        env: the scene; its camera and base stand still during an episode.
        config: sizes.
        obs: what a frame holds.
    """

    def __init__(self, env: UR3eTabletopEnv, config: SimulatorConfig, obs: ObsSpec) -> None:
        self._env, self._config, self._obs = env, config, obs
        self._T_base_camera: Tensor | None = None  # (n, 4, 4)

    def needs_color(self, wanted: Sequence[str]) -> bool:
        """See `View.needs_color`."""
        return IMAGE in wanted or self._config.colors

    def start(self, rows: Tensor, seeds: Sequence[int], values: RealismRows) -> None:
        """See `View.start`."""
        self._T_base_camera = None

    def frame(self, wanted: Sequence[str], pictures: Pictures, steps: Tensor) -> dict[str, Tensor]:
        """See `View.frame`."""
        position = pictures[CLOUD_POSITION]
        frame: dict[str, Tensor] = {}
        if CROPPED_KEYS.intersection(wanted):
            points = self._points(position, pictures[COLOR] if self._config.colors else None)
            frame |= observe_cropped(wanted, points, self._env.workspace, self._obs)
        if DEPTH in wanted:
            frame[DEPTH] = -position[..., 2] * MICROMETRE
        if IMAGE in wanted:
            frame[IMAGE] = pictures[COLOR][..., :3]
        return frame

    def _points(self, position: Tensor, color: Tensor | None) -> CroppedPoints:
        """Return what of camera-space positions (n, H, W, 4) int32 with rgba (n, H, W, 4) uint8 is in the workspace."""
        if self._T_base_camera is None:
            T_world_camera = self._env._sensors["d435i"].camera.get_model_matrix()
            T_base_world = self._env.agent.robot.pose.inv().to_transformation_matrix()
            self._T_base_camera = (T_base_world @ T_world_camera).float()
        if position.device.type == "cpu":
            return CroppedPoints.of_rows([self._row_points(k, position, color) for k in range(len(position))])
        n = len(position)
        xyz = transform(position[..., :3].reshape(n, -1, 3) * MICROMETRE, self._T_base_camera)
        hit = position[..., 3].reshape(n, -1) != 0  # the background carries segmentation id 0
        points = xyz if color is None else torch.cat([xyz, color[..., :3].reshape(n, -1, 3) / 255.0], dim=-1)
        return CroppedPoints(points, hit & inside(xyz, self._env.workspace))

    def _row_points(self, row: int, position: Tensor, color: Tensor | None) -> NDArray[np.float32]:
        assert self._T_base_camera is not None
        pixels = position[row].reshape(-1, 4).numpy()
        hit = np.flatnonzero(pixels[:, 3])
        xyz = pixels[hit, :3] * np.float32(MICROMETRE)
        index, points = crop_transformed(xyz, self._T_base_camera[row].numpy(), self._env.workspace)
        if color is not None:
            rgb = color[row].reshape(-1, color.shape[-1])[:, :3].numpy()[hit[index]]
            points = np.concatenate([points, rgb / np.float32(255)], axis=1)
        return points


class CameraView(View):
    """What the cell's depth camera and its driver give: native resolution, the camera's errors, the room's light.

    Args:
        env: the scene, built with `camera` as its `camera_model`.
        config: sizes, and the realism whose depth model is applied.
        camera: what the driver believes of the camera.
        obs: what a frame holds.
        device: where pictures are rendered.
    """

    def __init__(
        self,
        env: UR3eTabletopEnv,
        config: SimulatorConfig,
        camera: CameraModel,
        obs: ObsSpec,
        device: torch.device | str,
    ) -> None:
        self._config, self._camera, self._obs = config, camera, obs
        self._box = env.workspace  # of grids: one for all presets, whose floors differ
        workspace = env.workspace.raised(config.realism.crop_floor)
        self._clouds = DepthClouds(
            camera, config.realism.depth, workspace, config.num_points, config.num_rows,
            colors=config.colors, size=config.image_size, device=device,
        )  # fmt: skip
        sampled = zip((camera.crop.height, camera.crop.width), config.image_size, strict=True)
        self._rows, self._columns = (torch.from_numpy(nearest_pixels(a, b)).to(device) for a, b in sampled)
        n = config.num_rows
        self._lamp = Lamp(*(torch.zeros(size, device=device) for size in ((n, 3), (n,), (n, 3))))

    def needs_color(self, wanted: Sequence[str]) -> bool:
        """See `View.needs_color`."""
        return IMAGE in wanted or self._clouds.needs_color

    def start(self, rows: Tensor, seeds: Sequence[int], values: RealismRows) -> None:
        """See `View.start`."""
        cameras = true_cameras(self._camera, values)
        scale = torch.tensor(values["depth_scale_factor"], dtype=torch.float32)
        believed = torch.tensor(believed_poses(cameras, values), dtype=torch.float32)
        self._clouds.start(rows, seeds, scale=scale, T_base_camera=believed)
        if self._config.realism.lighting:
            for mine, fresh in zip(self._lamp, lamp_of(cameras, values), strict=True):
                mine[rows.to(mine.device)] = fresh.to(mine)

    def frame(self, wanted: Sequence[str], pictures: Pictures, steps: Tensor) -> dict[str, Tensor]:
        """See `View.frame`."""
        frame: dict[str, Tensor] = {}
        position, color = pictures[CLOUD_POSITION], pictures.get(COLOR)
        lit = None
        if color is not None and (IMAGE in wanted or self._config.colors):
            lit = self._lit(color[..., :3], position)
        if DEPTH in wanted or CROPPED_KEYS.intersection(wanted):
            depth, points = self._clouds.observe_points(position, steps, color, lit=lit)
            frame[DEPTH] = self._resized(depth)
            frame |= observe_cropped(wanted, points, self._box, self._obs)
        if lit is not None:
            frame[IMAGE] = self._resized(lit)
        return {key: value for key, value in frame.items() if key in wanted}

    def _lit(self, color: Tensor, position: Tensor) -> Tensor:
        return relight(color, position[..., :3].float(), self._lamp) if self._config.realism.lighting else color

    def _resized(self, picture: Tensor) -> Tensor:
        return picture[:, self._rows[:, None], self._columns]


def lamp_of(cameras: Sequence[CameraModel], values: RealismRows) -> Lamp:
    """Return the random lamp of each row in the axes of its position picture (OpenGL: x right, y up, z backward)."""
    azimuth, elevation = values["light_azimuth"], values["light_elevation"]
    up = np.sin(elevation)
    along = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), up], axis=1)
    opengl = np.diag([1.0, -1.0, -1.0])
    direction = [(camera.pose[:3, :3] @ opengl).T @ d for camera, d in zip(cameras, along, strict=True)]
    color = values["light_strength"][:, None] * tint(values["light_temperature"])
    parts: list[Any] = [np.stack(direction), values["light_ambient"], color]
    return Lamp(*(torch.tensor(part, dtype=torch.float32) for part in parts))
