"""What all UR3e tasks share below their own file: table, robot, cameras, proprioception, privileged state."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
import sapien
import torch
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.geometry.rotation_conversions import quaternion_to_matrix
from mani_skill.utils.structs import Actor, Pose
from mani_skill.utils.structs.types import SceneConfig, SimConfig
from torch import Tensor

from manicm_ms.envs.cameras import D435I, WIDE, FixedCamera
from manicm_ms.envs.depth_clouds import sapien_pose
from manicm_ms.envs.maniskill_state import RestorableEnv
from manicm_ms.envs.row_builders import RowBuilders
from manicm_ms.errors import ConfigError
from manicm_ms.robots.limits import quat_rotate
from manicm_ms.robots.ur3e_ag95 import FINGER_JOINTS, UR3eAG95
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.point_cloud import Box
from manicm_ms.sensing.realism import RealismRows, true_cameras
from manicm_ms.spec import ActionSpec, EnvSpec, ObsSpec

CONTROL_HZ, SIM_HZ = 20, 200
ACTION = ActionSpec(
    names=("dx [m]", "dy [m]", "dz [m]", "drx [rad]", "dry [rad]", "drz [rad]", "opening [m]"),
    control_mode="pd_ee_target_delta_pose",
    control_hz=CONTROL_HZ,
)
AGENT_POS_NAMES = (
    "tcp_x [m]", "tcp_y [m]", "tcp_z [m]",
    "tcp_r11", "tcp_r21", "tcp_r31", "tcp_r12", "tcp_r22", "tcp_r32",
    "opening [m]",
)  # fmt: skip
"""TCP position, first two columns of its rotation matrix (continuous, unlike angles), gripper opening."""

TABLE_HALF_SIZE = (0.40, 0.50, 0.02)  # m
TABLE_CENTRE = (0.25, 0.0, -0.02)  # m: the top is z = 0, the height of the robot's base
TABLE_COLOR = (0.55, 0.47, 0.38, 1.0)
SPAWN_CLEARANCE = 3e-4  # m above rest: nothing has to settle, nothing interpenetrates
START_JOINT_NOISE = 0.02  # rad, uniform to either side
STILL_SPEED, STILL_TURN = 0.01, 0.5  # m/s, rad/s: an object that moves no faster stands still

FINGERS_ALONG_X = (-0.452075, -1.507987, 0.854125, -0.916934, -1.570796, -2.022871)
FINGERS_ALONG_Y = (*FINGERS_ALONG_X[:5], -0.452075)
"""Arm joints, rad, with the TCP at (0.30, 0, 0.25) m and the tool down: the fingers close along base x, or along y."""

_SHARED_STATE = {"tcp_pose": 7, "tcp_target_pose": 7, "opening": 1, "arm_qpos": 6, "arm_qvel": 6}
"""Parts of the privileged state that every task has, with their widths: poses, m, rad, rad/s."""


def ur3e_spec(env_id: str, max_episode_steps: int, objects: tuple[str, ...]) -> EnvSpec:
    """Return the spec of a UR3e task whose privileged state holds the poses of `objects`.

    A pose is (x, y, z, qw, qx, qy, qz), metres, in the robot-base frame.
    """
    layout, start = {}, 0
    for name, width in (_SHARED_STATE | {f"{name}_pose": 7 for name in objects}).items():
        layout[name] = (start, start + width)
        start += width
    return EnvSpec(
        env_id=env_id,
        obs=ObsSpec(num_points=512, point_channels=3, agent_pos_dim=len(AGENT_POS_NAMES), frame="robot_base"),
        action=ACTION,
        max_episode_steps=max_episode_steps,
        agent_pos_names=AGENT_POS_NAMES,
        tcp_indices=(0, 1, 2),
        state_layout=layout,
        success_rule="any",
    )


Vector = tuple[float, float, float]


class UR3eTabletopEnv(RestorableEnv):
    """A UR3e with an AG-95 on a table, whose top is z = 0 in each row's world.

    The base stands at the origin, world frame = base frame, unless `reset(options={"reconfigure": True, "realism":
    RealismRows})` draws a table height: then it stands that much lower. Tasks place objects and test success in the
    world; what observations and privileged state tell is in the base frame.

    A task defines `_load_objects`, `_place_objects`, `evaluate` and `reward_terms`, and the class attributes below.

    Args:
        camera_model: a depth camera with its native intrinsics in place of `camera`.
    """

    SUPPORTED_ROBOTS: ClassVar[list[str]] = ["ur3e_ag95"]
    SUPPORTED_REWARD_MODES: ClassVar[tuple[str, ...]] = ("normalized_dense", "dense", "sparse", "none")
    agent: UR3eAG95

    camera: ClassVar[FixedCamera] = D435I
    workspace: ClassVar[Box] = Box((0.15, -0.25, 0.003), (0.50, 0.25, 0.15))
    """Crop of the cloud. Objects never rise above 0.15 m; cutting there keeps the arm from taking their points."""
    start_qpos: ClassVar[tuple[float, ...]]
    """Arm joints at the start of an episode, rad."""
    start_opening: ClassVar[float]
    """Gripper opening at the start, m."""
    table_friction: ClassVar[float] = 0.6
    reward_weights: ClassVar[dict[str, float]]
    """Weight of each named reward term; `reward_terms` returns the terms, each in [0, 1]."""

    realism: RealismRows | None = None
    """Values that the present scene was built with; None in the ideal world."""

    def __init__(
        self, *args: Any, robot_uids: str = "ur3e_ag95", camera_model: CameraModel | None = None, **kwargs: Any
    ) -> None:
        if robot_uids not in self.SUPPORTED_ROBOTS:
            robots = " or ".join(map(repr, self.SUPPORTED_ROBOTS))
            raise ConfigError(
                f"{type(self).__name__} has the robot {robots}, got robot_uids={robot_uids!r}: leave robot_uids out"
            )
        self.camera_model = camera_model
        self.objects: dict[str, Actor] = {}
        self.half_sizes: dict[str, Tensor] = {}
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(
            sim_freq=SIM_HZ,
            control_freq=CONTROL_HZ,
            scene_config=SceneConfig(contact_offset=0.005, solver_position_iterations=15, solver_velocity_iterations=1),
        )

    @property
    def _default_sensor_configs(self) -> list[CameraConfig]:
        if self.camera_model is None:
            return [_camera_config("d435i", self.camera)]
        return [self._model_config("d435i", self.camera_model)]

    def _model_config(self, uid: str, camera: CameraModel) -> CameraConfig:
        """Return the configuration of the camera's crop, with each row's true pose and intrinsics."""
        cameras = [camera] * self.num_envs if self.realism is None else true_cameras(camera, self.realism)
        poses = [sapien_pose(true) for true in cameras]
        raw = torch.tensor(np.stack([np.concatenate([pose.p, pose.q]) for pose in poses]), device=self.device)
        return CameraConfig(
            uid,
            pose=Pose.create(torch.cat([raw[:, :3] + self.base_position, raw[:, 3:]], dim=1)),
            width=camera.crop.width,
            height=camera.crop.height,
            intrinsic=np.stack([true.crop_intrinsic for true in cameras]),
            near=self.camera.near,
            far=self.camera.far,
        )

    @property
    def _default_human_render_camera_configs(self) -> list[CameraConfig]:
        return [_camera_config("wide", WIDE)]

    # ---- scene ------------------------------------------------------------------------------------------------

    @abstractmethod
    def _load_objects(self) -> dict[str, Actor]:
        """Build the task's objects; return them by name, in the order of the privileged state."""

    def _reconfigure(self, options: dict[str, Any] | None = None) -> None:
        self.realism = (options or {}).get("realism")
        self.base_position = torch.zeros(self.num_envs, 3, device=self.device)  # m, of the robot's base in the world
        if self.realism is not None:
            self.base_position[:, 2] = torch.as_tensor(-self.realism["table_height"])
        super()._reconfigure(options or {})

    def _load_agent(self, options: dict[str, Any]) -> None:
        super()._load_agent(options, sapien.Pose())
        if self.realism is not None:
            self._scale_gains(self.realism)

    def _scale_gains(self, realism: RealismRows) -> None:
        """Multiply the gains of each row's drives by its factors; the controllers have set them when they were made."""
        for joint in self.agent.robot.active_joints:
            part = "finger" if joint.name in FINGER_JOINTS else "arm"
            stiffness, damping = realism[f"{part}_stiffness_factor"], realism[f"{part}_damping_factor"]
            for row, drive in enumerate(joint._objs):
                drive.set_drive_properties(
                    drive.stiffness * stiffness[row], drive.damping * damping[row], drive.force_limit, drive.drive_mode
                )

    def _load_scene(self, options: dict[str, Any]) -> None:
        self.half_sizes = {}
        table = self.build_box("table", TABLE_HALF_SIZE, TABLE_COLOR, friction=self.table_friction)
        table.initial_pose = sapien.Pose(TABLE_CENTRE)
        self.table = table.build_static(name="table")
        self.objects = self._load_objects()
        self._require_sizes()

    def build_box(
        self,
        name: str,
        half_size: Vector,
        color: tuple[float, float, float, float],
        *,
        friction: float,
        mass: float | None = None,
    ) -> ActorBuilder | RowBuilders:
        """Return a builder of a box, whose half edges (N, 3), m, then stand in `half_sizes[name]`.

        Args:
            name: of the object.
            half_size: half of each edge, m.
            color: rgba in [0, 1].
            friction: material value; PhysX takes the average of the two touching materials.
            mass: kg; None for a body that never moves.
        """
        centre = (0.0, 0.0, 0.0)
        halves = np.tile(half_size, (self.num_envs, 1))
        if self.realism is not None:
            halves = halves * self.realism[f"{name}.size_factor"][:, None]
        self.half_sizes[name] = torch.tensor(halves, dtype=torch.float32, device=self.device)
        parts = [[(centre, tuple(half))] for half in halves.tolist()]
        return self._row_builders(name, parts, color, friction, mass)

    def build_boxes(
        self,
        name: str,
        parts: Sequence[tuple[Vector, Vector]],
        color: tuple[float, float, float, float],
        *,
        friction: float,
        mass: float | None = None,
    ) -> ActorBuilder | RowBuilders:
        """Return a builder of one body made of boxes: (centre in the body's frame, half of each edge), m.

        The other arguments are those of `build_box`; the mass spreads over the parts by volume. Its size is the same in
        every episode: a task that builds one names it in `EnvEntry.fixed`.
        """
        return self._row_builders(name, [parts] * self.num_envs, color, friction, mass)

    def _row_builders(
        self,
        name: str,
        parts: Sequence[Sequence[tuple[Vector, Vector]]],
        color: tuple[float, float, float, float],
        friction: float,
        mass: float | None,
    ) -> ActorBuilder | RowBuilders:
        """Return a builder with each row's own values, from the parts of each row."""
        if self.realism is None:
            return self._builder(name, parts[0], color, friction, mass)
        frictions = friction * self.realism[f"{name}.friction_factor"]
        masses = (0.0 if mass is None else mass) * self.realism[f"{name}.mass_factor"]
        offsets = self.realism.vectors(*(f"{name}.{channel}" for channel in ("red", "green", "blue")))
        colors = np.concatenate(
            [(np.array(color[:3]) + offsets).clip(0, 1), np.full((len(offsets), 1), color[3])], axis=1
        )
        builders = [
            self._builder(name, row_parts, row_color, row_friction, None if mass is None else row_mass)
            for row_parts, row_color, row_friction, row_mass in zip(
                parts, colors.tolist(), frictions.tolist(), masses.tolist(), strict=True
            )
        ]
        return builders[0] if len(builders) == 1 else RowBuilders(self.scene, builders)

    def _builder(
        self,
        name: str,
        parts: Sequence[tuple[Vector, Vector]],
        color: Sequence[float],
        friction: float,
        mass: float | None,
    ) -> ActorBuilder:
        builder = self.scene.create_actor_builder()
        builder.set_name(name)
        material = sapien.physx.PhysxMaterial(friction, friction, 0.0)
        volume = sum(8.0 * half[0] * half[1] * half[2] for _, half in parts)
        density = 1000.0 if mass is None else mass / volume
        paint = sapien.render.RenderMaterial(base_color=color)
        for centre, half in parts:
            pose = sapien.Pose(centre)
            builder.add_box_collision(pose, half_size=half, material=material, density=density)
            builder.add_box_visual(pose, half_size=half, material=paint)
        # Far apart, so that nothing overlaps before the first episode places it.
        builder.initial_pose = sapien.Pose((0.3, 0.1 * len(self.scene.actors), 0.5))
        return builder

    def _require_sizes(self) -> None:
        """Raise ConfigError where a size was drawn for an object that takes none."""
        for name in self.objects:
            if name not in self.half_sizes and self.realism is not None and f"{name}.size_factor" in self.realism:
                raise ConfigError(
                    f"{name} is not built by build_box, so its size cannot vary: name it in EnvEntry.fixed"
                )

    # ---- episode ----------------------------------------------------------------------------------------------

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """Start new episodes: see ManiSkill's `BaseEnv.reset`."""
        if seed is not None:  # nothing here draws from Gymnasium's generator, but its checker asks for it
            gymnasium.Env.reset(self, seed=int(torch.as_tensor(seed).flatten()[0]))
        return super().reset(seed=seed, options=options)

    @abstractmethod
    def _place_objects(self, rng: np.random.RandomState, count: int) -> None:
        """Set the poses of the objects in the `count` rows that are being reset.

        `rng` draws one value (or array) for each of these rows from the row's own seed: every result has a leading
        axis of length `count`, and an episode depends on nothing but its seed.
        """

    def _initialize_episode(self, env_idx: Tensor, options: dict[str, Any]) -> None:
        with torch.device(self.device):
            count = len(env_idx)
            rng = self._batched_episode_rng[env_idx]
            noise = rng.uniform(-START_JOINT_NOISE, START_JOINT_NOISE, size=6)
            arm = torch.tensor(np.asarray(self.start_qpos) + noise, dtype=torch.float32)  # (count, 6)
            fingers = torch.full((count, 2), self.start_opening / 2)
            self.agent.reset(torch.cat([arm, fingers], dim=1))
            self.agent.robot.set_pose(Pose.create_from_pq(self.base_position[env_idx]))
            self._place_objects(rng, count)

    # ---- observation ------------------------------------------------------------------------------------------

    def agent_pos(self) -> Tensor:
        """Return proprioception (N, 10): see `AGENT_POS_NAMES`."""
        tcp = self.agent.tcp_pose_at_base
        columns = quaternion_to_matrix(tcp[:, 3:])[:, :, :2].mT.flatten(1)  # first column, then second
        return torch.cat([tcp[:, :3], columns, self.agent.opening[:, None]], dim=1)

    def privileged_state(self) -> Tensor:
        """Return what experts and critics may know (N, S), laid out as the spec's `state_layout` says."""
        poses = [self._at_base(actor) for actor in self.objects.values()]
        robot = self.agent
        own = [robot.tcp_pose_at_base, robot.tcp_target_pose, robot.opening[:, None], robot.arm_qpos, robot.arm_qvel]
        return torch.cat(own + poses, dim=1)

    def _get_obs_extra(self, info: dict[str, Any]) -> dict[str, Tensor]:
        extra = {"tcp_pose": self.agent.tcp_pose_at_base, "opening": self.agent.opening}
        if self.obs_mode_struct.use_state:
            extra |= {f"{name}_pose": self._at_base(actor) for name, actor in self.objects.items()}
        return extra

    def _at_base(self, actor: Actor) -> Tensor:
        """Return poses in the base frame (N, 7); the base is never turned."""
        world = actor.pose.raw_pose
        return torch.cat([world[:, :3] - self.base_position, world[:, 3:]], dim=1)

    # ---- reward -----------------------------------------------------------------------------------------------

    @abstractmethod
    def reward_terms(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the named terms (N,), each in [0, 1], under the names of `reward_weights`."""

    def compute_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """Return the weighted sum of the terms (N,); a success earns the sum of all weights."""
        terms = self.reward_terms(info)
        total = sum(weight * terms[name] for name, weight in self.reward_weights.items())
        return torch.where(info["success"], sum(self.reward_weights.values()), total)

    def compute_normalized_dense_reward(self, obs: Any, action: Tensor, info: dict[str, Tensor]) -> Tensor:
        """Return the dense reward divided by its largest value: (N,) in [0, 1]."""
        return self.compute_dense_reward(obs, action, info) / sum(self.reward_weights.values())


def _camera_config(uid: str, camera: FixedCamera) -> CameraConfig:
    height, width = camera.size
    return CameraConfig(
        uid, pose=Pose.create(camera.pose), width=width, height=height, fov=camera.fov, near=camera.near, far=camera.far
    )


def pose_error(actor_pose: Pose, reference: Pose) -> tuple[Tensor, Tensor]:
    """Return how far poses (N,) stand from their references: distance (N,) m, and tilt of the z axis (N,) rad."""
    now, then = actor_pose.raw_pose, reference.raw_pose
    distance = (now[:, :3] - then[:, :3]).norm(dim=1)
    up = now.new_tensor([[0.0, 0.0, 1.0]]).expand(len(now), -1)
    cosine = (quat_rotate(now[:, 3:], up) * quat_rotate(then[:, 3:], up)).sum(dim=1)
    return distance, torch.acos(cosine.clamp(-1, 1))
