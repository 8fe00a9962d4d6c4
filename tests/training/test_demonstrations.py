"""Several stores of one task are read as one, and whatever does not belong together is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from reach_demos import make_store

from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import ConfigError, SpecMismatchError, StoreError
from manicm_ms.evaluation.origins import Origin
from manicm_ms.spec import ChunkSpec
from manicm_ms.training.demonstrations import read_demos

CHUNK = ChunkSpec(2, 4, 3)


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stores")
    return [make_store(folder / "a.zarr", episodes=3), make_store(folder / "b.zarr", episodes=2, first_seed=9)]


def test_the_windows_of_several_stores_follow_each_other_and_none_spans_two(stores):
    first, second, both = read_demos(stores[0], CHUNK), read_demos(stores[1], CHUNK), read_demos(stores, CHUNK)
    n, frames = len(first.dataset), len(first.dataset.action)
    assert len(both.dataset) == n + len(second.dataset)
    for numbers, alone, offset in ((torch.arange(n), first, 0), (torch.arange(len(second.dataset)), second, n)):
        expected, found = alone.dataset.batch(numbers), both.dataset.batch(numbers + offset)
        assert all(torch.equal(expected[key], found[key]) for key in expected)
    assert both.dataset.index[:n].max() < frames <= both.dataset.index[n:].min()


def test_statistics_and_provenance_are_of_all_of_them(stores):
    first, second, both = read_demos(stores[0], CHUNK), read_demos(stores[1], CHUNK), read_demos(stores, CHUNK)
    for name, stats in both.stats.items():
        np.testing.assert_array_equal(stats.min, np.minimum(first.stats[name].min, second.stats[name].min))
        np.testing.assert_array_equal(stats.max, np.maximum(first.stats[name].max, second.stats[name].max))
    told = both.provenance
    assert (told["episodes"], told["path"]) == (5, f"{stores[0]} {stores[1]}")
    assert told["demo_seeds"] == first.provenance["demo_seeds"] + second.provenance["demo_seeds"]
    assert told["stores"] == [first.provenance, second.provenance]
    assert len({told["sha256"], first.provenance["sha256"], second.provenance["sha256"]}) == 3
    seen = Origin.read(told["env_id"], {"data": told}).seen(told["env_id"], range(100))
    assert seen == sorted({seed for seed in told["demo_seeds"] if seed >= 0})


def test_one_store_is_read_as_ever_however_it_is_named(stores):
    assert read_demos([stores[0]], CHUNK).provenance == read_demos(str(stores[0]), CHUNK).provenance
    assert "stores" not in read_demos(stores[0], CHUNK).provenance


def changed(store, target, **changes):
    """Copy a store under another spec."""
    source = DemoStore.open(store)
    spec = replace(source.spec, **{k: v for k, v in changes.items() if k != "obs"})
    spec = replace(spec, obs=replace(spec.obs, **changes.get("obs", {})))
    with DemoStore.create(target, spec, source.provenance) as copy:
        for k in range(len(source)):
            episode = source.episode(k)
            copy.append(replace(episode, point_cloud=episode.point_cloud[:, : spec.obs.num_points]))
    return target


def test_stores_that_do_not_belong_together_are_refused(stores, tmp_path):
    other = changed(stores[0], tmp_path / "other.zarr", env_id="toy/other")
    with pytest.raises(SpecMismatchError, match=r"are demonstrations of two tasks: name stores of one"):
        read_demos([stores[0], other], CHUNK)
    framed = changed(stores[0], tmp_path / "framed.zarr", obs={"frame": "world"})
    with pytest.raises(SpecMismatchError, match=r"framed\.zarr .* do not fit: obs\.frame"):
        read_demos([stores[0], framed], CHUNK)
    small = changed(stores[0], tmp_path / "small.zarr", obs={"num_points": 16})
    with pytest.raises(
        SpecMismatchError, match=r"and those of .*small\.zarr .* 16: collect one again with --num-points"
    ):
        read_demos([stores[0], small], CHUNK)
    with pytest.raises(ConfigError, match="is named twice"):
        read_demos([stores[0], stores[1], stores[0]], CHUNK)
    with pytest.raises(ConfigError, match="at least one store"):
        read_demos([], CHUNK)
    with pytest.raises(StoreError):
        read_demos([stores[0], tmp_path / "nothing.zarr"], CHUNK)
