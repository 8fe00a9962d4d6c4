"""`manicm-ms bench COMMAND`: what a user times on a machine of their own; each imports only what it needs.

Pages of docs/results are made by these commands with `--write`, which needs a checkout.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import tyro

from manicm_ms.cli import USER_ERROR
from manicm_ms.cli.counts import Count, OptionalCount, Seed, checked
from manicm_ms.cli.messages import PROGRAM
from manicm_ms.cli.options import this_command
from manicm_ms.errors import ConfigError, UnknownNameError

NAME = "bench"
_UR3E = ("ur3e/slide-block", "ur3e/stack-cube", "ur3e/transfer-piece")


def env_command(
    env: str = "ur3e/slide-block",
    backend: Literal["cpu", "gpu"] = "cpu",
    num_envs: tuple[int, ...] = (),
    repetitions: Count = 9,
    write: bool = False,
) -> None:
    """Time point-cloud environments; on the CPU stock ManiSkill in turn with ours, and where the time goes.

    Args:
        env: environment id.
        backend: where to simulate.
        num_envs: numbers of rows, one run each; by default 1 2 4 on the CPU and 1 16 64 256 on a GPU.
        repetitions: of each run.
        write: keep the page in docs/results of this checkout, one for each backend.
    """
    from manicm_ms.bench.env import measure

    measure(env, backend, num_envs, repetitions, write, this_command())


def latency_command(
    device: str = "cpu",
    threads: tuple[int, ...] = (1, 2),
    repetitions: Count = 40,
    out: Path | None = None,
    write: bool = False,
) -> None:
    """Time one decision of DP3 and Simple DP3, teachers and students, with random weights; minutes on a CPU.

    Args:
        device: torch device.
        threads: numbers of torch threads, a table each.
        repetitions: timed decisions of each policy.
        out: Markdown file to write.
        write: keep the page in docs/results of this checkout.
    """
    from manicm_ms.bench import latency
    from manicm_ms.bench.pages import results_page

    if write and out is not None:
        raise ConfigError("--write and --out name two places for one page: give one of them")
    latency.bench(device, threads, repetitions, results_page(latency.PAGE) if write else out, this_command())


def expert_command(
    env: tuple[str, ...] = (),
    episodes: Count = 200,
    styles: tuple[str, ...] = (),
    write: bool = False,
    records: Path = Path("runs/expert"),
) -> None:
    """Play the UR3e tasks' experts over many seeds: success, length, speed, smoothness, torque and grip force.

    Every episode is noted as it ends, and the same command goes on where it was stopped. After a change of a task or an
    expert choose another --records: what is noted there is not played again.

    Args:
        env: environment ids; by default all that are tagged real-robot.
        episodes: seeds 0 ... episodes - 1.
        styles: styles of the experts, all of them by default.
        write: keep the page in docs/results of this checkout.
        records: folder of the episodes' records.
    """
    from manicm_ms.bench.expert import bench

    bench(env, styles, episodes, records, write, this_command())


def realism_command(
    envs: tuple[str, ...] = _UR3E,
    presets: tuple[str, ...] = ("clean", "d435i", "d435i+dr"),
    episodes: Count = 10,
    seed: Seed = 500,
    write: bool = False,
) -> None:
    """Time a control step under each realism preset, and count the expert's successes under it.

    Args:
        envs: environment ids.
        presets: realism presets.
        episodes: seeds played by the expert under each of them.
        seed: the first seed.
        write: keep the page in docs/results of this checkout.
    """
    from manicm_ms.bench.realism import Options, bench

    bench(Options(envs, presets, episodes, seed), write, this_command())


def depth_command(
    rows: tuple[int, ...] = (1, 8), repetitions: Count = 100, device: str = "cpu", write: bool = False
) -> None:
    """Time the model of the depth camera and the way from its readings to a cloud.

    Args:
        rows: numbers of rows.
        repetitions: frames timed for each of them.
        device: torch device.
        write: keep the page in docs/results of this checkout.
    """
    from manicm_ms.bench.depth import Options, bench
    from manicm_ms.machine.devices import resolve_device

    bench(Options(rows, repetitions, resolve_device(device)), write, this_command())


def calibration_command() -> None:
    """Measure the error of 'manicm-ms calibrate' on rendered images with noise of image and robot; some minutes."""
    from manicm_ms.bench.calibration import bench

    bench()


def suites_command(tag: str = "benchmark31", write: bool = False, records: Path | None = None) -> None:
    """Run the conformance checks on every environment of a tag, and time its steps, pictures and clouds.

    Args:
        tag: of environments; 'manicm-ms list envs' shows tags.
        write: put the table into docs/results/suites.md of this checkout.
        records: a JSON-lines file that keeps finished rows between runs.
    """
    from manicm_ms.bench.suites import bench

    bench(tag, write, records)


def overfit_command(
    method: tyro.conf.Positional[str],
    size: str = "paper",
    steps: Count = 5,
    data: tuple[Path, ...] = (),
    env: str = "metaworld/button-press",
    episodes: Count = 2,
    teacher: str | None = None,
    batch_size: OptionalCount = None,
    device: str = "cpu",
    seed: Seed = 0,
    folder: Path = Path("runs/overfit"),
) -> int:
    """Take a few steps with a method at full size on real demonstrations, save, load, and compare the actions.

    Tells parameters by part, seconds a step, peak memory and loss. A method that learns from a teacher is distilled
    from one of the same size that took one step. The exit status is 1 where the loaded policy acts otherwise.

    Args:
        method: 'manicm-ms list policies' shows them.
        size: smoke, quick or paper.
        steps: of the optimizer.
        data: stores of demonstrations; by default some are collected.
        env: environment of which they are collected.
        episodes: that are collected.
        teacher: method that a student is distilled from; by default the first with its encoder and backbone.
        batch_size: windows a step; by default the preset's.
        device: torch device.
        seed: of weights, batches and noise.
        folder: of the collected store and METHOD-SIZE.json.
    """
    from manicm_ms.bench.overfit import Options, bench

    options = Options(method, size, steps, data, env, episodes, teacher, batch_size, device, seed, folder)
    return 0 if bench(options, this_command()) else 1


COMMANDS: dict[str, Callable[..., int | None]] = {
    "env": env_command,
    "latency": latency_command,
    "expert": expert_command,
    "realism": realism_command,
    "depth": depth_command,
    "calibration": calibration_command,
    "suites": suites_command,
    "overfit": overfit_command,
}


def run(arguments: Sequence[str]) -> int | None:
    """Run `manicm-ms bench` with what follows on the command line; return its exit status."""
    if not arguments or arguments[0] in ("-h", "--help"):
        _overview()
        return 0 if arguments else USER_ERROR
    name, rest = arguments[0], list(arguments[1:])
    if name not in COMMANDS:
        raise UnknownNameError("benchmark", name, COMMANDS)
    return tyro.cli(
        checked(COMMANDS[name]), prog=f"{PROGRAM} {NAME} {name}", args=rest, config=(tyro.conf.OmitArgPrefixes,)
    )


def _overview() -> None:
    from manicm_ms.cli.listing import console

    print(f"usage: {PROGRAM} {NAME} COMMAND ...   ('{PROGRAM} {NAME} COMMAND --help' tells more)\n")
    width = console().width
    for name, command in COMMANDS.items():
        line = f"  {name:<11} {(command.__doc__ or '').splitlines()[0]}"
        print(textwrap.fill(line, width, subsequent_indent=" " * 14, break_on_hyphens=False))
    print(f"\nThe grid of tasks, methods and seeds is '{PROGRAM} benchmark'.")
