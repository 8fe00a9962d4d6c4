"""Teachers whose process is killed, stopped or shared between processes: the checkpoint is the same, bit for bit."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from reach_demos import make_store
from safetensors.torch import load_file
from teacher_run import train

from manicm_ms.policies.checkpoint import read_manifest, verify_checkpoint
from manicm_ms.training import session
from manicm_ms.training.log import read_log
from manicm_ms.training.run_folder import training_folder

SCRIPT = Path(__file__).parent / "teacher_run.py"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return make_store(tmp_path_factory.mktemp("data") / "reach.zarr", episodes=4)


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """A teacher trained without interruption."""
    return train(data, tmp_path_factory.mktemp("whole") / "teacher")


def start(data, out, processes=1):
    command = [sys.executable, str(SCRIPT), str(data), str(out), str(processes)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)


def wait_for_step(out, step, process):
    path = training_folder(out) / "log.jsonl"
    while process.poll() is None and max((line["step"] for line in read_log(path)), default=0) < step:
        time.sleep(0.005)
    assert process.poll() is None, process.stderr.read()


def weights_hash(folder):
    return read_manifest(folder)["files"]["model.safetensors"]["sha256"]


def test_kill_9_and_the_same_command_gives_the_same_checkpoint(data, whole, tmp_path):
    out = tmp_path / "teacher"
    process = start(data, out)
    wait_for_step(out, 17, process)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    assert not out.exists()
    train(data, out)
    assert weights_hash(out) == weights_hash(whole)
    assert [line["step"] for line in read_log(training_folder(out) / "log.jsonl")] == list(range(1, 81))


def test_ctrl_c_says_where_the_state_is_and_the_same_command_goes_on(data, whole, tmp_path):
    out = tmp_path / "teacher"
    process = start(data, out)
    wait_for_step(out, 10, process)
    process.send_signal(signal.SIGINT)
    assert f"training state saved in {training_folder(out)}" in process.communicate()[1].replace("\n", "")
    train(data, out)
    assert weights_hash(out) == weights_hash(whole)


def test_death_between_the_last_step_and_the_checkpoint_costs_nothing(data, whole, tmp_path, monkeypatch):
    out = tmp_path / "teacher"
    monkeypatch.setattr(session, "save_checkpoint", _die)
    with pytest.raises(SystemExit):
        train(data, out)
    monkeypatch.undo()
    steps = len(read_log(training_folder(out) / "log.jsonl"))
    train(data, out)
    assert len(read_log(training_folder(out) / "log.jsonl")) == steps
    assert weights_hash(out) == weights_hash(whole)


def _die(*_):
    raise SystemExit


def test_two_processes_share_a_batch(data, whole, tmp_path):
    """The noise of two ranks differs from that of one, so weights are only similar; the run must be whole."""
    out = tmp_path / "teacher"
    process = start(data, out, processes=2)
    _, error = process.communicate(timeout=300)
    assert process.returncode == 0, error
    verify_checkpoint(out)
    one, two = (load_file(folder / "model.safetensors") for folder in (whole, out))
    assert one.keys() == two.keys()
    logs = [read_log(training_folder(folder) / "log.jsonl") for folder in (whole, out)]
    assert [line["step"] for line in logs[1]] == list(range(1, 81))
    late = [sum(line["loss"] for line in log[-20:]) / 20 for log in logs]
    assert late[1] == pytest.approx(late[0], rel=0.5)
    assert all(torch.isfinite(v).all() for v in two.values())
