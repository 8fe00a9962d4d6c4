"""Teacher and student from a store to a checkpoint: what is learned, what is recorded, what is refused."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from reach_demos import cloud_at, expert_action, make_store
from rich.console import Console

from manicm_ms.errors import (
    CheckpointError,
    ConfigError,
    OutputExistsError,
    SpecMismatchError,
    StoreError,
    UnknownNameError,
)
from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest
from manicm_ms.training.distill import distill
from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS
from manicm_ms.training.train import train

TEACHER = replace(
    TEACHER_PRESETS.get("quick"), steps=250, batch_size=32, warmup_steps=20,
    changes={"inputs": {"points": {"max_points": 32}}, "backbone": {"down_dims": (16, 32)}},
)  # fmt: skip
STUDENT = replace(STUDENT_PRESETS.get("quick"), steps=40, batch_size=32, warmup_steps=5)
FEW = {"steps": 4, "warmup_steps": 1}


def run(function, *args, **kwargs):
    """Call an entry function quietly; return its result and what it printed."""
    screen = io.StringIO()
    out = function(*args, device="cpu", precision="32-true", console=Console(file=screen, width=200), **kwargs)
    return out, screen.getvalue()


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Return folder, data, teacher and student of one small but real training."""
    folder = tmp_path_factory.mktemp("pair")
    data = make_store(folder / "reach.zarr", episodes=20)
    teacher, _ = run(train, "simple_dp3", data, folder / "teacher", TEACHER)
    student, _ = run(distill, teacher, data, folder / "student", STUDENT)
    return folder, data, teacher, student


def unseen_cases(count=64):
    """Return observations that no demonstration holds and the expert's next action in each."""
    rng = np.random.default_rng(12345)
    clouds, poses, actions = [], [], []
    for _ in range(count):
        target = rng.uniform([0.35, -0.15, 0.0], [0.55, 0.15, 0.1])
        hand = target + rng.uniform(-0.15, 0.15, 3)
        before = hand - 0.05 * expert_action(hand, target)
        clouds.append([cloud_at(target, 64, rng) for _ in range(2)])
        poses.append([[*h, 0.04] for h in (before, hand)])
        actions.append(expert_action(hand, target))
    obs = {"point_cloud": torch.tensor(np.array(clouds)), "agent_pos": torch.tensor(np.array(poses)).float()}
    return obs, torch.tensor(np.array(actions)).float()


@pytest.mark.parametrize("which", ["teacher", "student"])
def test_it_learns_the_motion(pair, which):
    policy = load_checkpoint(pair[0] / which)
    obs, expected = unseen_cases()
    chosen = policy.act(obs, generator=torch.Generator().manual_seed(0))[:, 0]
    error, scale = (chosen - expected).pow(2).mean().sqrt(), expected.pow(2).mean().sqrt()
    assert error < 0.5 * scale


def test_student_is_one_network_evaluation_and_keeps_the_encoder(pair):
    teacher, student = load_checkpoint(pair[2]), load_checkpoint(pair[3])
    assert (teacher.nfe, student.nfe) == (10, 1)
    weights, frozen = teacher.state_dict(), student.state_dict()
    assert all(torch.equal(weights[k], frozen[k]) for k in weights if k.startswith(("encoder", "normalizer")))
    assert any(not torch.equal(weights[k], frozen[k]) for k in weights if k.startswith("head.backbone"))
    assert weights.keys() == frozen.keys()


def test_checkpoint_says_where_it_comes_from(pair):
    _, data, teacher, student = pair
    made = read_manifest(teacher)["provenance"]
    assert made["data"]["path"] == str(data)
    assert (made["data"]["episodes"], made["data"]["frames"]) == (20, 240)
    assert made["data"]["collection"] == {"expert": "straight"}
    assert (made["steps"], made["seed"], made["precision"]) == (250, 0, "32-true")
    assert made["preset"]["changes"]["backbone"]["down_dims"] == [16, 32]
    assert made["seconds"] > 0
    assert 0 < made["final_loss"] < 1
    taught = read_manifest(student)["provenance"]["teacher"]
    assert taught["sha256"] == read_manifest(teacher)["files"]["model.safetensors"]["sha256"]
    assert taught["provenance"]["run"] == made["run"]


def test_checkpoints_hold_the_seeds_of_their_demonstrations(pair, tmp_path):
    _, _, teacher, student = pair
    assert read_manifest(teacher)["provenance"]["data"]["demo_seeds"] == list(range(20))
    assert read_manifest(student)["provenance"]["data"]["demo_seeds"] == list(range(20))
    assert "demo_seeds: 20 numbers from 0 to 19" in (teacher / "MODEL_CARD.md").read_text()
    other = make_store(tmp_path / "other.zarr", episodes=3, first_seed=70)
    apart, _ = run(distill, teacher, other, tmp_path / "apart", replace(STUDENT, **FEW))
    made = read_manifest(apart)["provenance"]
    assert made["data"]["demo_seeds"] == [70, 71, 72]
    assert made["teacher"]["provenance"]["data"]["demo_seeds"] == list(range(20))


def test_finished_run_returns_at_once_and_leaves_no_state(pair):
    folder, data, teacher, student = pair
    before = {p: p.stat().st_mtime_ns for f in (teacher, student) for p in f.iterdir()}
    assert "finished" in run(train, "simple_dp3", data, teacher, TEACHER)[1]
    assert "finished" in run(distill, teacher, data, student, STUDENT)[1]
    assert {p: p.stat().st_mtime_ns for p in before} == before
    assert sorted(p.name for p in (folder / "teacher.train").iterdir()) == [
        "lock", "log.jsonl", "record.json", "run.json", "tensorboard",
    ]  # fmt: skip


def test_same_seed_same_weights_and_another_seed_others(pair, tmp_path):
    hashes = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        out, _ = run(train, "simple_dp3", pair[1], tmp_path / name, replace(TEACHER, **FEW), seed=seed)
        hashes.append(read_manifest(out)["files"]["model.safetensors"]["sha256"])
    assert hashes[0] == hashes[1] != hashes[2]


def test_another_run_is_refused_with_the_difference(pair):
    _, data, teacher, _ = pair
    with pytest.raises(OutputExistsError, match=r"another run \(preset.learning_rate 0.001 there, 0.01 now\)"):
        run(train, "simple_dp3", data, teacher, replace(TEACHER, learning_rate=0.01))
    with pytest.raises(OutputExistsError, match="another run"):
        run(distill, teacher, data, teacher, STUDENT)


def test_a_folder_that_is_not_ours_is_refused_untouched(pair, tmp_path):
    out = tmp_path / "thesis"
    out.mkdir()
    (out / "chapter1.txt").write_text("years of work")
    with pytest.raises(OutputExistsError, match="something else"):
        run(train, "simple_dp3", pair[1], out, TEACHER)
    assert (out / "chapter1.txt").read_text() == "years of work"
    assert [p.name for p in tmp_path.iterdir()] == ["thesis"]


def test_data_of_another_robot_is_refused(pair, tmp_path):
    other = make_store(tmp_path / "other.zarr", episodes=1, action_names=("dx [m]", "dy [m]"))
    with pytest.raises(SpecMismatchError, match=r"action\.names"):
        run(distill, pair[2], other, tmp_path / "student", STUDENT)
    assert not (tmp_path / "student.train").exists()


def test_a_student_is_not_a_teacher(pair, tmp_path):
    with pytest.raises(CheckpointError, match="manicm, which cannot be distilled"):
        run(distill, pair[3], pair[1], tmp_path / "grandchild", STUDENT)


@pytest.mark.parametrize(
    ("policy", "data", "error", "match"),
    [
        ("simple_dp", None, UnknownNameError, "did you mean 'simple_dp3'"),
        ("manicm", None, ConfigError, "manicm learns from a teacher, not from demonstrations: use manicm-ms distill"),
        ("simple_dp3", Path("/nowhere.zarr"), StoreError, "nowhere"),
    ],
)
def test_bad_input_is_named(pair, tmp_path, policy, data, error, match):
    with pytest.raises(error, match=match):
        run(train, policy, data or pair[1], tmp_path / "out", TEACHER)
    assert not any(tmp_path.iterdir())


def test_a_negative_seed_is_refused_before_anything_is_made(pair, tmp_path):
    for function, *inputs, preset in ((train, "simple_dp3", pair[1], TEACHER), (distill, *pair[2:0:-1], STUDENT)):
        with pytest.raises(ConfigError, match="seed must not be negative, got -1"):
            run(function, *inputs, tmp_path / "out", preset, seed=-1)
    assert not any(tmp_path.iterdir())


def test_a_state_left_by_a_kill_after_the_checkpoint_is_removed(pair):
    folder, data, teacher, _ = pair
    state = folder / "teacher.train" / "state.safetensors"
    state.write_bytes(b"left behind")
    assert "finished" in run(train, "simple_dp3", data, teacher, TEACHER)[1]
    assert not state.exists()


def test_the_solvers_stride_must_divide_the_timesteps(pair, tmp_path):
    with pytest.raises(ConfigError, match="solver_stride=7 must divide"):
        run(distill, pair[2], pair[1], tmp_path / "out", replace(STUDENT, solver_stride=7))


@pytest.mark.parametrize(
    ("num_devices", "match"),
    [(3, r"batch_size=32 cannot be shared equally by num_devices=3: use batch_size=33"), (0, "num_devices"),
     (64, "use batch_size=64")],
)  # fmt: skip
def test_devices_that_cannot_share_a_batch_are_refused_before_any_process_starts(pair, tmp_path, num_devices, match):
    with pytest.raises(ConfigError, match=match):
        run(train, "simple_dp3", pair[1], tmp_path / "t", TEACHER, num_devices=num_devices)
    with pytest.raises(ConfigError, match=match):
        run(distill, pair[2], pair[1], tmp_path / "s", STUDENT, num_devices=num_devices)
    assert list(tmp_path.iterdir()) == []


def test_a_teacher_is_distilled_on_its_own_tasks_data_unless_another_is_meant(pair, tmp_path):
    other = make_store(tmp_path / "other.zarr", episodes=2, env_id="test/reach-far")
    with pytest.raises(SpecMismatchError, match=r"are of test/reach-far and .* for test/reach: .*--allow-other-task"):
        run(distill, pair[2], other, tmp_path / "s", STUDENT)
    assert not (tmp_path / "s").exists()
    student, _ = run(distill, pair[2], other, tmp_path / "s", replace(STUDENT, **FEW), allow_other_task=True)
    assert read_manifest(student)["provenance"]["data"]["env_id"] == "test/reach-far"


def test_epsilon_prediction_and_the_public_formula_train_too(pair, tmp_path):
    _, data, *_ = pair
    preset = replace(TEACHER, **FEW).with_changes({"head": {"prediction_type": "epsilon"}})
    out, _ = run(train, "simple_dp3", data, tmp_path / "eps", preset)
    assert json.loads((out / "config.json").read_text())["config"]["head"]["prediction_type"] == "epsilon"
    for objective in ("consistency", "public-consistency"):
        student, _ = run(distill, out, data, tmp_path / objective, replace(STUDENT, **FEW, objective=objective))
        obs, _ = unseen_cases(2)
        assert torch.isfinite(load_checkpoint(student).act(obs)).all()
    assert read_manifest(tmp_path / "consistency")["provenance"]["final_loss"] < 1.0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_trains_and_the_checkpoint_acts_on_a_cpu(pair, tmp_path):
    quiet = {"device": "cuda", "precision": "bf16-mixed", "console": Console(file=io.StringIO())}
    teacher = train("simple_dp3", pair[1], tmp_path / "teacher", TEACHER, **quiet)
    student = distill(teacher, pair[1], tmp_path / "student", STUDENT, **quiet)
    obs, expected = unseen_cases()
    chosen = load_checkpoint(student).act(obs)[:, 0]
    assert (chosen - expected).pow(2).mean() < 0.25 * expected.pow(2).mean()
