"""Controllers of the UR3e and the AG-95: end-effector poses within limits, and an opening width with a finite speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from mani_skill.agents.controllers.pd_ee_pose import PDEEPoseController, PDEEPoseControllerConfig
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController, PDJointPosControllerConfig
from mani_skill.utils.structs import Pose
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.robots.limits import (
    clamp_norm,
    clamp_to_workspace,
    limit_joint_step,
    limit_lead,
    pose_in_frame,
    quat_from_rotvec,
)
from manicm_ms.robots.limits import quat_multiply as multiply


class _RowwiseReset:
    """Resets a controller in the rows that begin an episode, and leaves the targets of the others alone.

    ManiSkill (3.0.1) resets controllers when `scene._reset_mask` covers every row again. In rows whose episode goes on,
    targets would fall back to what is measured: the arm would stop short, and fingers would let go of what they hold.

    Attributes:
        beginning: (N,) bool, rows that begin an episode; set by the agent and used up by the next reset. None: all.
    """

    beginning: Tensor | None = None
    scene: Any

    def reset(self) -> None:
        """Take what is measured as the target, in the rows that begin."""
        every_row = self.scene._reset_mask
        if self.beginning is not None:
            self.scene._reset_mask = self.beginning
        try:
            super().reset()  # type: ignore[misc]
        finally:
            self.scene._reset_mask, self.beginning = every_row, None


class LimitedPoseController(_RowwiseReset, PDEEPoseController):
    """Turns end-effector actions (N, 6) into joint targets that stay inside the workspace and the joints' speeds.

    An action is a translation and a rotation vector, both in the robot-base frame, each component in [-1, 1] of the
    configured step. **An action of +1 turns by plus the limit, counter-clockwise about the positive axis**, which
    differs from ManiSkill's own controller (it multiplies by `rot_lower` and so turns the other way). Translation is
    clipped per axis, rotation by its norm.

    With `use_target` an action moves the target of the previous step, a hidden state that runs ahead of the arm by
    about damping / stiffness seconds, otherwise the measured pose. Without `use_delta` an action is the pose itself:
    xyz in metres and Euler angles XYZ in radians, as ManiSkill has it. The joint target moves at most
    `max_joint_speed` / control frequency per step, so that the drives, which lag behind it, keep the limits too; a
    target without a solution (CPU) leaves the previous one in force.
    """

    config: LimitedPoseControllerConfig
    _target_pose: Pose
    _target_qpos: Tensor

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        limits = self.articulation.get_qlimits()[0, self.active_joint_indices]  # (J, 2)
        self._joint_lower, self._joint_upper = limits[:, 0], limits[:, 1]
        speed = torch.as_tensor(self.config.max_joint_speed, dtype=torch.float32, device=self.device)
        self._max_joint_step = speed / self._control_freq
        self._workspace_lower = torch.tensor(self.config.workspace_lower, device=self.device)
        self._workspace_upper = torch.tensor(self.config.workspace_upper, device=self.device)

    @property
    def ee_pose_at_base(self) -> Pose:
        """Measured end-effector pose in the base frame, N rows; the fewer tensor operations per step, the better."""
        return Pose.create(pose_in_frame(self.ee_link.pose.raw_pose, self.root_link.pose.raw_pose))

    def _clip_and_scale_action_space(self) -> None:
        super()._clip_and_scale_action_space()
        # ManiSkill's trajectory converter emits the inverse rotation, meant for its own sign; the two bounds swapped
        # undo that, so that replay_trajectory converts to these controllers.
        self.action_space_low[3:], self.action_space_high[3:] = (
            self.action_space_high[3:].clone(),
            self.action_space_low[3:].clone(),
        )

    def _clip_and_scale_action(self, action: Tensor) -> Tensor:
        translation = action[:, :3].clamp(-1.0, 1.0) * self.action_space_high[:3]
        return torch.cat([translation, clamp_norm(action[:, 3:], 1.0) * self.config.rot_upper], dim=1)

    def compute_target_pose(self, prev_ee_pose_at_base: Pose, action: Tensor) -> Pose:
        """Return the limited target pose in the base frame for a scaled action (N, 6): metres and radians."""
        measured = self.ee_pose_at_base.raw_pose
        if self.config.use_delta:
            previous = prev_ee_pose_at_base.raw_pose
            rotation = multiply(quat_from_rotvec(action[:, 3:]), previous[:, 3:])
            position = previous[:, :3] + action[:, :3]
        else:
            previous = measured
            target = super().compute_target_pose(prev_ee_pose_at_base, action)
            position, rotation = target.p, target.q
        rotation = rotation / torch.linalg.norm(rotation, dim=1, keepdim=True)
        position = clamp_to_workspace(position, previous[:, :3], self._workspace_lower, self._workspace_upper)
        raw = torch.cat([position, rotation], dim=1)
        if self.config.use_target:
            raw = limit_lead(raw, measured, self.config.max_lead, self.config.max_lead_angle)
        return Pose.create(raw)

    def set_action(self, action: Tensor) -> None:
        """Set the drives' targets for an action (N, 6); held until the next one."""
        action = self._preprocess_action(action)
        self._step = 0
        self._start_qpos = self.qpos
        follows_measurement = self.config.use_delta and not self.config.use_target
        previous_qpos = self._start_qpos if follows_measurement else self._target_qpos
        previous_pose = self._target_pose if self.config.use_target else self.ee_pose_at_base
        target_pose = self.compute_target_pose(previous_pose, action)
        solution = self._solve(target_pose, previous_qpos)
        self._target_pose = target_pose if solution is not None else previous_pose
        wanted = solution if solution is not None else previous_qpos
        wanted = torch.maximum(torch.minimum(wanted, self._joint_upper), self._joint_lower)
        self._target_qpos = limit_joint_step(wanted, previous_qpos, self._max_joint_step)
        self.set_drive_targets(self._target_qpos)

    def get_state(self) -> dict[str, Tensor]:
        """Return what observations tell of the controller: a copy of its target pose (N, 7) where it keeps one."""
        return {name: value.clone() for name, value in super().get_state().items()}

    def _solve(self, target_pose: Pose, start_qpos: Tensor) -> Tensor | None:
        """Return joint positions (N, J) near `start_qpos` that reach the target, or None where there are none (CPU)."""
        full_qpos = self.articulation.get_qpos().clone()
        full_qpos[:, self.active_joint_indices] = start_qpos
        return self.kinematics.compute_ik(pose=target_pose, q0=full_qpos, solver_config=self.config.delta_solver_config)


@dataclass
class LimitedPoseControllerConfig(PDEEPoseControllerConfig):
    """Settings of `LimitedPoseController`; `pos_upper` (m) and `rot_upper` (rad) are the reach of one step.

    Attributes:
        workspace_lower, workspace_upper: corners of the box that the target stays in, base frame, metres.
        max_joint_speed: of each joint, rad/s.
        max_lead: distance that the target may be ahead of the measured pose, metres.
        max_lead_angle: angle that it may be ahead, radians.
    """

    workspace_lower: tuple[float, float, float] = (-2.0, -2.0, -2.0)
    workspace_upper: tuple[float, float, float] = (2.0, 2.0, 2.0)
    max_joint_speed: Sequence[float] = ()
    max_lead: float = 0.08
    max_lead_angle: float = 0.35
    controller_cls = LimitedPoseController

    def __post_init__(self) -> None:
        if len(self.max_joint_speed) != len(self.joint_names):
            raise ConfigError(
                f"max_joint_speed has {len(self.max_joint_speed)} entries for {len(self.joint_names)} joints: "
                "give one per joint"
            )


class OpeningController(_RowwiseReset, PDJointPosController):
    """Commands the opening of a two-finger gripper (N, 1): the distance between the pads, metres.

    An action of -1 asks for `lower`, +1 for `upper` (width 0 and the full stroke); each finger takes half. The drives'
    target moves towards what was asked at no more than `max_speed` per finger, as the real gripper does, so that open
    and close may be step commands.
    """

    config: OpeningControllerConfig
    _target_qpos: Tensor

    def _initialize_action_space(self) -> None:
        low, high = (np.array([bound], dtype=np.float32) for bound in (self.config.lower, self.config.upper))
        self.single_action_space = spaces.Box(low, high, dtype=np.float32)

    def set_action(self, action: Tensor) -> None:
        """Move the fingers' targets (N, 2) towards half of the asked opening (N, 1)."""
        asked = self._preprocess_action(action) / 2
        self._step = 0
        self._start_qpos = self.qpos
        most = self.config.max_speed / self._control_freq
        self._target_qpos = self._target_qpos + (asked - self._target_qpos).clamp(-most, most)
        self.set_drive_targets(self._target_qpos)


@dataclass
class OpeningControllerConfig(PDJointPosControllerConfig):
    """Settings of `OpeningController`; `lower` and `upper` are openings in metres, `max_speed` is m/s per finger."""

    max_speed: float = 0.068
    controller_cls = OpeningController
