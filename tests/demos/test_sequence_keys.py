"""Windows of any observation: slices of the stored arrays, the same from memory, from the disk and from two stores."""

import numpy as np
import pytest
import torch
from store_samples import episode, make_store

from manicm_ms.demos.sequence_dataset import SequenceDataset, StoredFrames, sequence_index
from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import StoreError
from manicm_ms.spec import ChunkSpec

CHUNK = ChunkSpec(2, 4, 3)
KEYS = ("image", "voxel_grid", "agent_pos", "state", "depth")
FIELDS = {"state": "privileged_state"}
SEEDS = (3, 1, 4)
EXTRAS = ("image", "depth", "privileged_state", "voxel_grid")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = make_store(tmp_path_factory.mktemp("keys") / "a.zarr", SEEDS, EXTRAS)
    with DemoStore.open(path) as store:
        yield store


def test_batches_are_slices_of_the_arrays_in_their_own_types(store):
    windows = SequenceDataset.from_store(store, CHUNK, KEYS)
    picked = torch.tensor([0, 7, 8, len(windows) - 1])
    batch = windows.batch(picked)
    assert list(batch) == [*KEYS, "action"]
    frames = sequence_index(store.episode_ends, CHUNK)[picked]
    for key in KEYS:
        whole = np.concatenate([getattr(episode(seed), FIELDS.get(key, key)) for seed in SEEDS])
        np.testing.assert_array_equal(batch[key].numpy(), whole[frames[:, :2]], strict=True)
    assert batch["action"].shape == (4, 4, 2)
    assert (batch["image"].dtype, batch["voxel_grid"].dtype) == (torch.uint8, torch.uint8)


def test_from_the_disk_comes_what_comes_from_memory(store):
    held, stored = (SequenceDataset.from_store(store, CHUNK, KEYS, most) for most in (2**30, 1000))
    assert all(isinstance(values, torch.Tensor) for values in held.frames.values())
    kept = {key for key, values in stored.frames.items() if isinstance(values, StoredFrames)}
    assert kept == {"image", "voxel_grid", "depth"}
    order = torch.randperm(len(held), generator=torch.Generator().manual_seed(0))
    expected, found = held.batch(order), stored.to("cpu").batch(order)
    assert all(torch.equal(expected[key], found[key]) for key in expected)


def test_two_stores_follow_each_other_one_in_memory_and_one_on_the_disk(store, tmp_path):
    with DemoStore.open(make_store(tmp_path / "b.zarr", (9, 2), EXTRAS)) as other:
        parts = [SequenceDataset.from_store(one, CHUNK, KEYS, m) for one, m in ((store, 2**30), (other, 1000))]
        both = SequenceDataset.joined(parts)
        n, numbers = len(parts[0]), torch.tensor([0, len(parts[0]) - 1, len(parts[0]), len(parts[0]) + 5])
        first, second = parts[0].batch(numbers[:2]), parts[1].batch(numbers[2:] - n)
        for key, values in both.batch(numbers).items():
            assert torch.equal(values, torch.cat([first[key], second[key]]))


def test_an_observation_that_is_not_stored_is_named(tmp_path):
    with (
        DemoStore.open(make_store(tmp_path / "a.zarr", (3,))) as store,
        pytest.raises(StoreError, match="no voxel_gri"),
    ):
        SequenceDataset.from_store(store, CHUNK, ("voxel_grid",))
