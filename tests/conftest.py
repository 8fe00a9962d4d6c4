"""What holds for every test: one thread a process, MuJoCo's OpenGL, the order of the files, and who was at work."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    import gymnasium

# Before torch is imported, here and in what the tests start: workers share the cores, and more threads fight over them.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from manicm_ms.machine import mujoco_gl

mujoco_gl.prepare()  # before anything imports mujoco (ManiSkill's kinematics do)

# Files that take longest, longest first: a worker gets whole files, and none should begin a long one at the end.
LONGEST = (
    "benchmark/test_benchmark.py",
    "evaluation/test_evaluate_slide_block.py",
    "demos/test_collect.py",
    "demos/test_store.py",
    "envs/test_vec_env.py",
    "cli/test_cli.py",
    "training/test_interruption.py",
    "tasks/test_rewards.py",
    "benchmark/test_ray_cluster.py",
    "benchmark/test_reproduce_tables.py",
    "envs/test_mujoco_suites.py",
    "benchmark/test_benchmark_guide.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the long files first; the order within a file stays."""
    items.sort(key=lambda item: next((k for k, name in enumerate(LONGEST) if name in item.nodeid), len(LONGEST)))


@pytest.fixture(scope="session")
def keep_compiled() -> Callable[[gymnasium.Env], None]:
    """Call it with an environment that draws with ManiSkill's shaders: what was compiled for them, in 7 s, stays.

    Compiled shaders live as long as any renderer does; that of a closed environment is small.
    """
    kept = []
    return lambda env: kept.append(env.unwrapped.scene.sub_scenes[0].render_system)


class AtWork:
    """Names the tests that had begun and not ended when the run was stopped, in whichever process they ran."""

    def __init__(self) -> None:
        self.begun: dict[str, None] = {}

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """Note a test that begins."""
        self.begun[nodeid] = None

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """Forget a test that has ended."""
        self.begun.pop(nodeid, None)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say which tests are left."""
        for nodeid in self.begun:
            terminalreporter.write_line(f"did not end: {nodeid}", red=True)


def pytest_configure(config: pytest.Config) -> None:
    """Watch the tests from the process that tells of them; let it tell of them also where a time limit ends it."""
    _start_children_as_a_terminal_does()
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(AtWork(), "at_work")
        signal.signal(signal.SIGTERM, _stop)


def _stop(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_IGN)  # `timeout` sends it twice, and the second would cut off the telling
    raise KeyboardInterrupt


def _start_children_as_a_terminal_does() -> None:
    """Handle signals that a run in the background (`nohup`, `&`) ignores, since what the tests start inherits that."""
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: lambda number, frame: None}
    for number, handler in handlers.items():
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, handler)
