"""Stack Cube: pick the red cube and stack it on the white one with the parallel gripper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import ClassVar

import numpy as np
import sapien
import torch
from mani_skill.utils.structs import Actor, Pose
from torch import Tensor

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.waypoints import Motion, Waypoint, WaypointExpert, over, smallest_turn
from manicm_ms.envs.maniskill import ManiSkillSimulator, register_env
from manicm_ms.envs.simulator import ENVS, EnvEntry
from manicm_ms.envs.ur3e_tabletop import (
    FINGERS_ALONG_Y,
    SPAWN_CLEARANCE,
    STILL_SPEED,
    STILL_TURN,
    UR3eTabletopEnv,
    pose_error,
    ur3e_spec,
)
from manicm_ms.robots.limits import quat_from_yaw, yaw_of_quat
from manicm_ms.robots.ur3e_ag95 import OPENING_MAX, TCP_STEP, TCP_TURN

ENV_ID, GYM_ID = "ur3e/stack-cube", "UR3eStackCube-v1"
MAX_EPISODE_STEPS = 200
SPEC = ur3e_spec(ENV_ID, MAX_EPISODE_STEPS, objects=("red", "white"))

RED_HALF, WHITE_HALF = 0.020, 0.025  # m
RED_MASS, WHITE_MASS = 0.064, 0.125  # kg
FRICTION = 0.6  # material value of cubes and table; a pair acts with the average
RED, WHITE = (0.75, 0.10, 0.08, 1.0), (0.92, 0.92, 0.90, 1.0)

SPAWN_LOWER, SPAWN_UPPER = (0.24, -0.14), (0.38, 0.14)  # m: where cube centres may stand
MIN_DISTANCE = 0.12  # m between the centres: the open fingers around one cube miss the other
MAX_YAW = np.deg2rad(30)
_SPAWN_TRIES = 64  # about three of four pairs are far enough apart: all of them too close is out of the question

MAX_OFFSET, MAX_HEIGHT_ERROR = 0.02, 0.005  # m: where the red cube counts as stacked
MAX_WHITE_SHIFT, MAX_WHITE_TILT = 0.02, np.deg2rad(10)  # m, rad


@register_env(GYM_ID, max_episode_steps=MAX_EPISODE_STEPS)
class StackCubeEnv(UR3eTabletopEnv):
    """Stack the red cube on the white cube without moving the white one.

    **Randomisation** (per row, from its seed): both centres in x 0.24..0.38 m, y -0.14..0.14 m, at least 12 cm apart;
    each cube's yaw +-30 deg; arm joints by 0.02 rad.

    **Success**: the red cube stands on the white one, off its centre by less than 2 cm, both are still, and the gripper
    has let go. **Failure**: the white cube was moved by 2 cm or tilted by 10 deg, or a cube fell off the table.
    """

    start_qpos: ClassVar[tuple[float, ...]] = FINGERS_ALONG_Y
    start_opening: ClassVar[float] = OPENING_MAX
    table_friction: ClassVar[float] = FRICTION
    remembered: ClassVar[tuple[str, ...]] = ("white_start",)
    reward_weights: ClassVar[dict[str, float]] = {
        "reach": 1.0, "grasp": 1.0, "carry": 2.0, "stack": 1.0, "release": 1.0, "white_in_place": 1.0
    }  # fmt: skip

    def _load_objects(self) -> dict[str, Actor]:
        self.red = self.build_box("red", (RED_HALF,) * 3, RED, friction=FRICTION, mass=RED_MASS).build(name="red")
        white = self.build_box("white", (WHITE_HALF,) * 3, WHITE, friction=FRICTION, mass=WHITE_MASS)
        self.white = white.build(name="white")
        self.white_start = Pose.create(sapien.Pose()).raw_pose.to(self.device).repeat(self.num_envs, 1)  # (N, 7)
        return {"red": self.red, "white": self.white}

    def _place_objects(self, rng: np.random.RandomState, count: int) -> None:
        rows = self.scene._reset_mask
        yaw = torch.as_tensor(rng.uniform(-MAX_YAW, MAX_YAW, size=2), dtype=torch.float32)  # (count, 2)
        red_xy, white_xy = _far_apart(rng)
        poses = []
        for xy, half, angle in zip((red_xy, white_xy), ("red", "white"), yaw.T, strict=True):
            height = self.half_sizes[half][rows, 2:] + SPAWN_CLEARANCE  # (count, 1)
            poses.append(Pose.create_from_pq(torch.cat([xy.to(height), height], dim=1), quat_from_yaw(angle)))
        self.red.set_pose(poses[0])
        self.white.set_pose(poses[1])
        self.white_start[rows] = poses[1].raw_pose

    def evaluate(self) -> dict[str, Tensor]:
        """Return per-row booleans (N,): success, fail, grasped, stacked, white_moved, still."""
        offset = self.red.pose.p - self.white.pose.p
        wanted = self.half_sizes["red"][:, 2] + self.half_sizes["white"][:, 2]
        stacked = (offset[:, :2].norm(dim=1) < MAX_OFFSET) & ((offset[:, 2] - wanted).abs() < MAX_HEIGHT_ERROR)
        shift, tilt = pose_error(self.white.pose, Pose.create(self.white_start))
        moved = (shift > MAX_WHITE_SHIFT) | (tilt > MAX_WHITE_TILT)
        still = self.red.is_static(STILL_SPEED, STILL_TURN) & self.white.is_static(STILL_SPEED, STILL_TURN)
        off_table = (self.red.pose.p[:, 2] < 0) | (self.white.pose.p[:, 2] < 0)
        grasped = self.agent.is_grasping(self.red)
        return {
            "success": stacked & still & ~grasped & ~moved,
            "fail": moved | off_table,
            "grasped": grasped,
            "stacked": stacked,
            "white_moved": moved,
            "still": still,
        }

    def reward_terms(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the named terms, each (N,) in [0, 1]; what a later stage leaves behind stays earned.

        reach: the TCP comes near the red cube. grasp: both fingers hold it. carry: held, it nears its place on the
        white cube. stack: it stands there. release: there, the gripper opens. white_in_place: the white cube stays.
        """
        red, white = self.red.pose.p, self.white.pose.p
        goal = white.clone()
        goal[:, 2] += self.half_sizes["red"][:, 2] + self.half_sizes["white"][:, 2]
        shift, _ = pose_error(self.white.pose, Pose.create(self.white_start))
        stacked = info["stacked"].float()
        held = torch.maximum(info["grasped"].float(), stacked)
        near = 1 - torch.tanh(5 * (self.agent.tcp_pose.p - red).norm(dim=1))
        return {
            "reach": torch.maximum(near, stacked),
            "grasp": held,
            "carry": held * (1 - torch.tanh(5 * (red - goal).norm(dim=1))),
            "stack": stacked,
            "release": stacked * (self.agent.opening / RELEASE_OPENING).clamp(max=1),
            "white_in_place": 1 - (shift / MAX_WHITE_SHIFT).clamp(max=1),
        }


def _far_apart(rng: np.random.RandomState) -> tuple[Tensor, Tensor]:
    """Draw two centres (count, 2) a row, m: the first of the row's candidates that are far enough apart."""
    lower, upper = SPAWN_LOWER * 2, SPAWN_UPPER * 2
    pairs = torch.as_tensor(rng.uniform(lower, upper, size=(_SPAWN_TRIES, 4)), dtype=torch.float32)  # (count, K, 4)
    apart = (pairs[..., :2] - pairs[..., 2:]).norm(dim=2) >= MIN_DISTANCE
    chosen = pairs[torch.arange(len(pairs)), apart.int().argmax(dim=1)]
    return chosen[:, :2], chosen[:, 2:]


ENVS.add(ENV_ID, EnvEntry(SPEC, partial(ManiSkillSimulator, gym_id=GYM_ID), __name__), tags=("ur3e", "real-robot"))


# ---- expert ---------------------------------------------------------------------------------------------------

GRASP_OPENING, RELEASE_OPENING = 0.080, 0.066  # m
HOVER_Z, GRASP_Z, LIFT_Z, OVER_Z, PLACE_Z, RETREAT_Z = 0.083, 0.023, 0.136, 0.106, 0.076, 0.146  # m, TCP
FREE_SPEED, LOWER_SPEED, LIFT_SPEED, PLACE_SPEED = 0.22, 0.12, 0.15, 0.08  # m/s
CLOSE_STEPS, OPEN_STEPS = 6, 4  # control steps that the fingers need; from longer pauses a policy learns to stay


@EXPERTS.register(ENV_ID)
class StackCubeExpert(WaypointExpert):
    """Grasps the red cube along the sides nearest to the fingers, carries it over the white cube and sets it down."""

    name = "stack-cube way-points"
    motion = Motion(TCP_STEP, TCP_TURN, OPENING_MAX)

    def plan(self, scene: Mapping[str, Tensor], seeds: Sequence[int]) -> list[Waypoint]:
        """Return the way-points of N episodes from the parts of their first state, (N, width) each, and their seeds."""
        tcp, red, white = scene["tcp_pose"], scene["red_pose"], scene["white_pose"]
        quarter = torch.pi / 2  # a cube looks the same after it
        grasp = smallest_turn(yaw_of_quat(red[:, 3:]) - yaw_of_quat(tcp[:, 3:]), quarter)
        return [
            (over(red, HOVER_Z), grasp, GRASP_OPENING, FREE_SPEED, 0),
            (over(red, GRASP_Z), grasp, GRASP_OPENING, LOWER_SPEED, 0),
            (over(red, GRASP_Z), grasp, 0.0, LOWER_SPEED, CLOSE_STEPS),
            (over(red, LIFT_Z), grasp, 0.0, LIFT_SPEED, 0),
            (over(white, OVER_Z), grasp, 0.0, FREE_SPEED, 0),
            (over(white, PLACE_Z), grasp, 0.0, PLACE_SPEED, 0),
            (over(white, PLACE_Z), grasp, RELEASE_OPENING, PLACE_SPEED, OPEN_STEPS),
            (over(white, RETREAT_Z), grasp, RELEASE_OPENING, LIFT_SPEED, 0),
        ]
