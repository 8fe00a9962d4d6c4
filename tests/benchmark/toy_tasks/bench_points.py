"""Toy tasks for the benchmark's processes, which find them through MANICM_MS_TASKS: the point mass of tests/demos."""

import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "demos"))

from toy_point_mass import SPEC, PointMass, StraightLine

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.simulator import ENVS, EnvEntry


class Broken(PointMass):
    """No expert can solve it: it never starts."""

    def reset(self, rows, seeds):
        raise RuntimeError("no device to render with")


for env_id, simulator, group in (
    ("toy/near", PointMass, "easy"),
    ("toy/far", PointMass, "hard"),
    ("toy/broken", Broken, "hard"),
):
    entry = EnvEntry(replace(SPEC, env_id=env_id), simulator, __name__, backends=("cpu",), group=group)
    ENVS.add(env_id, entry, tags=("toy",))
    EXPERTS.add(env_id, StraightLine)
