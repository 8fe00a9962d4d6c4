"""Simulators of single rows for the tests of the MuJoCo suites: in this process, without workers."""

from contextlib import contextmanager

import torch

from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, STATE

ROW = torch.zeros(1, dtype=torch.int64)


@contextmanager
def simulator(env_id, seed=None, **options):
    """A simulator of one row, reset to `seed`."""
    entry = ENVS.get(env_id)
    config = SimulatorConfig(**{"obs": (POINT_CLOUD, AGENT_POS, STATE), **options})
    built = entry.build(config.specialise(entry.spec), config)
    try:
        if seed is not None:
            built.reset(ROW, [seed])
        yield built
    finally:
        built.close()


def smooth_actions(dim, steps, seed=0):
    """Actions (steps, 1, dim) in [-0.8, 0.8] that wander."""
    noise = torch.randn(steps, 1, dim, generator=torch.Generator().manual_seed(seed))
    return (noise.cumsum(0) * 0.3).sin() * 0.8


def equal_frames(first, second):
    """Names of the observation keys in which two frames differ."""
    return [key for key in first if not torch.equal(first[key], second[key])]
