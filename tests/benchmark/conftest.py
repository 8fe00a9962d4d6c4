"""Finds the toy tasks' folder, and runs the command as a user does."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

TOY_TASKS = Path(__file__).parent / "toy_tasks"
OPTIONS = ("--preset", "smoke", "--demos", "3", "--episodes", "4", "--num-envs", "1")


@pytest.fixture(scope="session")
def benchmark_environment():
    """The environment variables under which the toy tasks are found."""
    return {**os.environ, "MANICM_MS_TASKS": str(TOY_TASKS)}


@pytest.fixture(scope="session")
def start_benchmark(benchmark_environment):
    """Start `manicm-ms benchmark` on the toy tasks in a process of its own."""

    def start(out, *words, **variables):
        command = [sys.executable, "-m", "manicm_ms.cli", "benchmark", *OPTIONS, "--out", str(out), *map(str, words)]
        return subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            env={**benchmark_environment, **variables},
            # Where the tests run in the background of a script, SIGINT is ignored, and children inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip

    return start
