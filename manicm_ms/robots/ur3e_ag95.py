"""The UR3e with a DH AG-95 gripper as a ManiSkill agent: joints, keyframes, controllers, what it can tell of itself.

Frames: `base_link` stands on the table with z up and x to the front; the tcp, 182.5 mm beyond the flange, has z
pointing out of the gripper and closes along its x.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, DictControllerConfig, Keyframe
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosControllerConfig
from mani_skill.agents.registration import register_agent
from mani_skill.utils import common
from mani_skill.utils.structs import Actor, Link, Pose
from torch import Tensor

from manicm_ms.paths import asset
from manicm_ms.robots import memory
from manicm_ms.robots.controllers import LimitedPoseControllerConfig, OpeningControllerConfig
from manicm_ms.robots.limits import pose_in_frame

ARM_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
FINGER_JOINTS = ("left_finger_joint", "right_finger_joint")

JOINT_SPEED = (np.pi, np.pi, np.pi, 2 * np.pi, 2 * np.pi, 2 * np.pi)
"""Speed limit of each arm joint, rad/s."""
JOINT_EFFORT = (54.0, 54.0, 28.0, 9.0, 9.0, 9.0)
"""Torque limit of each arm joint, Nm."""
OPENING_MAX = 0.0952
"""Distance between the open pads, metres."""
FINGER_SPEED = 0.068
"""Speed limit of each finger, m/s: 95 mm in 0.7 s for the two together."""
TCP_STEP = 0.0125
"""Translation of the tcp target per control step and axis at an action of 1, metres."""
TCP_TURN = 0.0625
"""Rotation of the tcp target per control step at an action of 1, radians."""
WORKSPACE_LOWER = (0.12, -0.35, 0.018)
"""Corner of the box that the tcp's target stays in, base frame, metres; below it the tips touch the table."""
WORKSPACE_UPPER = (0.50, 0.35, 0.40)
"""The opposite corner."""

OPEN = (OPENING_MAX / 2, OPENING_MAX / 2)
CLOSED = (0.0, 0.0)
_READY = (-0.452075, -1.507987, 0.854125, -0.916934, -1.570796, -0.452075)


def opening_to_action(opening: Tensor | float) -> Any:
    """Return the gripper's action in [-1, 1] for an opening in metres (0 .. `OPENING_MAX`)."""
    return 2 * opening / OPENING_MAX - 1


def action_to_opening(action: Tensor | float) -> Any:
    """Return the opening in metres that a gripper action in [-1, 1] asks for."""
    return (action + 1) * OPENING_MAX / 2


def _keyframe(arm: tuple[float, ...], fingers: tuple[float, float]) -> Keyframe:
    return Keyframe(pose=sapien.Pose(), qpos=np.array([*arm, *fingers], dtype=np.float32))


@register_agent()
class UR3eAG95(BaseAgent):
    """UR3e arm (6 revolute joints) and AG-95 gripper (2 prismatic pads); qpos (N, 8): rad, then metres per finger.

    Physics: run at 200 Hz, control at 20 Hz. Gravity is off on the robot's links (the real controller compensates it).
    Default control mode: `pd_ee_target_delta_pose`, action (7,): tcp translation and rotation vector in the base frame
    (`TCP_STEP`, `TCP_TURN` per step), and the opening (-1 closed, +1 `OPENING_MAX`).
    """

    uid = "ur3e_ag95"
    urdf_path = str(asset("robots", "ur3e_ag95", "ur3e_ag95.urdf"))
    urdf_config = {  # noqa: RUF012 - ManiSkill's own class attribute
        "_materials": {"pad": {"static_friction": 1.5, "dynamic_friction": 1.5, "restitution": 0.0}},
        "link": {
            side: {"material": "pad", "patch_radius": 0.02, "min_patch_radius": 0.01}
            for side in ("left_finger", "right_finger")
        },
    }
    keyframes = {  # noqa: RUF012 - ManiSkill's own class attribute
        "ready": _keyframe(_READY, OPEN),
        "ready_closed": _keyframe(_READY, CLOSED),
        "rest": _keyframe((0.0, -np.pi / 2, np.pi / 2, -np.pi / 2, -np.pi / 2, 0.0), OPEN),
        "upright": _keyframe((0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0), OPEN),
    }

    arm_stiffness = 1e3  # Nm/rad
    arm_damping = 1e2  # Nm s/rad
    arm_friction = 0.1
    finger_stiffness = 1e3  # N/m: the grip force is this times half the width of what is held
    finger_damping = 40.0  # N s/m
    finger_force_limit = 70.0  # N

    def _after_loading_articulation(self) -> None:
        # Shapes that share a bit of group 2 do not collide. PhysX skips parent and child by itself; these are the pairs
        # one link further apart whose housings overlap by design, and the inside of the gripper.
        for bit, names in enumerate(
            (
                ("base_link_inertia", "shoulder_link"),
                ("forearm_link", "wrist_1_link", "wrist_2_link"),
                ("wrist_1_link", "wrist_2_link", "wrist_3_link"),
                ("wrist_3_link", "ag95_body", "left_finger", "right_finger"),
            ),
            start=28,
        ):
            for name in names:
                self.robot.links_map[name].set_collision_group_bit(group=2, bit_idx=bit, bit=1)

    def _after_init(self) -> None:
        self.tcp: Link = self.robot.links_map["tcp"]
        self.left_finger: Link = self.robot.links_map["left_finger"]
        self.right_finger: Link = self.robot.links_map["right_finger"]
        order = [joint.name for joint in self.robot.active_joints]
        self._arm_columns = [order.index(name) for name in ARM_JOINTS]
        self._finger_columns = [order.index(name) for name in FINGER_JOINTS]

    def reset(self, init_qpos: Tensor | None = None) -> None:
        """Put the rows being reset to rest, at `init_qpos` (rows, 8) where it is given."""
        super().reset(init_qpos)
        for controller in self.controller.controllers.values():
            controller.beginning = self.scene._reset_mask

    def get_controller_state(self) -> dict[str, dict[str, Tensor]]:
        """Return copies of what the active controllers remember from step to step, by controller: see `memory`."""
        return {uid: memory.of(controller) for uid, controller in self.controller.controllers.items()}

    def set_controller_state(self, state: dict[str, Any]) -> None:
        """Take back what `get_controller_state` returned, in the rows of `scene._reset_mask`.

        What the state lacks, as those of earlier versions do, stays as it is.
        """
        for uid, controller in self.controller.controllers.items():
            memory.restore(controller, state.get(uid, {}))

    @property
    def _controller_configs(self) -> dict[str, DictControllerConfig]:
        arm = {
            "pd_ee_target_delta_pose": self._pose_config(use_target=True),
            "pd_ee_delta_pose": self._pose_config(),
            "pd_ee_pose": self._pose_config(
                use_delta=False,
                normalize_action=False,
                pos_lower=-2.0,
                pos_upper=2.0,
                rot_lower=-2 * np.pi,
                rot_upper=2 * np.pi,
            ),
            "pd_joint_pos": self._joint_config(lower=None, upper=None, normalize_action=False),
            "pd_joint_delta_pos": self._joint_config(lower=-0.1, upper=0.1, use_delta=True),
        }
        return {name: {"arm": config, "gripper": self._gripper_config()} for name, config in arm.items()}

    def _drives(self) -> dict[str, Any]:
        return {
            "joint_names": list(ARM_JOINTS),
            "stiffness": self.arm_stiffness,
            "damping": self.arm_damping,
            "force_limit": JOINT_EFFORT,
            "friction": self.arm_friction,
        }

    def _joint_config(self, **settings: Any) -> PDJointPosControllerConfig:
        return PDJointPosControllerConfig(**self._drives(), **settings)

    def _pose_config(self, **settings: Any) -> LimitedPoseControllerConfig:
        step = {"pos_lower": -TCP_STEP, "pos_upper": TCP_STEP, "rot_lower": -TCP_TURN, "rot_upper": TCP_TURN}
        return LimitedPoseControllerConfig(
            **self._drives(),
            **(step | settings),
            ee_link="tcp",
            urdf_path=self.urdf_path,
            workspace_lower=WORKSPACE_LOWER,
            workspace_upper=WORKSPACE_UPPER,
            max_joint_speed=JOINT_SPEED,
        )

    def _gripper_config(self) -> OpeningControllerConfig:
        return OpeningControllerConfig(
            joint_names=list(FINGER_JOINTS),
            lower=0.0,
            upper=OPENING_MAX,
            stiffness=self.finger_stiffness,
            damping=self.finger_damping,
            force_limit=self.finger_force_limit,
            max_speed=FINGER_SPEED,
        )

    # --- what the robot tells of itself, all for N rows ---------------------------------------------------------------

    @property
    def tcp_pose(self) -> Pose:
        """Measured pose of the tcp in the world frame, N rows."""
        return self.tcp.pose

    @property
    def tcp_pose_at_base(self) -> Tensor:
        """Measured pose of the tcp in the base frame, (N, 7): xyz metres, wxyz."""
        return pose_in_frame(self.tcp.pose.raw_pose, self.robot.pose.raw_pose)

    @property
    def tcp_target_pose(self) -> Tensor:
        """Pose that the active controller steers the tcp to, base frame, (N, 7): xyz metres, wxyz.

        It is ahead of the measured pose while the arm moves; a controller without a target pose gives the measured one.
        """
        arm = self.controller.controllers["arm"]
        if getattr(arm.config, "use_target", False) and getattr(arm, "_target_pose", None) is not None:
            return arm._target_pose.raw_pose
        return self.tcp_pose_at_base

    @property
    def opening(self) -> Tensor:
        """Measured distance between the pads, (N,) metres."""
        return self.robot.get_qpos()[:, self._finger_columns].sum(dim=1)

    @property
    def opening_target(self) -> Tensor:
        """Opening that the fingers' drives are steering to at present, (N,) metres."""
        return self.controller.controllers["gripper"]._target_qpos.sum(dim=1)

    @property
    def arm_qpos(self) -> Tensor:
        """Measured arm joint positions in the order of `ARM_JOINTS`, (N, 6) rad."""
        return self.robot.get_qpos()[:, self._arm_columns]

    @property
    def arm_qvel(self) -> Tensor:
        """Measured arm joint velocities in the order of `ARM_JOINTS`, (N, 6) rad/s."""
        return self.robot.get_qvel()[:, self._arm_columns]

    def is_static(self, threshold: float = 0.2) -> Tensor:
        """Return whether no arm joint is faster than `threshold` rad/s, (N,) bool."""
        return self.arm_qvel.abs().amax(dim=1) <= threshold

    def pad_forces(self, obj: Actor | Link) -> tuple[Tensor, Tensor]:
        """Return the contact forces that `obj` exerts on the left and on the right finger, two (N, 3), newtons."""
        left, right = (self.scene.get_pairwise_contact_forces(f, obj) for f in (self.left_finger, self.right_finger))
        return left, right

    def is_grasping(self, object: Actor | Link, min_force: float = 0.5, max_angle: float = 85.0) -> Tensor:
        """Return whether both pads press on `object`, (N,) bool.

        Args:
            object: what may be held (ManiSkill's name for the argument).
            min_force: least force on each pad, newtons.
            max_angle: largest angle between that force and the pad's opening direction, degrees.
        """
        held = torch.ones(len(self.robot.get_qpos()), dtype=torch.bool, device=self.device)
        for finger, force in zip((self.left_finger, self.right_finger), self.pad_forces(object), strict=True):
            outward = finger.pose.to_transformation_matrix()[..., :3, 0]
            angle = torch.rad2deg(common.compute_angle_between(outward, force))
            held &= (torch.linalg.norm(force, dim=1) >= min_force) & (angle <= max_angle)
        return held
