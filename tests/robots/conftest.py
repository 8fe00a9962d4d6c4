"""The robot at a table with a cube, without a renderer; and the folder of scripts made importable."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
if str(SCRIPTS) not in sys.path:
    sys.path.insert(0, str(SCRIPTS))


@pytest.fixture
def make_robot_env() -> Iterator[Any]:
    """Return a factory of `GripperHoldEnv`; what it made is closed at the end."""
    from bench_gripper import make_env

    torch.set_num_threads(1)
    made = []

    def make(**kwargs: Any) -> Any:
        made.append(make_env(**kwargs))
        return made[-1]

    yield make
    for env in made:
        env.close()
