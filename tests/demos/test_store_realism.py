"""What was drawn for an episode is stored with it, committed with it, and readable by others' zarr."""

import dataclasses
import shutil

import numpy as np
import pytest
import zarr
from store_samples import PROVENANCE, SPEC, episode, make_store, require_same

from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import StoreError
from manicm_ms.sensing.realism import REALISM

NAMES = ("table_height", "cube.mass_factor")


def drawn(seed):
    return {"table_height": seed / 1000, "cube.mass_factor": 1 + seed / 7}


def with_realism(seed, **changes):
    return dataclasses.replace(episode(seed), realism=drawn(seed) | changes)


@pytest.fixture
def store(tmp_path):
    with DemoStore.create(tmp_path / "a.zarr", SPEC, PROVENANCE, realism=NAMES) as store:
        for seed in (3, 5, 4):
            store.append(with_realism(seed))
    return tmp_path / "a.zarr"


def test_round_trip(store):
    with DemoStore.open(store) as reader:
        assert reader.realism_names == NAMES
        np.testing.assert_array_equal(reader.realism, [list(drawn(seed).values()) for seed in (3, 5, 4)])
        assert [reader.episode(k).realism for k in range(3)] == [drawn(seed) for seed in (3, 5, 4)]


def test_plain_zarr_reads_it(store):
    group = zarr.open_group(str(store), mode="r")
    assert group.metadata.zarr_format == 2
    table = group["meta/realism"]
    assert (table.shape, table.dtype) == ((3, 2), np.float64)
    assert tuple(table.attrs["names"]) == NAMES


def test_every_value_of_the_widest_preset_comes_back_to_the_bit(tmp_path):
    sample = REALISM.get("d435i+dr").sample(8, ("cube", "block"))
    with DemoStore.create(tmp_path / "a.zarr", SPEC, PROVENANCE, realism=sample) as store:
        store.append(dataclasses.replace(episode(8), realism=sample))
        assert store.episode(0).realism == sample


def test_a_store_without_it_is_as_before(tmp_path):
    path = make_store(tmp_path / "plain.zarr", seeds=[1, 2])
    assert not (path / "meta" / "realism").exists()
    with DemoStore.open(path, "a") as store:
        assert (store.realism_names, store.realism.shape) == ((), (2, 0))
        assert store.episode(0).realism == {}
        store.append(episode(3))
    assert not (path / "meta" / "realism").exists()


def test_an_append_that_was_cut_short_leaves_none_of_it(store):
    with DemoStore.open(store, "a") as writer:
        table = writer._arrays.meta("realism")
        table.resize((5, 2))
        table[3:] = 9.0
    with DemoStore.open(store, "a") as writer:
        assert writer.realism.shape == (3, 2)
        writer.append(with_realism(6))
        np.testing.assert_array_equal(writer.realism[-1], list(drawn(6).values()))
        require_same(writer.episode(3), episode(6))
    assert zarr.open_group(str(store), mode="r")["meta/realism"].shape == (4, 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"friction": 1.0}, "friction are in one of the two only"), ({"table_height": np.nan}, "NaN or infinity")],
)
def test_other_values_are_refused(store, changes, message):
    with DemoStore.open(store, "a") as writer:
        with pytest.raises(StoreError, match=message):
            writer.append(with_realism(7, **changes))
        with pytest.raises(StoreError, match="not drawn from the realism"):
            writer.append(episode(7))
        assert len(writer) == 3


def test_a_table_that_is_too_short_is_damage(store, tmp_path):
    shutil.copytree(store, tmp_path / "b.zarr")
    zarr.open_group(str(tmp_path / "b.zarr"), mode="r+")["meta/realism"].resize((2, 2))
    with pytest.raises(StoreError, match="meta/realism is shorter"):
        DemoStore.open(tmp_path / "b.zarr")
