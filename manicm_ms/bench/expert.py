"""Plays the tasks' experts over many seeds and measures success, length, speed, smoothness, torque and grip force.

Every episode is noted in a file of records as it ends; the same command goes on where it was stopped.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from manicm_ms.bench.pages import publish, results_page
from manicm_ms.demos.experts import EXPERTS, Expert, require_style
from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.envs.maniskill import ManiSkillSimulator
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.intervals import rate_interval
from manicm_ms.progress import progress_of
from manicm_ms.robots.ur3e_ag95 import ARM_JOINTS, JOINT_EFFORT, JOINT_SPEED
from manicm_ms.spec import STATE

PAGE = "expert.md"
TAG = "real-robot"
GRIP_FORCE = (45.0, 160.0)  # N, of the AG-95 (data sheet)
_ABOUT_AXIS = 3  # a joint's own frame has x along its axis: of (force, torque) the fourth is the torque about it

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class EpisodeMotion:
    """One episode of an expert, measured once a control step.

    Attributes:
        seed: its seed.
        success: whether the task was solved.
        steps: control steps played.
        joint_speed: (6,) largest speed of each arm joint, rad/s.
        joint_torque: (6,) largest torque that the simulation put on each arm joint, Nm.
        real_torque: (6,) the same with the weight of the arm, which the simulation leaves out, Nm.
        tcp_speed: largest speed of the TCP, m/s.
        command_acceleration: largest acceleration of the commanded TCP target, m/s^2.
        tcp_acceleration: the same of the measured TCP.
        pad_force: largest force of a finger on an object at the end of a control step, N.
    """

    seed: int
    success: bool
    steps: int
    joint_speed: Floats
    joint_torque: Floats
    real_torque: Floats
    tcp_speed: float
    command_acceleration: float
    tcp_acceleration: float
    pad_force: float


class TorqueMeter:
    """Takes the torque on each arm joint after every physics step of the only row of a simulator.

    The torque is the part about the joint's axis of what PhysX calls the incoming joint force of its child link: all
    that the joint transmits, averaged over the physics step, hence what the drive exerts (with the joint's friction). A
    test holds it against inverse dynamics. The drive law K (target - q) - D dq is no substitute: PhysX integrates it
    implicitly, so that its value before a step exceeds and its value after a step falls short of what acts.

    Gravity is off on the robot's links, as a real arm's controller compensates it; its motors still have to. `real`
    therefore adds the torque that holds the arm's weight (Pinocchio, at the configuration after the step).
    """

    def __init__(self, simulator: ManiSkillSimulator) -> None:
        self._env = simulator.env
        self.drive: list[Floats] = []  # (8,) Nm and N, a physics step each, in the order of the active joints
        self.real: list[Floats] = []
        self._env._after_simulation_step = self._sample

    def start(self) -> None:
        """Look up the robot, which every episode builds anew, and forget what was measured."""
        self.drive, self.real = [], []
        self._robot = self._env.agent.robot._objs[0]
        self._model = self._robot.create_pinocchio_model()
        self._links = [joint.child_link.index for joint in self._robot.active_joints]

    def _sample(self) -> None:
        torque = self._robot.get_link_incoming_joint_forces()[self._links, _ABOUT_AXIS].astype(np.float64)
        qpos = self._robot.get_qpos().astype(np.float64)
        still = np.zeros_like(qpos)
        self.drive.append(torque)
        self.real.append(torque + np.asarray(self._model.compute_inverse_dynamics(qpos, still, still)).ravel())

    def largest(self) -> tuple[Floats, Floats]:
        """Return the largest magnitude of `drive` and of `real` on each arm joint, each (6,) Nm."""
        arm = self._env.agent._arm_columns
        return np.abs(self.drive).max(axis=0)[arm], np.abs(self.real).max(axis=0)[arm]


def play(rows: ActionChunk, expert: Expert, meter: TorqueMeter, seed: int) -> EpisodeMotion:
    """Play the episode of `seed` in the only row of `rows`."""
    simulator = rows.simulator
    assert isinstance(simulator, ManiSkillSimulator)
    history, _ = rows.reset(torch.zeros(1, dtype=torch.int64), [seed])
    meter.start()
    states = [history[STATE][:, -1]]
    expert.reset(states[0], [seed], torch.ones(1, dtype=torch.bool))
    force = 0.0
    while not (rows.terminated | rows.truncated).any():
        history, _, _ = rows.step(expert.act(states[-1])[:, None])
        states.append(history[STATE][:, -1])
        force = max(force, pad_force(simulator))
    motion = torch.cat(states).numpy().astype(float)
    return _measure(seed, bool(rows.success_once[0]), motion, simulator, meter, force)


def pad_force(simulator: ManiSkillSimulator) -> float:
    """Return the largest force between a finger and an object now, newtons."""
    env = simulator.env
    forces = [force.norm(dim=1).max() for thing in env.objects.values() for force in env.agent.pad_forces(thing)]
    return float(torch.stack(forces).max())


def _measure(
    seed: int, success: bool, states: Floats, simulator: ManiSkillSimulator, meter: TorqueMeter, force: float
) -> EpisodeMotion:
    spec = simulator.spec

    def part(name: str, width: int) -> Floats:
        start, _ = spec.state_layout[name]
        return states[:, start : start + width]

    hz = spec.action.control_hz
    tcp, target = (np.diff(part(name, 3), axis=0) * hz for name in ("tcp_pose", "tcp_target_pose"))  # (L, 3) m/s
    torque, real = meter.largest()
    return EpisodeMotion(
        seed=seed,
        success=success,
        steps=len(states) - 1,
        joint_speed=np.abs(part("arm_qvel", 6)).max(axis=0),
        joint_torque=torque,
        real_torque=real,
        tcp_speed=float(np.linalg.norm(tcp, axis=1).max()),
        command_acceleration=_largest_change(target) * hz,
        tcp_acceleration=_largest_change(tcp) * hz,
        pad_force=force,
    )


def _largest_change(velocity: Floats) -> float:
    return float(np.linalg.norm(np.diff(velocity, axis=0, prepend=0.0), axis=1).max())


def run(env_id: str, style: str, seeds: range, records: Path) -> list[EpisodeMotion]:
    """Play every seed once with the expert of `env_id` in `style`, those that `records` (JSON lines) lacks."""
    known = {episode.seed: episode for episode in _read(records)}
    config = SimulatorConfig(obs=(STATE,))
    entry = ENVS.get(env_id)
    spec = config.specialise(entry.spec)
    missing = [seed for seed in seeds if seed not in known]
    if missing:
        simulator = entry.build(spec, config)
        if not isinstance(simulator, ManiSkillSimulator):
            simulator.close()
            raise ConfigError(f"{env_id} does not run on ManiSkill: its torques cannot be measured")
        rows, meter = ActionChunk(simulator), TorqueMeter(simulator)
        expert = EXPERTS.get(env_id)(spec, 1, torch.device("cpu"), style)
        records.parent.mkdir(parents=True, exist_ok=True)
        with records.open("a", encoding="utf-8") as file:
            file.write("\n" * _cut_short(records))
            for seed in progress_of(missing, f"{env_id} {style}"):
                known[seed] = play(rows, expert, meter, seed)
                file.write(json.dumps(asdict(known[seed]), default=np.ndarray.tolist) + "\n")
                file.flush()
        simulator.close()
    return [known[seed] for seed in seeds]


def _read(records: Path) -> list[EpisodeMotion]:
    """Return the episodes on disk, but for a line that a kill cut short."""
    lines = records.read_text(encoding="utf-8").splitlines() if records.exists() else []
    return [_episode(json.loads(line)) for line in lines if line.endswith("}")]


def _episode(entry: dict[str, Any]) -> EpisodeMotion:
    values: dict[str, Any] = {name: np.array(v) if isinstance(v, list) else v for name, v in entry.items()}
    return EpisodeMotion(**values)


def _cut_short(records: Path) -> bool:
    return records.exists() and records.read_text(encoding="utf-8")[-1:] not in ("\n", "")


Results = dict[str, list[EpisodeMotion]]
"""Episodes of each expert, under "env id" or, where it has several styles, "env id, style"."""


def summary_table(results: Results) -> str:
    """Return a Markdown table with one column an expert."""
    lines = ["| | " + " | ".join(results) + " |", "|---|" + "---|" * len(results)]

    def line(name: str, cells: list[str]) -> None:
        lines.append(f"| {name} | " + " | ".join(cells) + " |")

    line("success", [_success(episodes) for episodes in results.values()])
    line("failed seeds", [str([e.seed for e in episodes if not e.success]) for episodes in results.values()])
    rows = {
        "control steps to the end": ("steps", "{:.0f}"),
        "peak TCP speed, m/s": ("tcp_speed", "{:.3f}"),
        "peak acceleration of the command, m/s²": ("command_acceleration", "{:.2f}"),
        "peak acceleration of the TCP, m/s²": ("tcp_acceleration", "{:.2f}"),
        "peak force of a finger on an object, N": ("pad_force", "{:.1f}"),
    }
    for name, (attribute, form) in rows.items():
        cells = []
        for episodes in results.values():
            values = np.array([getattr(e, attribute) for e in episodes])
            cells.append(f"{form.format(values.mean())} (max {form.format(values.max())})")
        line(name, cells)
    return "\n".join(lines)


def joint_table(results: Results, attribute: str, limits: tuple[float, ...], form: str) -> str:
    """Return a Markdown table of the largest value of each arm joint over all episodes, beside its limit."""
    lines = ["| joint | limit | " + " | ".join(results) + " |", "|---|---|" + "---|" * len(results)]
    largest = [np.max([getattr(e, attribute) for e in episodes], axis=0) for episodes in results.values()]
    for k, (name, limit) in enumerate(zip(ARM_JOINTS, limits, strict=True)):
        cells = " | ".join(f"{form.format(column[k])} ({column[k] / limit:.0%})" for column in largest)
        lines.append(f"| {name.removesuffix('_joint')} | {form.format(limit)} | {cells} |")
    return "\n".join(lines)


def _success(episodes: list[EpisodeMotion]) -> str:
    k, n = sum(e.success for e in episodes), len(episodes)
    low, high = rate_interval(k, n)
    return f"{k}/{n}, 95 % CI {low:.1%} to {high:.1%}"


def bench(
    env_ids: Sequence[str], styles: Sequence[str] | None, episodes: int, records: Path, write: bool, command: str
) -> None:
    """Measure as `measure` does, print the page, and keep it in docs/results where `write` says so.

    `command` is what the page names as its origin.
    """
    page = results_page(PAGE) if write else None
    torch.set_num_threads(1)
    publish(_page(episodes, measure(env_ids or ENVS.names(TAG), styles, episodes, records), command), page)


def measure(env_ids: Sequence[str], styles: Sequence[str] | None, episodes: int, records: Path) -> Results:
    """Play the experts of `env_ids` in `styles`, all of them for None, on seeds 0 ... episodes - 1.

    Raises ConfigError for a number of episodes below 1, UnknownNameError for an environment without expert or a style
    that one does not have.
    """
    if episodes < 1:
        raise ConfigError(f"episodes must be at least 1, got {episodes}")
    known: dict[str, tuple[str, ...]] = {name: EXPERTS.get(name).styles for name in env_ids}  # type: ignore[attr-defined]
    asked = [(name, require_style(style, known[name])) for name in env_ids for style in styles or known[name]]
    results: Results = {}
    for env_id, style in asked:
        name = env_id if len(known[env_id]) == 1 else f"{env_id}, {style}"
        results[name] = run(env_id, style, range(episodes), records / f"{env_id.replace('/', '-')}-{style}.jsonl")
    return results


def _page(episodes: int, results: Results, command: str) -> str:
    force = max(e.pad_force for played in results.values() for e in played)
    return f"""# The scripted experts

Seeds 0 to {episodes - 1}, one row on the CPU backend. Mean over the episodes, largest episode in brackets.
Accelerations are differences of states one control step (50 ms) apart; the command is the controller's TCP target,
which the arm follows about 0.1 s later. Forces are taken at the end of each control step. An episode ends with its
success. Intervals are Clopper-Pearson's.

{summary_table(results)}

A real AG-95 can be set to grip with {GRIP_FORCE[0]:.0f} to {GRIP_FORCE[1]:.0f} N. The fingers here press with
{force:.1f} N at most: never more than the gripper can, and less than its least setting, which these light objects do
not need; they were not played with 45 N.

## Largest speed of each arm joint, rad/s (share of its limit)

{joint_table(results, "joint_speed", JOINT_SPEED, "{:.2f}")}

## Largest torque on each arm joint in the simulation, Nm (share of its limit)

What the joint transmitted about its axis in any physics step of 5 ms (PhysX's incoming joint force, which agrees with
inverse dynamics of the motion). The peaks fall on the first physics step of a control step, when the drive's target
jumps. Gravity is off on the robot's links, as if compensated.

{joint_table(results, "joint_torque", JOINT_EFFORT, "{:.1f}")}

## The same with the weight of arm and gripper, Nm (share of its limit)

What a real arm's motors would have to give: the torque above and the one that holds the weight at the same moment
(Pinocchio, masses of the robot's description).

{joint_table(results, "real_torque", JOINT_EFFORT, "{:.1f}")}

Made by `{command}`.
"""
