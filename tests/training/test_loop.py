"""The loop: learns, resumes bit-equal after real kills, stops cleanly, refuses what would spoil a run."""

import itertools
import json
import math
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rich.console import Console
from tiny_run import CONFIG, IDENTITY, TinyData, TinyObjective, train

from manicm_ms.errors import CheckpointError, NoSpaceError, OutputExistsError, TrainingDivergedError
from manicm_ms.training.log import read_log
from manicm_ms.training.run_folder import open_run, training_folder

SCRIPT = Path(__file__).parent / "tiny_run.py"


def state_of(out):
    with open_run(out, IDENTITY) as run:
        return run.load_state()


def assert_same_state(a, b):
    (tensors_a, meta_a), (tensors_b, meta_b) = a, b
    assert tensors_a.keys() == tensors_b.keys()
    assert all(torch.equal(tensors_a[k], tensors_b[k]) for k in tensors_a)
    assert {k: v for k, v in meta_a.items() if k != "seconds"} == {k: v for k, v in meta_b.items() if k != "seconds"}


def without_seconds(log):
    return [{k: v for k, v in line.items() if k != "seconds"} for line in log]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    out = tmp_path_factory.mktemp("run") / "whole"
    train(out)
    return out


def start(out):
    return subprocess.Popen([sys.executable, str(SCRIPT), str(out)], stderr=subprocess.PIPE, text=True)


def wait_for_step(out, step, process):
    """Wait until the log of `out` has come to `step`."""
    path = training_folder(out) / "log.jsonl"
    while process.poll() is None and max((line["step"] for line in read_log(path)), default=0) < step:
        time.sleep(0.005)
    assert process.poll() is None, process.stderr.read()


def test_it_learns(uninterrupted):
    log = read_log(training_folder(uninterrupted) / "log.jsonl")
    assert [line["step"] for line in log] == [*range(7, 120, 7), 120]
    assert log[-1]["loss"] < log[0]["loss"] / 5
    assert log[-1]["learning_rate"] == pytest.approx(0.0, abs=1e-12)


def test_kill_9_twice_and_resume_is_bit_equal(tmp_path, uninterrupted):
    out = tmp_path / "killed"
    for step, delay in ((14, 0.013), (63, 0.004)):
        process = start(out)
        wait_for_step(out, step, process)
        time.sleep(delay)
        process.kill()
        assert process.wait() == -signal.SIGKILL
    _, result = train(out)
    assert 60 <= result.resumed_from < 120
    assert result.steps == 120
    assert_same_state(state_of(out), state_of(uninterrupted))
    logs = [read_log(training_folder(o) / "log.jsonl") for o in (out, uninterrupted)]
    assert without_seconds(logs[0]) == without_seconds(logs[1])


def test_ctrl_c_saves_the_step_it_was_in_and_resume_is_bit_equal(tmp_path, uninterrupted):
    out = tmp_path / "stopped"
    process = start(out)
    wait_for_step(out, 21, process)
    process.send_signal(signal.SIGINT)
    error = process.communicate()[1]
    assert process.returncode != 0
    assert "KeyboardInterrupt" in error
    stopped_at = state_of(out)[1]["step"]
    assert 21 <= stopped_at < 120
    _, result = train(out)
    assert result.resumed_from == stopped_at
    assert_same_state(state_of(out), state_of(uninterrupted))


def test_a_kill_between_writing_and_renaming_leaves_the_old_state(tmp_path, monkeypatch):
    out = tmp_path / "run"
    train(out)
    before = state_of(out)
    with open_run(out, IDENTITY) as run:
        monkeypatch.setattr("manicm_ms.training.run_folder.os.replace", _die)
        with pytest.raises(SystemExit):
            run.save_state({"x": torch.zeros(3)}, {"step": 1})
    monkeypatch.undo()
    assert_same_state(state_of(out), before)


def _die(*_):
    raise SystemExit


def test_finished_state_takes_no_more_steps(tmp_path):
    out = tmp_path / "run"
    first, _ = train(out)
    second, result = train(out, objective=TinyObjective(seed=99))
    assert second.seen == []
    assert result.resumed_from == result.steps == 120
    torch.testing.assert_close(second.network.state_dict(), first.network.state_dict(), rtol=0, atol=0)
    assert math.isfinite(result.loss)


def test_constant_parts_are_not_saved(uninterrupted):
    tensors, _ = state_of(uninterrupted)
    assert not [k for k in tensors if "reference" in k]
    assert [k for k in tensors if "average" in k]


def test_another_run_is_refused_and_named(tmp_path):
    out = tmp_path / "run"
    train(out)
    before = state_of(out)
    with pytest.raises(OutputExistsError, match=r"another run \(steps 120 there, 200 now\).*--out"):
        train(out, identity=IDENTITY | {"steps": 200})
    assert_same_state(state_of(out), before)


def test_the_same_run_twice_at_once_is_refused(tmp_path):
    with open_run(tmp_path / "run", IDENTITY), pytest.raises(OutputExistsError, match=r"trained by process \d+"):
        train(tmp_path / "run")


class PoisonedData(TinyData):
    """Turns to NaN at a step."""

    calls = itertools.count

    def __init__(self, at):
        super().__init__()
        self.calls = itertools.count()
        self.at = at

    def batch(self, indices):
        batch = super().batch(indices)
        return batch if next(self.calls) < self.at else batch | {"y": batch["y"] * math.nan}


def test_nan_stops_with_a_finite_state(tmp_path):
    with pytest.raises(TrainingDivergedError, match=r"NaN or infinite.*learning rate"):
        train(tmp_path / "run", data=PoisonedData(at=32))
    tensors, meta = state_of(tmp_path / "run")
    assert meta["step"] == 30
    assert all(torch.isfinite(v).all() for v in tensors.values())


def test_too_small_a_disk_is_refused_before_training(tmp_path, monkeypatch):
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr("manicm_ms.paths.shutil.disk_usage", lambda _: usage)
    objective = TinyObjective()
    with pytest.raises(NoSpaceError):
        train(tmp_path / "run", objective=objective)
    assert objective.seen == []


def test_clip_norm_bounds_the_first_step_of_plain_descent(tmp_path):
    """AdamW's first moment after one step is (1 - beta1) times the clipped gradient, whose norm is the bound."""
    config = replace(CONFIG, steps=1, warmup_steps=0, clip_norm=1e-3)
    train(tmp_path / "run", config=config)
    tensors, _ = state_of(tmp_path / "run")
    moment = torch.cat([v.flatten() for k, v in tensors.items() if k.endswith("exp_avg")])
    assert float(moment.norm()) == pytest.approx((1 - config.betas[0]) * 1e-3, rel=1e-3)


def test_progress_shows_steps_and_loss(tmp_path):
    with (tmp_path / "screen").open("w") as f:
        train(tmp_path / "run", console=Console(file=f, force_terminal=True, width=120))
    screen = (tmp_path / "screen").read_text()
    assert "120/120" in screen
    last_loss = read_log(training_folder(tmp_path / "run") / "log.jsonl")[-1]["loss"]
    assert f"loss {last_loss:.4g}" in screen


def test_in_a_file_the_last_step_and_loss_are_a_line(tmp_path):
    with (tmp_path / "log").open("w") as f:
        train(tmp_path / "run", console=Console(file=f))
    last_loss = read_log(training_folder(tmp_path / "run") / "log.jsonl")[-1]["loss"]
    assert f"  120/120  loss {last_loss:.4g}  " in (tmp_path / "log").read_text().splitlines()[-1]


def test_tensorboard_has_the_logged_losses(uninterrupted):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board = EventAccumulator(str(training_folder(uninterrupted) / "tensorboard"))
    board.Reload()
    log = read_log(training_folder(uninterrupted) / "log.jsonl")
    events = board.Scalars("loss")
    assert [e.step for e in events] == [line["step"] for line in log]
    assert [e.value for e in events] == pytest.approx([line["loss"] for line in log])


def test_damaged_files_of_a_run_are_named(tmp_path):
    out = tmp_path / "run"
    train(out)
    state = training_folder(out) / "state.safetensors"
    state.write_bytes(state.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match=r"state\.safetensors is damaged"):
        train(out)
    (training_folder(out) / "run.json").write_text("{")
    with pytest.raises(OutputExistsError, match=r"run\.json is damaged"):
        train(out)


def test_state_of_another_network_is_refused(tmp_path):
    out = tmp_path / "run"
    with open_run(out, IDENTITY) as run:
        run.save_state({"objective.head.weight": torch.zeros(1)}, {"step": 3})
    with pytest.raises(CheckpointError, match="another version"):
        train(out)


def test_run_json_is_the_identity(uninterrupted):
    assert json.loads((training_folder(uninterrupted) / "run.json").read_text()) == IDENTITY
