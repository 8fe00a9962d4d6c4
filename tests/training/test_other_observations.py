"""Trainings on voxel grids and images: what a store must hold, what identifies a run, and what comes of three steps."""

import hashlib
import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from reach_demos import make_store, reach_episode, reach_spec
from rich.console import Console

from manicm_ms.demos import sequence_dataset
from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.policies import example_observations
from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.spec import ChunkSpec
from manicm_ms.training.demonstrations import read_demos
from manicm_ms.training.distill import distill
from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS
from manicm_ms.training.train import train

CHUNK = ChunkSpec(2, 4, 3)
PRESET = replace(
    TEACHER_PRESETS.get("smoke"), steps=3, warmup_steps=1, batch_size=4,
    changes={"backbone": {"down_dims": (16, 32), "n_groups": 4, "step_embed_dim": 16}},
)  # fmt: skip
DATA = {"dp": "image", "voxel_dp": "voxel_grid"}


def seen_store(path, extras, voxel_size=8, seeds=(0, 1)):
    """A store whose pictures and grids are random but follow from the seed."""
    plain = reach_spec()
    spec = replace(plain, obs=replace(plain.obs, image_size=(48, 52), voxel_size=voxel_size))
    with DemoStore.create(path, spec, {"expert": "straight"}, extras=extras) as store:
        for seed in seeds:
            rng = np.random.default_rng(seed)
            more = {
                "image": rng.integers(0, 256, (12, 48, 52, 3), dtype=np.uint8),
                "voxel_grid": rng.integers(0, 2, (12, 1, *(voxel_size,) * 3), dtype=np.uint8) * 255,
            }
            store.append(replace(reach_episode(seed, spec), **{name: more[name] for name in extras}))
    return path


def quiet(function, *args, **kwargs):
    return function(*args, device="cpu", precision="32-true", console=Console(file=io.StringIO()), **kwargs)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return seen_store(tmp_path_factory.mktemp("seen") / "demos.zarr", ("image", "voxel_grid"))


@pytest.fixture(scope="module", params=DATA)
def teacher(request, store, tmp_path_factory):
    return quiet(train, request.param, store, tmp_path_factory.mktemp(request.param) / "teacher", PRESET)


def test_three_steps_make_a_policy_and_two_more_its_student(teacher, store, tmp_path):
    policy = load_checkpoint(teacher)
    other = seen_store(tmp_path / "other.zarr", ("image", "voxel_grid"), voxel_size=9, seeds=(5,))
    if policy.name == "voxel_dp":
        with pytest.raises(SpecMismatchError, match=r"voxel_grid is \(1, 9, 9, 9\) in the first and \(1, 8, 8, 8\)"):
            quiet(distill, teacher, other, tmp_path / "none", STUDENT_PRESETS.get("smoke"))
    few = replace(STUDENT_PRESETS.get("smoke"), steps=2, warmup_steps=1, batch_size=4, draws=2)
    student = load_checkpoint(quiet(distill, teacher, store, tmp_path / "student", few))
    for made in (policy, student):
        assert made.keys == (DATA[policy.name], "agent_pos")
        actions = made.act(example_observations(made, 2), generator=torch.Generator().manual_seed(0))
        assert actions.shape == (2, 3, 3)
        assert actions.abs().max() > 0
    assert student.nfe == 1


def test_from_the_disk_the_same_weights_are_learnt(teacher, store, tmp_path, monkeypatch):
    policy = load_checkpoint(teacher)
    monkeypatch.setattr(sequence_dataset, "MOST_HELD_BYTES", 10_000)
    stored = read_demos(store, CHUNK, policy.keys).dataset.frames[policy.keys[0]]
    assert isinstance(stored, sequence_dataset.StoredFrames)
    again = load_checkpoint(quiet(train, policy.name, store, tmp_path / "again", PRESET))
    assert all(torch.equal(a, b) for a, b in zip(policy.parameters(), again.parameters(), strict=True))


@pytest.mark.parametrize("method", DATA)
def test_a_store_that_lacks_what_is_read_is_refused_with_the_option_and_nothing_is_written(method, tmp_path):
    plain = seen_store(tmp_path / "plain.zarr", ())
    with pytest.raises(
        ConfigError, match=rf"holds no {DATA[method]}, which {method} reads: .* --extras {DATA[method]}$"
    ):
        quiet(train, method, plain, tmp_path / "out", PRESET)
    assert [p.name for p in tmp_path.iterdir()] == ["plain.zarr"]


def test_the_option_keeps_what_the_store_holds_already(tmp_path):
    images = seen_store(tmp_path / "images.zarr", ("image",))
    with pytest.raises(ConfigError, match=r"--extras image voxel_grid$"):
        read_demos(images, CHUNK, ("voxel_grid", "agent_pos"))


def test_the_hash_of_clouds_is_that_of_before_and_each_choice_of_observations_has_its_own(store):
    clouds = read_demos(store, CHUNK)
    with DemoStore.open(store) as opened:
        arrays = [opened.point_cloud, opened.state, opened.action, clouds.dataset.index.numpy()]
    before = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
    assert clouds.provenance["sha256"] == before
    assert read_demos(store, CHUNK, ("point_cloud",)).provenance["sha256"] == before
    others = [read_demos(store, CHUNK, (key, "agent_pos")) for key in DATA.values()]
    assert len({before, *(demos.provenance["sha256"] for demos in others)}) == 3
    assert [list(demos.stats) for demos in others] == [["agent_pos", "action"]] * 2
    with_extras = {remark.rpartition(": ")[2] for remark in others[0].remarks if "not learnt from" in remark}
    assert with_extras == {"voxel_grid"}


def test_grids_of_two_sizes_are_not_read_as_one(store, tmp_path):
    finer = seen_store(tmp_path / "finer.zarr", ("image", "voxel_grid"), voxel_size=9, seeds=(5,))
    assert len(read_demos([store, finer], CHUNK).dataset) == 12 * 3
    with pytest.raises(SpecMismatchError, match=r"voxel_grid is \(1, 9, 9, 9\) in the first and \(1, 8, 8, 8\)"):
        read_demos([store, finer], CHUNK, ("voxel_grid", "agent_pos"))


def test_clouds_alone_are_read_as_ever(tmp_path):
    demos = read_demos(make_store(tmp_path / "reach.zarr", episodes=2), CHUNK)
    assert list(demos.dataset.frames) == ["point_cloud", "agent_pos", "action"]
    assert list(demos.stats) == ["point_cloud", "agent_pos", "action"]
