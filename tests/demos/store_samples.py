"""Small stores for tests, made of episodes that follow from their seed."""

import numpy as np

from manicm_ms.demos.layout import Episode
from manicm_ms.demos.store import DemoStore
from manicm_ms.spec import ActionSpec, EnvSpec, ObsSpec

SPEC = EnvSpec(
    env_id="toy/sample",
    obs=ObsSpec(16, 3, 4, "robot_base", image_size=(6, 8), voxel_size=6),
    action=ActionSpec(("a", "b"), "velocity", 20.0),
    max_episode_steps=30,
    agent_pos_names=("x (m)", "y (m)", "z (m)", "gripper (m)"),
    state_layout={"goal": (0, 3)},
)
PROVENANCE = {"env_id": SPEC.env_id, "expert": "sampler", "style": "plain", "command": "none", "versions": {"a": "1"}}


def episode(seed, length=None, **changes):
    rng = np.random.default_rng(seed)
    length = int(rng.integers(5, 25)) if length is None else length
    arrays = {
        "point_cloud": rng.uniform(-0.5, 0.5, (length, 16, 3)).astype("f4"),
        "agent_pos": rng.uniform(-1, 1, (length, 4)).astype("f4"),
        "action": rng.uniform(-1, 1, (length, 2)).astype("f4"),
        "image": rng.integers(0, 256, (length, 6, 8, 3), dtype="u1"),
        "depth": rng.uniform(0, 2, (length, 6, 8)).astype("f4"),
        "privileged_state": rng.normal(size=(length, 3)).astype("f4"),
        "voxel_grid": rng.integers(0, 2, (length, 1, 6, 6, 6), dtype="u1") * 255,
    }
    return Episode(**(arrays | {"seed": seed, "success": True} | changes))


def make_store(path, seeds=(), extras=()):
    """Return the path of a closed store with the episodes of `seeds`."""
    with DemoStore.create(path, SPEC, PROVENANCE, extras=extras) as store:
        for seed in seeds:
            store.append(episode(seed))
    return path


def require_same(a, b, fields=("point_cloud", "agent_pos", "action")):
    assert (a.seed, a.success) == (b.seed, b.success)
    for name in fields:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)
