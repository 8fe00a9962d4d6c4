"""Finds the toy tasks' folder, and runs the command as a user does: in a process of its own, or in this one."""

import importlib
import io
import os
import signal
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest

from manicm_ms import tasks
from manicm_ms.cli import main

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


@pytest.fixture(scope="session")
def benchmark_here():
    """Run the same command in this process, which saves the start of one; return its exit status and output."""

    def run(out, *words):
        with pytest.MonkeyPatch.context() as patch, io.StringIO() as printed:
            patch.setenv("MANICM_MS_TASKS", str(TOY_TASKS))  # for the processes that do the jobs
            if (
                str(TOY_TASKS) not in tasks.__path__
            ):  # what the variable does where `tasks` is imported after it was set
                tasks.__path__.append(str(TOY_TASKS))
            importlib.import_module("manicm_ms.tasks.bench_points")
            with redirect_stdout(printed), redirect_stderr(printed), pytest.raises(SystemExit) as end:
                main(["benchmark", *OPTIONS, "--out", str(out), *map(str, words)])
            return end.value.code, printed.getvalue()

    return run
