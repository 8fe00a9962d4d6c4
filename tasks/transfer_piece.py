"""Transfer Piece: pick the piece from the left compartment of a box and place it in the right one.

Left is the robot's own left, base +y: seen from behind the robot it is on the left, and on the right of a picture that
a camera in front of the table takes of the robot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from mani_skill.utils.structs import Actor, Pose
from torch import Tensor

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.waypoints import Motion, Waypoint, WaypointExpert, over, smallest_turn
from manicm_ms.envs.maniskill import ManiSkillSimulator, register_env
from manicm_ms.envs.simulator import ENVS, EnvEntry
from manicm_ms.envs.ur3e_tabletop import (
    FINGERS_ALONG_X,
    SPAWN_CLEARANCE,
    STILL_SPEED,
    STILL_TURN,
    UR3eTabletopEnv,
    ur3e_spec,
)
from manicm_ms.robots.limits import pose_in_frame, quat_from_yaw, quat_rotate, yaw_of_quat
from manicm_ms.robots.ur3e_ag95 import OPENING_MAX, TCP_STEP, TCP_TURN
from manicm_ms.sensing.point_cloud import Box

ENV_ID, GYM_ID = "ur3e/transfer-piece", "UR3eTransferPiece-v1"
MAX_EPISODE_STEPS = 180
SPEC = ur3e_spec(ENV_ID, MAX_EPISODE_STEPS, objects=("box", "piece"))

# The box: a tray with a floor, four walls and a divider across its middle. Its frame: centre of the underside.
INNER_X, INNER_Y = 0.130, 0.080  # m, of each compartment
WALL, WALL_HEIGHT, FLOOR = 0.005, 0.035, 0.003  # m; the height counts from the floor's top
COMPARTMENT_Y = (INNER_Y + WALL) / 2  # m: centre of the left compartment; the right one's is minus that
RIM = FLOOR + WALL_HEIGHT  # m: top of the walls

PIECE_HALF = (0.015, 0.015, 0.020)  # m
PIECE_MASS = 0.04  # kg
FRICTION = 0.6  # material value of piece, box and table; a pair acts with the average
BLUE, WOOD = (0.10, 0.25, 0.70, 1.0), (0.80, 0.66, 0.45, 1.0)

BOX_LOWER, BOX_UPPER, BOX_YAW = (0.30, -0.02), (0.34, 0.02), np.deg2rad(5)  # m, rad
PIECE_OFF, PIECE_YAW = (0.008, 0.015), np.deg2rad(10)  # m from the compartment's centre, box frame; rad

CROP_FLOOR = FLOOR + 0.005  # m: the cloud starts above the box's floor, which is 3 mm high as the other tasks' crop
LYING_HEIGHT = 0.030  # m: above it the piece's centre is on a wall or in the gripper
TIP_LENGTH = 0.017  # m from the TCP to the fingertips
TIP_CLEARANCE = 0.003  # m above the rim: the fingers have left the box


@register_env(GYM_ID, max_episode_steps=MAX_EPISODE_STEPS)
class TransferPieceEnv(UR3eTabletopEnv):
    """Take the piece out of the box's left compartment (base +y) and put it into the right one (base -y).

    The box is fixed (kinematic), as if clamped to the table.

    **Randomisation** (per row, from its seed): the box's centre in x 0.30..0.34 m, y +-2 cm, yaw +-5 deg; the piece
    off the left compartment's centre by up to 8 mm along the box's x and 15 mm along its y, turned by up to 10 deg
    against the box; arm joints by 0.02 rad.

    **Success**: the piece lies in the right compartment, still, not grasped, and the fingertips are out of the box.
    **Failure**: the piece lies outside the box.
    """

    start_qpos: ClassVar[tuple[float, ...]] = FINGERS_ALONG_X
    start_opening: ClassVar[float] = OPENING_MAX
    workspace: ClassVar[Box] = UR3eTabletopEnv.workspace.raised(CROP_FLOOR)
    table_friction: ClassVar[float] = FRICTION
    reward_weights: ClassVar[dict[str, float]] = {
        "reach": 1.0, "grasp": 1.0, "carry": 2.0, "place": 1.0, "withdraw": 1.0
    }  # fmt: skip

    def _load_objects(self) -> dict[str, Actor]:
        self.box = self.build_boxes("box", _tray(), WOOD, friction=FRICTION).build_kinematic(name="box")
        piece = self.build_box("piece", PIECE_HALF, BLUE, friction=FRICTION, mass=PIECE_MASS)
        self.piece = piece.build(name="piece")
        return {"box": self.box, "piece": self.piece}

    def _place_objects(self, rng: np.random.RandomState, count: int) -> None:
        rows = self.scene._reset_mask
        xy = torch.as_tensor(rng.uniform(BOX_LOWER, BOX_UPPER), dtype=torch.float32)  # (count, 2)
        most = np.array([BOX_YAW, PIECE_YAW]), np.array(PIECE_OFF)
        yaw, off = (torch.as_tensor(rng.uniform(-range_, range_), dtype=torch.float32) for range_ in most)  # (count, 2)

        turn = quat_from_yaw(yaw[:, 0])
        corner = torch.cat([xy, torch.zeros(count, 1)], dim=1)
        height = FLOOR + self.half_sizes["piece"][rows, 2] + SPAWN_CLEARANCE
        in_box = torch.stack([off[:, 0], COMPARTMENT_Y + off[:, 1], height], dim=1)
        self.box.set_pose(Pose.create_from_pq(corner, turn))
        self.piece.set_pose(Pose.create_from_pq(corner + quat_rotate(turn, in_box), quat_from_yaw(yaw.sum(dim=1))))

    def evaluate(self) -> dict[str, Tensor]:
        """Return per-row booleans (N,): success, fail, grasped, placed, withdrawn, still."""
        piece = self.piece.pose.raw_pose
        in_box = pose_in_frame(piece, self.box.pose.raw_pose)
        off = in_box[:, :2] - in_box.new_tensor([0.0, -COMPARTMENT_Y])  # from the right compartment's centre
        inside = (off.abs() < in_box.new_tensor([INNER_X / 2, INNER_Y / 2])).all(dim=1)
        low = in_box[:, 2] < LYING_HEIGHT
        outer = in_box.new_tensor([INNER_X / 2 + WALL, INNER_Y + 1.5 * WALL])
        outside = (in_box[:, :2].abs() > outer).any(dim=1)
        withdrawn = self.agent.tcp_pose.p[:, 2] - TIP_LENGTH > RIM + TIP_CLEARANCE
        still = self.piece.is_static(STILL_SPEED, STILL_TURN)
        grasped = self.agent.is_grasping(self.piece)
        placed = inside & low
        return {
            "success": placed & withdrawn & still & ~grasped,
            "fail": outside & low & ~grasped,
            "grasped": grasped,
            "placed": placed,
            "withdrawn": withdrawn,
            "still": still,
        }

    def reward_terms(self, info: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the named terms, each (N,) in [0, 1]; what a later stage leaves behind stays earned.

        reach: the TCP comes near the piece. grasp: both fingers hold it. carry: held, it nears the right compartment.
        place: it lies there. withdraw: there, the fingertips rise out of the box.
        """
        piece, box = self.piece.pose.p, self.box.pose.raw_pose
        centre = box.new_tensor([[0.0, -COMPARTMENT_Y, FLOOR]]).repeat(len(box), 1)
        centre[:, 2] += self.half_sizes["piece"][:, 2]
        goal = box[:, :3] + quat_rotate(box[:, 3:], centre)
        placed = info["placed"].float()
        held = torch.maximum(info["grasped"].float(), placed)
        tcp = self.agent.tcp_pose.p
        near = 1 - torch.tanh(5 * (tcp - piece).norm(dim=1))
        risen = ((tcp[:, 2] - TIP_LENGTH) / (RIM + TIP_CLEARANCE)).clamp(0, 1)
        return {
            "reach": torch.maximum(near, placed),
            "grasp": held,
            "carry": held * torch.maximum(1 - torch.tanh(5 * (piece - goal).norm(dim=1)), placed),
            "place": placed,
            "withdraw": placed * risen,
        }


def _tray() -> list[tuple[tuple[float, float, float], tuple[float, float, float]]]:
    """Return the boxes that the tray is made of: (centre, half of each edge), m, in its frame."""
    outer_x, outer_y = INNER_X / 2 + WALL, INNER_Y + 1.5 * WALL
    height = FLOOR + WALL_HEIGHT / 2
    side = ((INNER_X + WALL) / 2, 0.0, height)
    across = (INNER_X / 2, WALL / 2, WALL_HEIGHT / 2)
    ends = [((0.0, y, height), across) for y in (-(INNER_Y + WALL), 0.0, INNER_Y + WALL)]
    along = [((sign * side[0], 0.0, height), (WALL / 2, outer_y, WALL_HEIGHT / 2)) for sign in (-1, 1)]
    return [((0.0, 0.0, FLOOR / 2), (outer_x, outer_y, FLOOR / 2)), *ends, *along]


ENVS.add(
    ENV_ID,
    EnvEntry(SPEC, partial(ManiSkillSimulator, gym_id=GYM_ID), __name__, fixed=("box",)),
    tags=("ur3e", "real-robot"),
)


# ---- expert ---------------------------------------------------------------------------------------------------

INSERT_OPENING, RELEASE_OPENING = 0.050, 0.045  # m: the fully open gripper does not fit between the walls
HOVER_Z, GRASP_Z, CARRY_Z, PLACE_Z, RETREAT_Z = 0.095, 0.025, 0.085, 0.028, 0.105  # m, TCP
FREE_SPEED, LOWER_SPEED, LIFT_SPEED, PLACE_SPEED = 0.22, 0.12, 0.15, 0.10  # m/s
CLOSE_STEPS, OPEN_STEPS = 4, 3  # control steps that the fingers need; from longer pauses a policy learns to stay


@EXPERTS.register(ENV_ID)
class TransferPieceExpert(WaypointExpert):
    """Half closes the gripper, lowers it around the piece, lifts it over the divider and sets it down beyond."""

    name = "transfer-piece way-points"
    motion = Motion(TCP_STEP, TCP_TURN, OPENING_MAX)

    def plan(self, scene: Mapping[str, Tensor], seeds: Sequence[int]) -> list[Waypoint]:
        """Return the way-points of N episodes from the parts of their first state, (N, width) each, and their seeds."""
        tcp, box, piece = scene["tcp_pose"], scene["box_pose"], scene["piece_pose"]
        tool, quarter = yaw_of_quat(tcp[:, 3:]), torch.pi / 2  # the piece looks the same after a quarter turn
        grasp = smallest_turn(yaw_of_quat(piece[:, 3:]) - tool, quarter)
        place = smallest_turn(yaw_of_quat(box[:, 3:]) - tool, quarter)
        centre = box.new_tensor([[0.0, -COMPARTMENT_Y, 0.0]]).expand(len(box), -1)
        right = box[:, :3] + quat_rotate(box[:, 3:], centre)
        return [
            (over(piece, HOVER_Z), grasp, INSERT_OPENING, FREE_SPEED, 0),
            (over(piece, GRASP_Z), grasp, INSERT_OPENING, LOWER_SPEED, 0),
            (over(piece, GRASP_Z), grasp, 0.0, LOWER_SPEED, CLOSE_STEPS),
            (over(piece, CARRY_Z), grasp, 0.0, LIFT_SPEED, 0),
            (over(right, CARRY_Z), place, 0.0, FREE_SPEED, 0),
            (over(right, PLACE_Z), place, 0.0, PLACE_SPEED, 0),
            (over(right, PLACE_Z), place, RELEASE_OPENING, PLACE_SPEED, OPEN_STEPS),
            (over(right, RETREAT_Z), place, RELEASE_OPENING, LIFT_SPEED, 0),
        ]
