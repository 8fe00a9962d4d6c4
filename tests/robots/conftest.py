"""The robot at a table with a cube, without a renderer; and the folders of scripts made importable."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
sys.path[:0] = [str(SCRIPTS / "robot"), str(SCRIPTS / "results")]


@pytest.fixture(scope="session")
def _made() -> Iterator[dict[Any, list[Any]]]:
    """Environments by what they were made with; building one takes longer than playing most tests."""
    torch.set_num_threads(1)
    made: dict[Any, list[Any]] = {}
    yield made
    for env in itertools.chain(*made.values()):
        env.close()


@pytest.fixture
def make_robot_env(_made: dict[Any, list[Any]]) -> Any:
    """Return a factory of `GripperHoldEnv`, just reset; one that an earlier test has left is used again."""
    from gripper_hold import make_env

    free = {key: list(envs) for key, envs in _made.items()}

    def make(**kwargs: Any) -> Any:
        key = tuple(sorted(kwargs.items()))
        if free.get(key):
            env = free[key].pop()
            env.reset(seed=0)
        else:
            env = make_env(**kwargs)
            _made.setdefault(key, []).append(env)
        return env

    return make
