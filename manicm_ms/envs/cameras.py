"""Cameras of the UR3e cell: the fixed depth camera in front of the table and the wide one for videos."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import sapien
import torch
from mani_skill.render import ShaderConfig
from mani_skill.utils import sapien_utils

from manicm_ms.paths import asset

MICROMETRE = 1e-6
"""Metres per unit of the cloud shader's integer positions."""


@dataclass(frozen=True)
class FixedCamera:
    """A pinhole camera that stands still in the robot-base frame.

    Attributes:
        eye: (x, y, z) of the optical centre, metres.
        target: point that the optical axis meets, metres.
        fov: vertical field of view, radians.
        size: (H, W), pixels.
        near, far: clipping planes, metres.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    size: tuple[int, int]
    near: float = 0.05
    far: float = 3.0

    @property
    def pose(self) -> sapien.Pose:
        """T_base_camera in SAPIEN's camera axes (x forward, y left, z up)."""
        return sapien_utils.look_at(self.eye, self.target).sp

    @property
    def intrinsic(self) -> np.ndarray:
        """(3, 3) pinhole matrix in pixels; pixel centres at half-integers."""
        height, width = self.size
        focal = height / (2 * math.tan(self.fov / 2))
        return np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


D435I = FixedCamera(eye=(0.710, 0.280, 0.432), target=(0.31, 0.0, 0.05), fov=0.75, size=(84, 84))
"""The RealSense D435i of the cell, 0.62 m from the task, at 35 deg azimuth and 38 deg elevation: the view, of those
compared, that loses fewest points of a grasped object. The depth stream's centre crop at 84x84 would span 64 deg;
the crop here keeps the middle 43 deg of it."""

WIDE = FixedCamera(eye=(1.02, 0.48, 0.54), target=(0.20, 0.0, 0.21), fov=0.84, size=(360, 480))
"""Looks at the whole cell, for videos."""


COLOR, CLOUD_POSITION = "Color", "CloudPosition"
"""Names of the cloud shader's pictures: rgba unorm, and camera-space xyz in micrometres with the segmentation id."""


def _split(picture: torch.Tensor) -> dict[str, torch.Tensor]:
    position = picture[..., :3]  # OpenGL camera axes: x right, y up, z backward
    return {"position": position, "depth": -position[..., 2:], "segmentation": picture[..., 3:]}


def set_cloud_formats() -> None:
    """Set the formats of the cloud shader's pictures for the cameras that are built next.

    Formats are process-wide in SAPIEN, and ManiSkill's own shader packs set theirs with each of their cameras.
    """
    sapien.render.set_picture_format(COLOR, "r8g8b8a8unorm")
    sapien.render.set_picture_format(CLOUD_POSITION, "r32g32b32a32sint")


def cloud_shader() -> ShaderConfig:
    """Return the project's shader pack: positions to a micrometre, base colour, segmentation; compiles in 0.1 s.

    The stock packs round positions down to millimetres and take seconds to compile their lighting. Before a camera
    with this shader is built, call `set_cloud_formats`.
    """
    return ShaderConfig(
        shader_pack=str(asset("shaders", "cloud")),
        texture_names={COLOR: ["rgb"], CLOUD_POSITION: ["position", "depth", "segmentation"]},
        texture_transforms={COLOR: lambda color: {"rgb": color[..., :3]}, CLOUD_POSITION: _split},
    )
