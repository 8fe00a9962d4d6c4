"""Measure how the AG-95 holds a cube and how it opens: `python scripts/results/gripper_hold.py`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.types import SceneConfig, SimConfig
from torch import Tensor

from manicm_ms.paths import write_text
from manicm_ms.robots.ag95 import knuckle_of_opening, opening_of_knuckle, pad_height_of_knuckle
from manicm_ms.robots.limits import pose_in_frame, quat_conjugate, quat_multiply, rotvec_from_quat
from manicm_ms.robots.ur3e_ag95 import TCP_STEP, UR3eAG95, opening_to_action

REPORT = Path(__file__).resolve().parents[2] / "docs" / "results" / "gripper_hold.md"
CONTROL_HZ = 20
CUBE_DENSITY = 1000.0  # kg/m^3
FRICTION = 0.6  # of the cube; with the pads' 1.5 the pair has 1.05
GRASP_ABOVE_CENTRE = 0.003  # m
SHAKE_SPEED = 0.2  # m/s
SHAKE_HALF_PERIOD = 10  # control steps: strokes of 0.1 m
REST_CLEARANCE = 3e-4  # m


@register_env("GripperHold-v0")
class GripperHoldEnv(BaseEnv):
    """The robot at a table, and a cube under its gripper whose edge (m) is `cube_size`."""

    SUPPORTED_ROBOTS = ("ur3e_ag95",)
    agent: UR3eAG95

    def __init__(self, *args: Any, cube_size: float = 0.04, **kwargs: Any) -> None:
        self.cube_size = cube_size
        super().__init__(*args, robot_uids="ur3e_ag95", **kwargs)

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(sim_freq=200, control_freq=CONTROL_HZ, scene_config=SceneConfig(contact_offset=0.005))

    def _load_agent(self, options: dict) -> None:
        super()._load_agent(options, sapien.Pose())

    def _load_scene(self, options: dict) -> None:
        material = sapien.physx.PhysxMaterial(FRICTION, FRICTION, 0.0)
        table = self.scene.create_actor_builder()
        table.add_box_collision(half_size=[0.4, 0.5, 0.02], material=material)
        table.initial_pose = sapien.Pose([0.25, 0.0, -0.02])
        table.build_static("table")
        cube = self.scene.create_actor_builder()
        cube.add_box_collision(half_size=[self.cube_size / 2] * 3, material=material, density=CUBE_DENSITY)
        cube.initial_pose = sapien.Pose([0.30, 0.0, self.cube_size / 2 + REST_CLEARANCE])
        self.cube = cube.build("cube")

    def _initialize_episode(self, env_idx: Tensor, options: dict) -> None:
        ready = self.agent.keyframes["ready"]
        self.agent.robot.set_pose(ready.pose)
        self.agent.reset(torch.tensor(ready.qpos).repeat(len(env_idx), 1))
        self.cube.set_pose(sapien.Pose([0.30, 0.0, self.cube_size / 2 + REST_CLEARANCE]))

    def evaluate(self) -> dict[str, Tensor]:
        """Return nothing: the measures are taken outside."""
        return {}

    def _get_obs_extra(self, info: dict) -> dict:
        return {}


def make_env(**kwargs: Any) -> GripperHoldEnv:
    """Build the environment without a renderer and reset it; `kwargs` go to it (cube_size, control_mode, ...)."""
    settings = {"obs_mode": "none", "reward_mode": "none", "sim_backend": "physx_cpu", "render_backend": "none"}
    env = gymnasium.make("GripperHold-v0", **(settings | kwargs)).unwrapped
    assert isinstance(env, GripperHoldEnv)
    env.reset(seed=0)
    return env


@dataclass(frozen=True)
class Hold:
    """What one hold of a cube came to: newtons, metres, degrees.

    Attributes:
        cube_size: edge of the cube.
        force: on each pad, left and right, mean over the hold.
        tilt: largest angle of the cube against its posture before the grasp.
        gap_error: distance between the pads minus the cube's edge at the end of the hold; negative where they sink in.
        off_centre: distance of the cube from the middle of the gripper along the closing axis.
        hold_slip, shake_slip: largest movement across the pads within 5 s of holding and of shaking.
        shake_give: largest movement along the closing axis within the shaking: the fingers' compliance.
        shake_tilt: largest turn of the cube within the shaking.
    """

    cube_size: float
    force: tuple[float, float]
    tilt: float
    gap_error: float
    off_centre: float
    hold_slip: float
    shake_slip: float
    shake_give: float
    shake_tilt: float


def act(env: GripperHoldEnv, translation: Sequence[float], opening: float) -> None:
    """Play one action: a translation of the tcp's target (m, this step) and an opening (m)."""
    action = [*(np.asarray(translation) / TCP_STEP), 0.0, 0.0, 0.0, opening_to_action(opening)]
    env.step(torch.tensor([action], dtype=torch.float32))


def cube_in_tcp(env: GripperHoldEnv) -> Tensor:
    """Return the cube's pose in the tcp's frame, (7,)."""
    return pose_in_frame(env.cube.pose.raw_pose, env.agent.tcp_pose.raw_pose)[0]


def turn_deg(pose: Tensor, reference: Tensor) -> float:
    """Return the angle between the rotations of two poses (7,), degrees."""
    turn = rotvec_from_quat(quat_multiply(pose[None, 3:], quat_conjugate(reference[None, 3:])))
    return float(torch.rad2deg(torch.linalg.norm(turn)))


def grasp_and_lift(env: GripperHoldEnv, height: float = 0.12) -> Tensor:
    """Go down over the cube, close, and lift it; return the cube's pose in the tcp's frame before closing, (7,)."""
    opening = env.cube_size + 0.04
    down = 0.25 - (env.cube_size / 2 + GRASP_ABOVE_CENTRE)
    steps = int(np.ceil(down / (0.7 * TCP_STEP)))
    for _ in range(steps):
        act(env, (0, 0, -down / steps), opening)
    for _ in range(CONTROL_HZ):
        act(env, (0, 0, 0), opening)
    before = cube_in_tcp(env)
    for _ in range(2 * CONTROL_HZ):
        act(env, (0, 0, 0), 0.0)
    for _ in range(CONTROL_HZ):
        act(env, (0, 0, height / CONTROL_HZ), 0.0)
    for _ in range(CONTROL_HZ):
        act(env, (0, 0, 0), 0.0)
    return before


def shake_directions(steps: int) -> np.ndarray:
    """Return unit directions (steps, 3): there and back about the start along x, y and z in turn."""
    stroke = np.ones(SHAKE_HALF_PERIOD)
    wave = np.concatenate([stroke[: SHAKE_HALF_PERIOD // 2], -stroke, stroke[: SHAKE_HALF_PERIOD // 2]])
    cycles = [np.outer(wave, axis) for axis in np.eye(3)]
    cycle = np.concatenate(cycles)
    return np.tile(cycle, (-(-steps // len(cycle)), 1))[:steps]


def measure_hold(cube_size: float, seconds: float) -> Hold:
    """Grasp and lift a cube, hold it still and shake it, each for `seconds`."""
    env = make_env(cube_size=cube_size)
    before = grasp_and_lift(env)
    steps = round(seconds * CONTROL_HZ)
    start, poses, forces = cube_in_tcp(env), [], []
    for _ in range(steps):
        act(env, (0, 0, 0), 0.0)
        poses.append(cube_in_tcp(env))
        forces.append([float(torch.linalg.norm(force)) for force in env.agent.pad_forces(env.cube)])
    gap_error = float(env.agent.opening[0]) - cube_size
    rest, shaken = cube_in_tcp(env), []
    for direction in shake_directions(steps):
        act(env, direction * SHAKE_SPEED / CONTROL_HZ, 0.0)
        shaken.append(cube_in_tcp(env))
    held = bool(env.agent.is_grasping(env.cube)[0])
    env.close()
    if not held:
        raise RuntimeError(f"the {cube_size * 1e3:.0f} mm cube was lost while it was shaken")
    hold, shake = torch.stack(poses) - start, torch.stack(shaken) - rest
    left, right = np.mean(forces, axis=0)
    return Hold(
        cube_size=cube_size,
        force=(float(left), float(right)),
        tilt=max(turn_deg(pose, before) for pose in poses),
        gap_error=gap_error,
        off_centre=float(rest[0].abs()),
        hold_slip=float(hold[:, 1:3].norm(dim=1).max()),
        shake_slip=float(shake[:, 1:3].norm(dim=1).max()),
        shake_give=float(shake[:, 0].abs().max()),
        shake_tilt=max(turn_deg(pose, rest) for pose in shaken),
    )


def pad_distance(env: GripperHoldEnv) -> float:
    """Return the distance between the two grip faces, metres, from the poses of the finger links."""
    left, right = env.agent.left_finger.pose.p[0], env.agent.right_finger.pose.p[0]
    return float(torch.linalg.norm(left - right))


def measure_opening(angles: Sequence[float]) -> list[tuple[float, float, float]]:
    """Command the opening that the linkage has at each knuckle angle (rad); return (angle, formula, measured), m."""
    env = make_env()
    rows = []
    for angle in angles:
        opening = opening_of_knuckle(angle)
        for _ in range(3 * CONTROL_HZ):
            act(env, (0, 0, 0), opening)
        rows.append((angle, opening, pad_distance(env)))
    env.close()
    return rows


def hold_table(holds: Sequence[Hold]) -> list[str]:
    """Return the hold measures as lines of a Markdown table, one column per cube."""
    rows: list[tuple[str, list[str]]] = [
        ("Force on the left / right pad, N", [f"{h.force[0]:.1f} / {h.force[1]:.1f}" for h in holds]),
        ("Tilt of the cube against its posture before the grasp, deg", [f"{h.tilt:.2f}" for h in holds]),
        ("Gap error (distance of the pads minus the edge), mm", [f"{h.gap_error * 1e3:+.2f}" for h in holds]),
        ("Penetration per pad, mm", [f"{max(-h.gap_error, 0) / 2 * 1e3:.2f}" for h in holds]),
        ("Off the gripper's middle along the closing axis, mm", [f"{h.off_centre * 1e3:.2f}" for h in holds]),
        ("Slip across the pads while held, mm", [f"{h.hold_slip * 1e3:.3f}" for h in holds]),
        ("Slip across the pads while shaken, mm", [f"{h.shake_slip * 1e3:.3f}" for h in holds]),
        ("Give along the closing axis while shaken, mm", [f"{h.shake_give * 1e3:.2f}" for h in holds]),
        ("Turn of the cube while shaken, deg", [f"{h.shake_tilt:.2f}" for h in holds]),
    ]
    head = [
        "| measure | " + " | ".join(f"{h.cube_size * 1e3:.0f} mm" for h in holds) + " |",
        "|---" * (len(holds) + 1) + "|",
    ]
    return head + [f"| {name} | " + " | ".join(cells) + " |" for name, cells in rows]


def opening_table(rows: Sequence[tuple[float, float, float]]) -> list[str]:
    """Return the opening measures as lines of a Markdown table."""
    pad_40 = pad_height_of_knuckle(knuckle_of_opening(0.04))
    lines = [
        "| knuckle angle, rad | opening by the formula, mm | measured, mm | pads' height left out, mm |",
        "|---|---|---|---|",
    ]
    for angle, formula, measured in rows:
        lift = (pad_height_of_knuckle(angle) - pad_40) * 1e3
        lines.append(f"| {angle:.3f} | {formula * 1e3:.2f} | {measured * 1e3:.2f} | {lift:+.1f} |")
    return lines


TEXT = """# How the AG-95 holds a cube in simulation

Command: `python scripts/results/gripper_hold.py` (CPU PhysX, 200 Hz, control 20 Hz; no renderer).

The gripper takes a cube (density {density:.0f} kg/m3, friction {friction}) from the table with the command "closed",
lifts it by 120 mm, holds it still for {seconds:g} s and shakes it for {seconds:g} s along x, y and z at {speed} m/s
with sudden turns. Maxima over the time, but forces, which are means. Finger drives: stiffness {stiffness:.0f} N/m,
damping {damping:.0f} N s/m, at most {limit:.0f} N. The fingers slide on prismatic joints: they are parallel to
rounding at all times.

{holds}

## Opening: command against measurement

The opening that the four-bar linkage has at a knuckle angle is commanded; measured is the distance between the grip
faces. The last column is what the sliding fingers leave out: how far the real pads stand from the height they have at
an opening of 40 mm.

{openings}
"""


def report(holds: Sequence[Hold], openings: Sequence[tuple[float, float, float]], seconds: float) -> str:
    """Return the whole report as Markdown."""
    return TEXT.format(
        density=CUBE_DENSITY,
        friction=FRICTION,
        seconds=seconds,
        speed=SHAKE_SPEED,
        stiffness=UR3eAG95.finger_stiffness,
        damping=UR3eAG95.finger_damping,
        limit=UR3eAG95.finger_force_limit,
        holds="\n".join(hold_table(holds)),
        openings="\n".join(opening_table(openings)),
    )


def main() -> None:
    """Parse the command line, measure, write the report and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=REPORT, help="Markdown file to write")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of the hold and of the shaking")
    args = parser.parse_args()
    torch.set_num_threads(1)
    holds = [measure_hold(size, args.seconds) for size in (0.03, 0.04, 0.05)]
    closed = knuckle_of_opening(0.0)
    openings = measure_opening([0.0, 0.2, 0.4, 0.6, 0.8, closed])
    text = report(holds, openings, args.seconds)
    write_text(args.out, text)
    print(text)


if __name__ == "__main__":
    main()
