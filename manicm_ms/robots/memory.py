"""What a controller remembers from one control step to the next, told as copies and taken back row by row.

ManiSkill's controllers tell of themselves only what they put into observations: no joint targets, and nothing of a
gripper. A state that is restored without them goes on from targets of another moment, centimetres away.
"""

from __future__ import annotations

from typing import Any

import torch
from mani_skill.utils.structs import Pose
from torch import Tensor

TARGET_POSE, TARGET_QPOS = "target_pose", "target_qpos"


def of(controller: Any) -> dict[str, Tensor]:
    """Return copies of the targets that the next step may start from.

    Returns:
        target_pose (N, 7), xyz metres and wxyz in the base frame, of a controller that moves a target pose;
        target_qpos (N, J), rad or metres, which the drives steer to.
    """
    told = {}
    if _moves_a_pose(controller):
        told[TARGET_POSE] = controller._target_pose.raw_pose.clone()
    told[TARGET_QPOS] = controller._target_qpos.clone()
    return told


def restore(controller: Any, told: dict[str, Any]) -> None:
    """Take back what `of` returned, in the rows of `scene._reset_mask`; what is missing stays as it is.

    In the middle of a reset of the environment (`options["reset_to_env_states"]`) these rows are not set to what is
    measured afterwards, as those of a new episode are.
    """
    rows = controller.scene._reset_mask
    if TARGET_POSE in told and _moves_a_pose(controller):
        controller._target_pose = Pose.create(replaced_rows(controller._target_pose.raw_pose, rows, told[TARGET_POSE]))
        _keep(controller, rows)
    if TARGET_QPOS in told:
        controller._target_qpos = replaced_rows(controller._target_qpos, rows, told[TARGET_QPOS])
        controller.set_drive_targets(controller._target_qpos)
        _keep(controller, rows)


def _moves_a_pose(controller: Any) -> bool:
    return (
        bool(getattr(controller.config, "use_target", False)) and getattr(controller, "_target_pose", None) is not None
    )


def replaced_rows(before: Tensor, rows: Tensor, values: Any) -> Tensor:
    """Return a copy of `before` (N, k) with `values` ((n, k), or (k,) for one row) in the n marked `rows` (N,) bool."""
    after = before.clone()
    after[rows] = torch.as_tensor(values, dtype=before.dtype, device=before.device).view(-1, before.shape[1])
    return after


def _keep(controller: Any, rows: Tensor) -> None:
    if getattr(controller, "beginning", None) is not None:
        controller.beginning = controller.beginning & ~rows
