"""Slide Block: push the grey block off the white cube with the end-effector."""

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
from manicm_ms.demos.waypoints import Motion, Waypoint, WaypointExpert, over
from manicm_ms.envs.maniskill import ManiSkillSimulator, register_env
from manicm_ms.envs.simulator import ENVS, EnvEntry
from manicm_ms.envs.ur3e_tabletop import (
    FINGERS_ALONG_X,
    SPAWN_CLEARANCE,
    STILL_SPEED,
    STILL_TURN,
    UR3eTabletopEnv,
    pose_error,
    ur3e_spec,
)
from manicm_ms.robots.limits import pose_in_frame, quat_from_yaw
from manicm_ms.robots.ur3e_ag95 import OPENING_MAX, TCP_STEP, TCP_TURN

ENV_ID, GYM_ID = "ur3e/slide-block", "UR3eSlideBlock-v1"
MAX_EPISODE_STEPS = 120
SPEC = ur3e_spec(ENV_ID, MAX_EPISODE_STEPS, objects=("cube", "block"))

CUBE_HALF = 0.030  # m
BLOCK_HALF = (0.020, 0.020, 0.015)  # m
CUBE_MASS, BLOCK_MASS = 0.20, 0.05  # kg
CUBE_FRICTION, BLOCK_FRICTION, TABLE_FRICTION = 0.4, 0.2, 0.8  # material values; a pair acts with their average
WHITE, GREY = (0.92, 0.92, 0.90, 1.0), (0.35, 0.36, 0.38, 1.0)

FALLEN_HEIGHT = 0.045  # m: below it the block's centre is no longer on the cube
MAX_CUBE_SHIFT, MAX_CUBE_TILT = 0.02, np.deg2rad(10)  # m, rad
TOUCHING = 0.03  # m from the block's centre to the TCP of a hand that touches it: being nearer earns no more


@register_env(GYM_ID, max_episode_steps=MAX_EPISODE_STEPS)
class SlideBlockEnv(UR3eTabletopEnv):
    """Push the grey block off the white cube without moving the cube.

    **Randomisation** (per row, from its seed): the cube's centre in x 0.25..0.35 m, y -0.08..0.08 m, yaw +-15 deg; the
    block on top of it, off centre by up to 5 mm in x and y, turned by up to 15 deg against it; arm joints by 0.02 rad.

    **Success**: the block lies beside the cube on the table, cube and block are still, and the cube was moved by less
    than 2 cm and tilted by less than 10 deg. **Failure**: the cube was moved or tilted further, or the block fell off
    the table.
    """

    start_qpos: ClassVar[tuple[float, ...]] = FINGERS_ALONG_X  # their flat sides face +y and -y
    start_opening: ClassVar[float] = 0.0
    table_friction: ClassVar[float] = TABLE_FRICTION
    remembered: ClassVar[tuple[str, ...]] = ("cube_start",)
    reward_weights: ClassVar[dict[str, float]] = {"reach": 2.0, "push": 2.0, "fall": 1.0, "cube_in_place": 1.0}

    def _load_objects(self) -> dict[str, Actor]:
        cube = self.build_box("cube", (CUBE_HALF,) * 3, WHITE, friction=CUBE_FRICTION, mass=CUBE_MASS)
        self.cube = cube.build(name="cube")
        block = self.build_box("block", BLOCK_HALF, GREY, friction=BLOCK_FRICTION, mass=BLOCK_MASS)
        self.block = block.build(name="block")
        self.cube_start = Pose.create(sapien.Pose()).raw_pose.to(self.device).repeat(self.num_envs, 1)  # (N, 7)
        return {"cube": self.cube, "block": self.block}

    def _place_objects(self, rng: np.random.RandomState, count: int) -> None:
        rows = self.scene._reset_mask
        yaw = torch.as_tensor(rng.uniform(-np.pi / 12, np.pi / 12, size=2), dtype=torch.float32)  # (count, 2)
        xy = torch.as_tensor(rng.uniform((0.25, -0.08), (0.35, 0.08)), dtype=torch.float32)
        off = torch.as_tensor(rng.uniform(-0.005, 0.005, size=2), dtype=torch.float32)

        # What a size adds to the nominal one: exactly 0 without randomised sizes, so that those starts never changed.
        cube_extra = self.half_sizes["cube"][rows, 2:] - torch.tensor(CUBE_HALF)  # (count, 1)
        block_extra = self.half_sizes["block"][rows, 2:] - torch.tensor(BLOCK_HALF[2])
        on_table = torch.full((count, 1), CUBE_HALF + SPAWN_CLEARANCE) + cube_extra
        cube = Pose.create_from_pq(torch.cat([xy, on_table], dim=1), quat_from_yaw(yaw[:, 0]))
        on_cube = torch.full((count, 1), 2 * CUBE_HALF + BLOCK_HALF[2] + 2 * SPAWN_CLEARANCE)
        on_cube = on_cube + 2 * cube_extra + block_extra
        block = Pose.create_from_pq(torch.cat([xy + off, on_cube], dim=1), quat_from_yaw(yaw.sum(dim=1)))
        self.cube.set_pose(cube)
        self.block.set_pose(block)
        self.cube_start[rows] = cube.raw_pose

    def evaluate(self) -> dict[str, Tensor]:
        """Return per-row booleans (N,): success, fail, block_fallen, block_fell_wrong, cube_moved, still."""
        block, cube = self.block.pose.raw_pose, self.cube.pose
        centre = block[:, :3]
        in_cube = pose_in_frame(block, cube.raw_pose)
        beside = (in_cube[:, :2].abs() > self.half_sizes["cube"][:, :2]).any(dim=1)
        fallen = (centre[:, 2] > 0) & (centre[:, 2] < FALLEN_HEIGHT) & beside
        shift, tilt = pose_error(cube, Pose.create(self.cube_start))
        moved = (shift > MAX_CUBE_SHIFT) | (tilt > MAX_CUBE_TILT)
        still = self.cube.is_static(STILL_SPEED, STILL_TURN) & self.block.is_static(STILL_SPEED, STILL_TURN)
        off_table = centre[:, 2] < 0
        return {
            "success": fallen & still & ~moved,
            "fail": moved | off_table,
            "block_fallen": fallen,
            "block_fell_wrong": off_table | (fallen & moved),
            "cube_moved": moved,
            "still": still,
        }

    def reward_terms(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the named terms, each (N,) in [0, 1]; what a later stage leaves behind stays earned.

        reach: the TCP comes near the block, full where it touches. push: the block leaves the cube's centre, full at
        the cube's edge. fall: the block lies beside the cube. cube_in_place: the cube stays where it was.
        """
        block, cube = self.block.pose.p, self.cube.pose.p
        distance = (self.agent.tcp_pose.p - block).norm(dim=1)
        slid = (block - cube)[:, :2].norm(dim=1)
        shift, _ = pose_error(self.cube.pose, Pose.create(self.cube_start))
        fallen = info["block_fallen"].float()
        return {
            "reach": torch.maximum(1 - torch.tanh(10 * (distance - TOUCHING).clamp(min=0)), fallen),
            "push": (slid / (self.half_sizes["cube"][:, 0] + self.half_sizes["block"][:, 0])).clamp(max=1),
            "fall": fallen,
            "cube_in_place": 1 - (shift / MAX_CUBE_SHIFT).clamp(max=1),
        }


ENVS.add(ENV_ID, EnvEntry(SPEC, partial(ManiSkillSimulator, gym_id=GYM_ID), __name__), tags=("ur3e", "real-robot"))


# ---- expert ---------------------------------------------------------------------------------------------------

BEHIND, BEYOND = 0.062, 0.065  # m before and past the block's centre: where the push begins and ends
APPROACH_Z, PUSH_Z, RETREAT_Z = 0.127, 0.089, 0.160  # m, TCP; while pushing the tip is 12 mm above the cube
FREE_SPEED, LOWER_SPEED, PUSH_SPEED, RETREAT_SPEED = 0.22, 0.12, 0.10, 0.15  # m/s


@EXPERTS.register(ENV_ID)
class SlideBlockExpert(WaypointExpert):
    """Goes behind the block, lowers the closed fingers and pushes it over the edge.

    Style "one-sided" pushes towards base +y, the robot's own left, "other-sided" towards -y; "two-sided" draws either
    for each episode from its seed. Stores of the first two over the same seeds together hold both ways from the very
    same start states.
    """

    name = "slide-block way-points"
    styles = ("one-sided", "two-sided", "other-sided")
    motion = Motion(TCP_STEP, TCP_TURN, OPENING_MAX)

    def plan(self, scene: Mapping[str, Tensor], seeds: Sequence[int]) -> list[Waypoint]:
        """Return the way-points of N episodes from the parts of their first state, (N, width) each, and their seeds."""
        block = scene["block_pose"]
        side = self._sides(seeds).to(block)  # (N,) +1 or -1

        def at(along: float, height: float) -> Tensor:
            return over(torch.stack([block[:, 0], block[:, 1] + side * along], dim=1), height)

        return [
            (at(-BEHIND, APPROACH_Z), 0.0, 0.0, FREE_SPEED, 0),
            (at(-BEHIND, PUSH_Z), 0.0, 0.0, LOWER_SPEED, 0),
            (at(BEYOND, PUSH_Z), 0.0, 0.0, PUSH_SPEED, 0),
            (at(BEYOND, RETREAT_Z), 0.0, 0.0, RETREAT_SPEED, 0),
        ]

    def _sides(self, seeds: Sequence[int]) -> Tensor:
        if (side := _SIDES.get(self.style)) is not None:
            return torch.full((len(seeds),), side)
        return torch.tensor([_coin(seed) for seed in seeds])


_SIDES = {"one-sided": 1.0, "other-sided": -1.0}


def _coin(seed: int) -> float:
    """Return +1 or -1, drawn from a stream of its own so that the scene does not tell the side."""
    return float(np.random.default_rng([seed, 0x51DE]).choice([-1.0, 1.0]))
