"""Scripts under their former paths, for one release: each says the present command in a line and runs it.

Remove this file and the scripts that call `forward` with the release after 0.2.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

SCRIPTS = Path(__file__).resolve().parent
COMMANDS = {
    "bench_calibration": "calibration",
    "bench_depth": "depth",
    "bench_env": "env",
    "bench_expert": "expert",
    "bench_latency": "latency",
    "bench_realism": "realism",
    "check_suites": "suites",
}
"""Former script -> what follows `manicm-ms bench` now."""
MOVED = {
    "bench_gripper": "results/gripper_hold.py",
    "bench_toy": "results/toy_distillation.py",
    "benchmark_table": "results/benchmark_table.py",
    "depth_picture": "results/depth_picture.py",
    "generate_robot": "robot/generate_robot.py",
    "record_gif": "results/record_gif.py",
    "renew_results": "results/renew_results.py",
    "results_table": "results/results_table.py",
    "sides_table": "results/sides_table.py",
    "start_or_noise": "results/start_or_noise.py",
    "train_ppo": "examples/train_ppo.py",
}
"""Former script -> its present path in scripts/."""


def present_command(script: str, arguments: Sequence[str]) -> tuple[str, list[str]]:
    """Return what to call instead of a former script, as a user would write it, and as a process is started."""
    if script in COMMANDS:
        words = ["bench", COMMANDS[script], *arguments]
        if script == "bench_latency" and not {"--out", "--write", "-h", "--help"} & {
            w.split("=")[0] for w in arguments
        }:
            words.append("--write")  # it always kept its page
        return shlex.join(["manicm-ms", *words]), [sys.executable, "-m", "manicm_ms.cli", *words]
    place = SCRIPTS / MOVED[script]
    return shlex.join(["python", f"scripts/{MOVED[script]}", *arguments]), [sys.executable, str(place), *arguments]


def forward(file: str) -> NoReturn:
    """Say the present command on standard error and become it; raise ImportError where `file` is imported, not run."""
    script = Path(file).stem
    if sys.modules["__main__"].__dict__.get("__file__") != file:
        raise ImportError(f"{script} has moved: {present_command(script, [])[0]}")
    shown, command = present_command(script, sys.argv[1:])
    print(f"{file} has moved and goes with the next release; this is: {shown}", file=sys.stderr, flush=True)
    os.execv(command[0], command)
