"""Plays a task's expert over many seeds and measures success, length, speed, smoothness and push force.

python scripts/bench_expert.py --env ur3e/slide-block --episodes 200 --write
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.progress import track

from manicm_ms.demos.experts import EXPERTS, Expert
from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.envs.maniskill import ManiSkillSimulator
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.evaluation.statistics import wilson_interval
from manicm_ms.robots.ur3e_ag95 import JOINT_SPEED
from manicm_ms.types import STATE

OUT = Path(__file__).resolve().parents[1] / "docs" / "results" / "expert.md"


@dataclass(frozen=True)
class EpisodeMotion:
    """One episode of an expert, measured once a control step.

    Attributes:
        seed: its seed.
        success: whether the task was solved.
        steps: control steps played.
        joint_speed: largest joint speed as a fraction of that joint's limit.
        tcp_speed: largest speed of the TCP, m/s.
        command_acceleration: largest acceleration of the commanded TCP target, m/s^2.
        tcp_acceleration: the same of the measured TCP.
        pad_force: largest force of a finger on an object at the end of a control step, N.
    """

    seed: int
    success: bool
    steps: int
    joint_speed: float
    tcp_speed: float
    command_acceleration: float
    tcp_acceleration: float
    pad_force: float


def play(rows: ActionChunk, expert: Expert, seed: int) -> EpisodeMotion:
    """Play the episode of `seed` in the only row of `rows`."""
    simulator = rows.simulator
    assert isinstance(simulator, ManiSkillSimulator)
    history, _ = rows.reset(torch.zeros(1, dtype=torch.int64), [seed])
    states = [history[STATE][:, -1]]
    expert.reset(states[0], [seed], torch.ones(1, dtype=torch.bool))
    force = 0.0
    while not (rows.terminated | rows.truncated).any():
        history, _, _ = rows.step(expert.act(states[-1])[:, None])
        states.append(history[STATE][:, -1])
        force = max(force, pad_force(simulator))
    return _measure(seed, bool(rows.success_once[0]), torch.cat(states).numpy().astype(float), simulator, force)


def pad_force(simulator: ManiSkillSimulator) -> float:
    """Return the largest force between a finger and an object now, newtons."""
    env = simulator.env
    forces = [force.norm(dim=1).max() for thing in env.objects.values() for force in env.agent.pad_forces(thing)]
    return float(torch.stack(forces).max())


def _measure(
    seed: int, success: bool, states: NDArray[np.float64], simulator: ManiSkillSimulator, force: float
) -> EpisodeMotion:
    spec = simulator.spec

    def part(name: str, width: int) -> NDArray[np.float64]:
        start, _ = spec.state_layout[name]
        return states[:, start : start + width]

    hz = spec.action.control_hz
    speed = np.abs(part("arm_qvel", 6)).max(axis=0) / np.array(JOINT_SPEED)
    tcp, target = (np.diff(part(name, 3), axis=0) * hz for name in ("tcp_pose", "tcp_target_pose"))  # (L, 3) m/s
    return EpisodeMotion(
        seed=seed,
        success=success,
        steps=len(states) - 1,
        joint_speed=float(speed.max()),
        tcp_speed=float(np.linalg.norm(tcp, axis=1).max()),
        command_acceleration=_largest_change(target) * hz,
        tcp_acceleration=_largest_change(tcp) * hz,
        pad_force=force,
    )


def _largest_change(velocity: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(velocity, axis=0, prepend=0.0), axis=1).max())


def run(env_id: str, style: str, seeds: range) -> list[EpisodeMotion]:
    """Play every seed once with the expert of `env_id` in `style`."""
    config = SimulatorConfig(obs=(STATE,))
    entry = ENVS.get(env_id)
    spec = config.specialise(entry.spec)
    rows = ActionChunk(entry.build(spec, config))
    expert = EXPERTS.get(env_id)(spec, 1, torch.device("cpu"), style)
    try:
        return [play(rows, expert, seed) for seed in track(seeds, description=f"{env_id} {style}")]
    finally:
        rows.simulator.close()


def table(results: dict[str, list[EpisodeMotion]]) -> str:
    """Return a Markdown table with one column a style."""
    lines = ["| | " + " | ".join(results) + " |", "|---|" + "---|" * len(results)]

    def line(name: str, cells: list[str]) -> None:
        lines.append(f"| {name} | " + " | ".join(cells) + " |")

    line("success", [_success(episodes) for episodes in results.values()])
    line("failed seeds", [str([e.seed for e in episodes if not e.success]) for episodes in results.values()])
    rows = {
        "control steps to the end": ("steps", "{:.0f}"),
        "peak joint speed / limit": ("joint_speed", "{:.0%}"),
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


def _success(episodes: list[EpisodeMotion]) -> str:
    k, n = sum(e.success for e in episodes), len(episodes)
    low, high = wilson_interval(k, n)
    return f"{k}/{n}, 95 % CI {low:.1%} to {high:.1%}"


def main() -> None:
    """Parse the command line, measure, print and, with --write, keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="ur3e/slide-block")
    parser.add_argument("--episodes", type=int, default=200, help="seeds 0 ... episodes - 1")
    parser.add_argument("--styles", nargs="+", help="all of them by default")
    parser.add_argument("--write", action="store_true", help=f"write {OUT.name} in docs/results")
    args = parser.parse_args()
    torch.set_num_threads(1)
    styles = args.styles or EXPERTS.get(args.env).styles  # type: ignore[attr-defined]
    results = {style: run(args.env, style, range(args.episodes)) for style in styles}
    text = table(results)
    print(text)
    if args.write:
        OUT.parent.mkdir(parents=True, exist_ok=True)
        OUT.write_text(_page(args.env, args.episodes, text), encoding="utf-8")


def _page(env_id: str, episodes: int, text: str) -> str:
    return f"""# The scripted expert of {env_id}

Seeds 0 to {episodes - 1}, one row on the CPU backend. Mean over the episodes, largest episode in brackets. Speeds and
accelerations are differences of states one control step (50 ms) apart; the command is the controller's TCP target,
which the arm follows about 0.1 s later. Forces are taken at the end of each control step. An episode ends with its
success.

{text}

Made by `python scripts/bench_expert.py --env {env_id} --episodes {episodes} --write`.
"""


if __name__ == "__main__":
    main()
