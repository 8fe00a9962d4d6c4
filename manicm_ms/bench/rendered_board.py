"""A ChArUco board in a robot's hand, rendered by SAPIEN before a camera whose pose is known."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from manicm_ms.paths import asset
from manicm_ms.sensing.calibration.board import CharucoSpec
from manicm_ms.sensing.calibration.hand_eye import Pinhole

SUPERSAMPLING = 2
MARGIN_M = 0.012
"""White rim around the pattern."""
TEXTURE_PX_PER_M = 8000

T_OPENCV_SAPIEN = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], dtype=float)  # x forward, y left, z up


def look_at(eye: ArrayLike, target: ArrayLike) -> RigidTransform:
    """Return T_base_camera with OpenCV's axes: z from eye to target (3,), m, y as far down as can be."""
    z = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    return RigidTransform.from_components(eye, Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z])))


def tool_poses(
    camera: RigidTransform, T_tool_board: RigidTransform, spec: CharucoSpec, views: int, seed: int
) -> list[RigidTransform]:
    """Return T_base_tool of views of the whole board from 0.42 to 0.62 m, tilted by up to 35 degrees in any way."""
    rng = np.random.default_rng(seed)
    centre = RigidTransform.from_translation([-spec.size[0] / 2, -spec.size[1] / 2, 0])
    poses = []
    for _ in range(views):
        tilt = rng.uniform(np.deg2rad(12), np.deg2rad(35))
        heading, roll = rng.uniform(0, 2 * np.pi), rng.uniform(-0.6, 0.6)
        turn = Rotation.from_rotvec([tilt * np.cos(heading), tilt * np.sin(heading), 0]) * Rotation.from_rotvec(
            [0, 0, roll]
        )
        distance = rng.uniform(0.42, 0.62)
        at = distance * np.array([rng.uniform(-0.28, 0.28), rng.uniform(-0.12, 0.12), 1.0])
        T_camera_board = RigidTransform.from_components(at, turn) * centre
        poses.append(camera * T_camera_board * T_tool_board.inv())
    return poses


class Studio:
    """A SAPIEN scene with a board and a fixed camera; `picture` moves the board and photographs it.

    The shader is the project's own, which compiles in a tenth of a second; or one of SAPIEN's by name ("default": lit,
    and half a minute to compile on two cores).

    Args:
        spec: the board.
        T_base_camera: pose of the camera, OpenCV's axes.
        intrinsics: of its pictures, pixels.
        size: (width, height) of its pictures, pixels.
        shader: None or a name.
    """

    def __init__(
        self,
        spec: CharucoSpec,
        T_base_camera: RigidTransform,
        intrinsics: Pinhole,
        size: tuple[int, int],
        shader: str | None = None,
    ) -> None:
        import sapien

        self.sapien, self.size = sapien, size
        if shader is None:
            sapien.render.set_picture_format("Color", "r8g8b8a8unorm")
            sapien.render.set_picture_format("CloudPosition", "r32g32b32a32sint")
            shader = str(asset("shaders", "cloud"))
        else:
            sapien.render.set_picture_format("Color", "r32g32b32a32sfloat")
        sapien.render.set_camera_shader_dir(shader)
        self.scene = sapien.Scene()
        self.scene.set_ambient_light([0.5, 0.5, 0.5])
        self.scene.add_directional_light([-0.6, -0.3, -1], [1.2, 1.2, 1.2])
        self.board = self._board(spec)
        self._surroundings()
        width, height = (SUPERSAMPLING * side for side in size)
        self.camera = self.scene.add_camera("camera", width, height, 1.0, 0.05, 5.0)
        # a pixel's centre is at half-integers for SAPIEN and at integers for OpenCV
        centre = (SUPERSAMPLING * (intrinsics.cx + 0.5), SUPERSAMPLING * (intrinsics.cy + 0.5))
        focal = SUPERSAMPLING * intrinsics.fx, SUPERSAMPLING * intrinsics.fy
        self.camera.set_perspective_parameters(0.05, 5.0, *focal, *centre, 0.0)
        turn = T_base_camera.rotation * Rotation.from_matrix(T_OPENCV_SAPIEN)
        self.camera.entity.set_pose(sapien.Pose(T_base_camera.translation, turn.as_quat(scalar_first=True)))

    def picture(self, T_base_board: RigidTransform) -> NDArray[np.uint8]:
        """Return a photograph of the board at this pose, (H, W, 3) uint8, BGR."""
        quaternion = T_base_board.rotation.as_quat(scalar_first=True)
        self.board.set_pose(self.sapien.Pose(T_base_board.translation, quaternion))
        self.scene.update_render()
        self.camera.take_picture()
        rgb = self.camera.get_picture("Color")[..., :3]
        image = rgb if rgb.dtype == np.uint8 else np.clip(np.round(255 * rgb), 0, 255).astype(np.uint8)
        small = cv2.resize(image, self.size, interpolation=cv2.INTER_AREA)
        return cv2.cvtColor(small, cv2.COLOR_RGB2BGR).astype(np.uint8, copy=False)

    def _board(self, spec: CharucoSpec) -> Any:
        render = self.sapien.render
        rim = round(MARGIN_M * TEXTURE_PX_PER_M)
        grey = cv2.copyMakeBorder(spec.picture(TEXTURE_PX_PER_M), rim, rim, rim, rim, cv2.BORDER_CONSTANT, value=255)
        rgba = np.dstack([cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), np.full(grey.shape, 255, np.uint8)])
        material = render.RenderMaterial(base_color=[1, 1, 1, 1], roughness=0.9)
        material.base_color_texture = render.RenderTexture2D(
            rgba, "R8G8B8A8Unorm", mipmap_levels=8, address_mode="edge", srgb=True
        )
        (w, h), m = spec.size, rim / TEXTURE_PX_PER_M
        corners = np.array([[-m, -m, 0], [w + m, -m, 0], [w + m, h + m, 0], [-m, h + m, 0]], np.float32)
        uvs = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        triangles = np.array(
            [[0, 2, 1], [0, 3, 2]], np.uint32
        )  # seen from -z: the board's z points away from the viewer
        normals = np.tile(np.array([0, 0, -1], np.float32), (4, 1))
        body = render.RenderBodyComponent()
        body.attach(render.RenderShapeTriangleMesh(corners, triangles, normals, uvs, material))
        back = render.RenderShapeBox(
            [w / 2 + m, h / 2 + m, 0.003], render.RenderMaterial(base_color=[0.2, 0.2, 0.25, 1])
        )
        back.local_pose = self.sapien.Pose([w / 2, h / 2, 0.004])
        body.attach(back)
        entity = self.sapien.Entity()
        entity.add_component(body)
        self.scene.add_entity(entity)
        return entity

    def _surroundings(self) -> None:
        builder = self.scene.create_actor_builder()
        builder.add_box_visual(half_size=[0.6, 0.6, 0.02], material=[0.45, 0.35, 0.25])
        builder.set_initial_pose(self.sapien.Pose([0.3, 0, -0.02]))
        builder.build_static()
