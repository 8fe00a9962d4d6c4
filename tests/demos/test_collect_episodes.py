"""Collecting into memory gives the episodes that collecting into a store gives."""

import numpy as np
import pytest
from toy_point_mass import ENV_ID, unsolvable

from manicm_ms.demos.collect import collect, collect_episodes
from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import ConfigError, UnknownNameError


def test_memory_and_store_hold_the_same(tmp_path):
    asked = {"seed": 100, "style": "wobbly", "extras": ("privileged_state",)}
    episodes = collect_episodes(ENV_ID, 5, num_envs=2, **asked)
    assert [e.seed for e in episodes] == [s for s in range(100, 120) if not unsolvable(s)][:5]
    collect(ENV_ID, 5, tmp_path / "demos.zarr", **asked)
    with DemoStore.open(tmp_path / "demos.zarr") as store:
        for ours, stored in zip(episodes, map(store.episode, range(5)), strict=True):
            assert (ours.seed, ours.success) == (stored.seed, stored.success)
            for name in store.fields:
                np.testing.assert_array_equal(getattr(ours, name), getattr(stored, name), strict=True)


def test_bad_input():
    with pytest.raises(ConfigError, match="episodes"):
        collect_episodes(ENV_ID, 0)
    with pytest.raises(ConfigError, match="sound"):
        collect_episodes(ENV_ID, 1, extras=("sound",))
    with pytest.raises(UnknownNameError, match="point-mass"):
        collect_episodes("toy/point-mas", 1)
