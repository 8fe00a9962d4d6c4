"""What each realism preset costs a control step and how the expert fares under it.

Presets take turns seed by seed, so that a busy machine troubles all alike.
"""

from __future__ import annotations

import gc
import os
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from manicm_ms.bench.pages import publish, results_page
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.simulator import ENVS, Simulator, SimulatorConfig
from manicm_ms.sensing.realism import REALISM
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, STATE

PAGE = "realism.md"


@dataclass(frozen=True)
class Options:
    """What to measure.

    Attributes:
        envs: environment ids.
        presets: realism presets.
        episodes: seeds played by the expert under each of them.
        seed: the first seed.
    """

    envs: tuple[str, ...]
    presets: tuple[str, ...]
    episodes: int
    seed: int

    def __post_init__(self) -> None:
        for env_id in self.envs:
            EXPERTS.get(env_id)
        for preset in self.presets:
            REALISM.get(preset)


@dataclass
class Tally:
    """What was counted under one preset: steps, seconds of CPU time and of the clock, successes, points of clouds."""

    steps: int = 0
    cpu: float = 0.0
    wall: float = 0.0
    successes: int = 0
    seen: list[int] = field(default_factory=list)


@torch.inference_mode()
def play(simulator: Simulator, env_id: str, seed: int, tally: Tally) -> None:
    """Play one seed with the expert, every frame rendered, and count."""
    simulator.reset(torch.zeros(1, dtype=torch.int64), [seed])
    expert = EXPERTS.get(env_id)(simulator.spec, 1, torch.device("cpu"), None)
    frame = simulator.observe()
    expert.reset(frame[STATE], [seed], torch.ones(1, dtype=torch.bool))
    tally.seen.append(len(torch.unique(frame[POINT_CLOUD][0], dim=0)))
    cpu, wall = time.process_time(), time.perf_counter()
    for _ in range(simulator.spec.max_episode_steps):
        result = simulator.step(expert.act(frame[STATE]).clamp(-1, 1))
        frame = simulator.observe()
        tally.steps += 1
        if result.terminated.any():
            tally.successes += int(result.info["success"].any())
            break
    tally.cpu += time.process_time() - cpu
    tally.wall += time.perf_counter() - wall


def measure(env_id: str, options: Options) -> dict[str, Tally]:
    """Return what was counted under each preset."""
    entry = ENVS.get(env_id)
    configs = {
        name: SimulatorConfig(obs=(POINT_CLOUD, AGENT_POS, STATE), realism=REALISM.get(name))
        for name in options.presets
    }
    simulators = {name: entry.build(config.specialise(entry.spec), config) for name, config in configs.items()}
    gc.freeze()  # as in a worker
    tallies = {name: Tally() for name in options.presets}
    for seed in range(options.seed, options.seed + options.episodes):
        for name, simulator in simulators.items():
            play(simulator, env_id, seed, tallies[name])
    for simulator in simulators.values():
        simulator.close()
    return tallies


def page(results: Mapping[str, Mapping[str, Tally]], options: Options, command: str) -> str:
    """Return the Markdown page, which names `command` as its origin."""
    lines = [
        "# Realism presets: what they cost, and the expert under them",
        "",
        f"{options.episodes} seeds from {options.seed} on, every frame rendered, one process, one torch thread of",
        f"{platform.machine()}, torch {torch.__version__}, load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores.",
        "CPU time counts the renderer's threads and hardly depends on the load; steps/s by the clock do. A cloud's",
        "points are the different ones among its 512, in the first frame of an episode: mean.",
        "",
        "| task | preset | expert | CPU time a step | steps/s | points at the start |",
        "|---|---|---|---|---|---|",
    ]
    for env_id, tallies in results.items():
        for name, tally in tallies.items():
            lines.append(
                f"| {env_id} | {name} | {tally.successes}/{options.episodes} | {1e3 * tally.cpu / tally.steps:.1f} ms "
                f"| {tally.steps / tally.wall:.0f} | {sum(tally.seen) / len(tally.seen):.0f} |"
            )
    return "\n".join([*lines, "", f"Made by `{command}`.", ""])


def bench(options: Options, write: bool, command: str) -> None:
    """Measure, print the page, and keep it in docs/results where `write` says so."""
    kept = results_page(PAGE) if write else None
    torch.set_num_threads(1)
    publish(page({env_id: measure(env_id, options) for env_id in options.envs}, options, command), kept)
