"""Measures how fast point-cloud environments run: ours, stock ManiSkill beside it, and where the time goes."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import mani_skill.envs  # noqa: F401  (registers PickCube-v1)
import numpy as np
import psutil
import torch

from manicm_ms.bench.pages import results_page
from manicm_ms.envs.backends import resolve_backend
from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.envs.maniskill import ManiSkillSimulator, gym_id
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.envs.vector import VecEnv
from manicm_ms.envs.worker import RowEnv
from manicm_ms.errors import require_at_least
from manicm_ms.machine import vulkan
from manicm_ms.paths import write_text

PAGES = {"cpu": "env_speed.md", "gpu": "env_speed_gpu.md"}
NUM_ENVS = {"cpu": (1, 2, 4), "gpu": (1, 16, 64, 256)}
SIZE, STOCK_ID = 84, "PickCube-v1"
SMALL = 0.3  # largest entry of the random actions
WARM_UP_STEPS = 30

Player = Callable[[int], None]
"""Plays that many control steps (of all rows), resetting rows whose episode has ended."""


@dataclass
class Timed:
    """Repetitions of one contestant.

    Attributes:
        rates: control steps of all rows per second, one entry a repetition.
        cpu_ms: processor time of all its processes per control step, ms, one entry a repetition.
    """

    rates: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)

    def take(self, play: Player, steps: int, rows: int) -> None:
        """Play `steps` control steps of `rows` rows and note how long they took."""
        wall, cpu = time.perf_counter(), _cpu_seconds()
        play(steps)
        self.rates.append(steps * rows / (time.perf_counter() - wall))
        self.cpu_ms.append((_cpu_seconds() - cpu) * 1e3 / (steps * rows))


def _cpu_seconds() -> float:
    """Return the processor time that this process and its worker processes have used."""
    me = psutil.Process()
    times = [process.cpu_times() for process in (me, *me.children(recursive=True))]
    return sum(t.user + t.system for t in times)


def vec_player(env: VecEnv, seed: int) -> Player:
    """Return a player of small random actions on a vector environment."""
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)

    def play(steps: int) -> None:
        for _ in range(steps):
            action = rng.uniform(-SMALL, SMALL, env.action_space.shape).astype(np.float32)
            *_, terminated, truncated, _ = env.step(action)
            ended = (terminated | truncated).numpy(force=True)
            if ended.any():
                env.reset(options={"reset_mask": ended})

    play(WARM_UP_STEPS)
    return play


def stock_player(env: gymnasium.Env[Any, Any], seed: int) -> Player:
    """Return a player of small random actions on a ManiSkill environment of one row."""
    rng = np.random.default_rng(seed)
    env.reset(seed=seed)
    shape = env.action_space.shape

    def play(steps: int) -> None:
        for _ in range(steps):
            *_, terminated, truncated, _ = env.step(rng.uniform(-SMALL, SMALL, shape).astype(np.float32))
            if bool(torch.as_tensor(terminated | truncated).any()):
                env.reset()

    play(WARM_UP_STEPS)
    return play


def in_turn(players: dict[str, Player], steps: dict[str, int], rows: int, repetitions: int) -> dict[str, Timed]:
    """Let the players run alternately, so that a busy spell of the machine meets all of them."""
    timed = {name: Timed() for name in players}
    for _ in range(repetitions):
        for name, play in players.items():
            timed[name].take(play, steps[name], rows)
    return timed


# ---- where the time goes --------------------------------------------------------------------------------------


class Stopwatch:
    """Adds up the time spent in named parts while it runs."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.running = False

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time of the block towards `name`."""
        start = time.perf_counter()
        yield
        if self.running:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def watch(self, owner: Any, method: str, name: str) -> None:
        """Replace `owner.method` (of this instance alone) by one whose time counts towards `name`."""
        call = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.part(name):
                return call(*args, **kwargs)

        setattr(owner, method, timed)


def shares(env_id: str, steps: int) -> dict[str, float]:
    """Return the milliseconds per control step of each part of a worker's work, measured in this process."""
    config = SimulatorConfig(image_size=(SIZE, SIZE))
    entry = ENVS.get(env_id)
    simulator = entry.build(config.specialise(entry.spec), config)
    assert isinstance(simulator, ManiSkillSimulator)
    rows, watch, only = ActionChunk(simulator), Stopwatch(), torch.zeros(1, dtype=torch.int64)
    _watch_simulator(watch, simulator)
    rng = np.random.default_rng(0)
    rows.reset(only, [0])
    _watch_scene(watch, simulator)
    for step in range(WARM_UP_STEPS + steps):
        if (rows.terminated | rows.truncated).any():
            watch.running = False
            rows.reset(only, [step])
            _watch_scene(watch, simulator)
        watch.running = step >= WARM_UP_STEPS
        action = rng.uniform(-SMALL, SMALL, (1, 1, simulator.spec.action.dim)).astype(np.float32)
        with watch.part("all"):
            rows.step(torch.from_numpy(action))
    simulator.close()
    parts = {name: seconds * 1e3 / steps for name, seconds in watch.seconds.items()}
    total = parts.pop("all")
    return parts | {"rest (observation of the robot, bookkeeping)": total - sum(parts.values())}


def _watch_simulator(watch: Stopwatch, simulator: ManiSkillSimulator) -> None:
    watch.watch(simulator, "_shoot", "rendering")
    watch.watch(simulator, "_pictures", "rendering")
    watch.watch(simulator._view, "frame", "cloud (frame, crop, sampling)")
    watch.watch(simulator.env, "evaluate", "evaluate")


def _watch_scene(watch: Stopwatch, simulator: ManiSkillSimulator) -> None:
    """Watch what every reset builds anew."""
    watch.watch(simulator.env.scene, "step", "physics")
    watch.watch(simulator.env.agent, "set_action", "controller (limits, inverse kinematics)")


# ---- the report -----------------------------------------------------------------------------------------------


def bench_against_stock(env_id: str, repetitions: int) -> str:
    """Run one worker of ours, the same without the process around it, and stock ManiSkill in turn; return Markdown."""
    ours = make_vec(env_id, 1, "cpu", image_size=(SIZE, SIZE))
    row = RowEnv(env_id, ENVS.get(env_id).module, SimulatorConfig(image_size=(SIZE, SIZE)), None)
    camera = {"width": SIZE, "height": SIZE}
    stock = gymnasium.make(STOCK_ID, num_envs=1, obs_mode="pointcloud", sensor_configs=camera)
    try:
        worker, here = f"{env_id}, one worker", f"{env_id}, in the measuring process"
        players = {worker: vec_player(ours, 0), here: stock_player(row, 0), STOCK_ID: stock_player(stock, 0)}
        timed = in_turn(players, {worker: 200, here: 200, STOCK_ID: 40}, 1, repetitions)
    finally:
        for env in (ours, row, stock):
            env.close()
    stock_rates = np.array(timed[STOCK_ID].rates)
    lines = [
        "| | control steps/s: median | best | CPU ms per step |",
        "|---|---|---|---|",
        *(_row(name, t) for name, t in timed.items()),
        "",
        "Ratio to PickCube-v1, repetition by repetition:",
        "",
        *(f"- {name}: {_spread(np.array(timed[name].rates) / stock_rates)}" for name in (worker, here)),
    ]
    return "\n".join(lines)


def bench_rows(env_id: str, backend: str, counts: Sequence[int], repetitions: int) -> str:
    """Run environments of several numbers of rows, one after the other; return Markdown."""
    what = "workers" if backend == "cpu" else "rows"
    lines = [f"| {what} | control steps/s of all rows: median | best | CPU ms per step |", "|---|---|---|---|"]
    for count in counts:
        env = make_vec(env_id, count, backend, image_size=(SIZE, SIZE))
        try:
            lines.append(_row(str(count), in_turn({"": vec_player(env, 0)}, {"": 150}, count, repetitions)[""]))
        finally:
            env.close()
    return "\n".join(lines)


def _spread(ratios: np.ndarray) -> str:
    return f"median **{np.median(ratios):.1f}**, {ratios.min():.1f} to {ratios.max():.1f} over {len(ratios)}"


def _row(name: str, timed: Timed) -> str:
    rates = np.array(timed.rates)
    return f"| {name} | {np.median(rates):.0f} | {rates.max():.0f} | {np.median(timed.cpu_ms):.1f} |"


def shares_table(parts: dict[str, float]) -> str:
    """Return Markdown of the time of each part."""
    total = sum(parts.values())
    lines = ["| part | ms per control step | share |", "|---|---|---|"]
    lines += [f"| {name} | {ms:.2f} | {ms / total:.0%} |" for name, ms in parts.items()]
    return "\n".join([*lines, f"| all | {total:.2f} | |"])


def machine() -> str:
    """Return one line about what this ran on, and how busy it was with other work."""
    gpu = f", {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    load = os.getloadavg()[0]
    return f"{os.cpu_count()} cores ({platform.machine()}){gpu}, Vulkan device {vulkan.probe().device}, load {load:.1f}"


def measure(env_id: str, backend: str, counts: Sequence[int], repetitions: int, write: bool, command: str) -> None:
    """Measure what `backend` allows, print the tables, and keep the page in docs/results where `write` says so.

    Args:
        env_id: environment of ours.
        backend: "cpu" or "gpu".
        counts: numbers of rows, one run each; by default those of `NUM_ENVS`.
        repetitions: of each run; medians and best are taken over them.
        write: whether to keep the page.
        command: what the page names as its origin.

    Raises:
        ConfigError: a backend that cannot run here, an environment that is not one of ManiSkill, a count below 1, or
            a page to keep outside of a checkout.
        UnknownNameError: an unknown environment.
    """
    page = results_page(PAGES[backend]) if write else None
    resolve_backend(backend)
    gym_id(env_id)  # what cannot be measured is refused before anything is
    for count in counts:
        require_at_least(1, num_envs=count)
    torch.set_num_threads(1)  # as in a worker; more of them would fight the software renderer
    sections = {"Machine": f"At the start: {machine()}."}
    if backend == "cpu":
        sections["One worker against stock ManiSkill, in turn"] = bench_against_stock(env_id, repetitions)
        sections["Where a worker's time goes"] = shares_table(shares(env_id, 400))
    sections["In parallel"] = bench_rows(env_id, backend, counts or NUM_ENVS[backend], repetitions)
    text = "\n\n".join(f"## {title}\n\n{body}" for title, body in sections.items())
    print(text)
    if page is not None:
        around = _page if backend == "cpu" else _gpu_page
        write_text(page, around(env_id, text, command))


def _gpu_page(env_id: str, text: str, command: str) -> str:
    return f"""# Speed of the environments on a GPU

{env_id} at {SIZE}x{SIZE} pixels, cloud of 512 points and proprioception at every control step, small random actions,
rows reset as their episodes end. All rows are simulated and rendered together in one process; every step is waited for.

{text}

Made by `{command}`.
"""


def _page(env_id: str, text: str, command: str) -> str:
    return f"""# Speed of the environments

{env_id} at {SIZE}x{SIZE} pixels, cloud of 512 points and proprioception at every control step, small random actions,
episodes reset as they end. Ours runs in a worker process behind `make_vec`; {STOCK_ID} runs in the measuring process
with `obs_mode="pointcloud"` at the same image size, ManiSkill's other defaults, and returns all pixels unsampled. One
torch thread each. CPU ms per step counts all processes and does not depend on what else the machine was doing; the
rates do, which is why the two run in turn and the ratio is taken within each repetition.

{text}

Made by `{command}`.
"""
