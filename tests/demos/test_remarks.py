"""Remarks name what is far outside or unused, with the number and the likely cause, and say nothing of sound data."""

from dataclasses import replace

import numpy as np
import pytest
from store_samples import PROVENANCE, SPEC, episode, make_store

from manicm_ms.demos.remarks import field_remarks, length_remarks, store_remarks, training_remarks, window_remarks
from manicm_ms.demos.sequence_dataset import SequenceDataset
from manicm_ms.demos.store import DemoStore
from manicm_ms.spec import ChunkSpec

RNG = np.random.default_rng(0)
CLOUDS = RNG.uniform(-0.5, 0.5, (30, 16, 6)) + np.array([0, 0, 0, 0.5, 0.5, 0.5])
MANY = RNG.uniform(-0.5, 0.5, (60, 100, 3))
STATE = RNG.uniform(-1, 1, (300, 4))
ACTIONS = RNG.uniform(-1, 1, (30, 2))


def changed(values, where, value):
    values = values.copy()
    values[where] = value
    return values


@pytest.mark.parametrize(
    ("field", "values", "said"),
    [
        ("point_cloud", CLOUDS, []),
        ("point_cloud", CLOUDS[..., :3], []),
        ("point_cloud", 1000 * CLOUDS[..., :3], ["point_cloud reaches 499", "likely millimetres"]),
        ("point_cloud", changed(CLOUDS, (3, 4, 2), -65.5), ["reaches 65.5 m, 0.208 % of it beyond 10 m: likely stray"]),
        (
            "point_cloud",
            changed(MANY, (3, 4, 2), 9),
            ["z (m) of point_cloud spans -0.4997 to 9, nearly all of it", "11 %"],
        ),
        ("point_cloud", changed(CLOUDS, (3, 4, 2), np.nan), []),  # a problem of the store, which inspect names
        ("point_cloud", CLOUDS[..., :3] / 1000, ["spans 1 mm in all: its unit is likely not the metre"]),
        ("point_cloud", CLOUDS * [1, 1, 1, 255, 255, 255], ["colours of point_cloud span 0", "likely bytes, 0 to 255"]),
        ("agent_pos", STATE, []),
        (
            "agent_pos",
            STATE * [1, 400, 500, 1],
            ["z (m) and 1 more entry of agent_pos reaches 4", "likely millimetres"],
        ),
        ("agent_pos", changed(STATE, (7, 3), 9.0) * [1, 1, 1, 0.01], []),
        (
            "agent_pos",
            changed(STATE * [1, 1, 1, 0.01], (7, 3), 9.0),
            ["gripper (m) of agent_pos spans", "nearly all of it"],
        ),
        ("action", ACTIONS, []),
        ("action", np.zeros((30, 2)), ["action never changes in 30 frames"]),
        ("depth", RNG.uniform(0, 9, (5, 6, 8)), []),
        (
            "depth",
            RNG.uniform(300, 900, (5, 6, 8)),
            ["depth reaches 89", "100 % of it beyond 20 m: likely millimetres"],
        ),
        ("depth", np.zeros((5, 6, 8)), []),
        ("privileged_state", 1e6 * STATE, []),
        ("point_cloud", CLOUDS[:0], []),
        ("agent_pos", STATE[:0], []),
    ],
)
def test_a_field(field, values, said):
    remarks = field_remarks(field, values.astype("f4"), SPEC)
    assert len(remarks) == bool(said), remarks
    for part in said:
        assert part in remarks[0]


def test_angles_in_degrees():
    spec = replace(SPEC, agent_pos_names=("a [rad]", "b [rad]", "c [rad/s]", "d"))
    [remark] = field_remarks("agent_pos", STATE * [90, 170, 1, 1], spec)
    assert remark.startswith("b [rad] and 1 more entry of agent_pos reaches 16")
    assert remark.endswith("over 12.6 rad: likely degrees")


def test_episodes_that_are_longer_than_their_environment_allows():
    assert length_remarks(np.array([5, 30]), SPEC) == []
    [remark] = length_remarks(np.array([5, 31, 40]), SPEC)
    assert (
        remark
        == "2 episodes of 3 last up to 40 steps, toy/sample ends at 30: likely another control rate than its 20 Hz"
    )


@pytest.mark.parametrize(
    ("lengths", "chunk", "said"),
    [
        ([1, 5], ChunkSpec(2, 4, 3), []),
        ([9, 20], ChunkSpec(2, 16, 15), []),
        (
            [3, 7, 8],
            ChunkSpec(2, 16, 8),
            ["not learnt from: 2 episodes of 3, 10 frames, shorter than the 8", "last 7 fr"],
        ),
        ([3], ChunkSpec(2, 16, 8), ["not learnt from: 1 episode of 1, 3 frames, shorter than the 8 frames"]),
        (
            [30],
            ChunkSpec(1, 4, 3),
            ["no decision is learnt at the last 1 frame of each episode: a horizon of 4 with 3"],
        ),
    ],
)
def test_frames_that_no_window_reads(lengths, chunk, said):
    remarks = window_remarks(np.array(lengths), chunk)
    assert len(remarks) == len(said), remarks
    for part, remark in zip(said, remarks, strict=True):
        assert part in remark


def test_a_store_that_is_learnt_from(tmp_path):
    sound = make_store(tmp_path / "a.zarr", (1, 2))
    with DemoStore.open(sound) as store:
        assert store_remarks(store) == training_remarks(store, SequenceDataset.from_store(store, ChunkSpec())) == []
    with DemoStore.create(tmp_path / "b.zarr", SPEC, PROVENANCE, extras=("image", "depth")) as store:
        for seed, length in ((0, 3), (1, 20)):
            given = episode(seed, length, success=seed > 0)
            given.point_cloud[0] = 0.25
            store.append(given)
        remarks = training_remarks(store, SequenceDataset.from_store(store, ChunkSpec(2, 16, 8)))
    assert [r.partition(":")[0] for r in remarks] == [
        "not learnt from",
        "no decision is learnt at the last 7 frames of each episode",
        "2 frames of 23 with an empty cloud",
        "1 episode of 2 not solved, and learnt from all the same",
        "stored but not learnt from",
    ]
