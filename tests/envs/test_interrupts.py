"""Interrupts and kills at random moments: nothing is left running, and what is told is short."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from point_mass_env import SOUND

from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import BackendError

HERE = Path(__file__).resolve().parent
REST = torch.zeros(2, 2)
PLAY = f"""
import sys, torch
sys.path.insert(0, {str(HERE)!r})
import point_mass_env
from manicm_ms import make_vec

if __name__ == "__main__":
    env = make_vec(point_mass_env.SOUND, 2, "cpu")
    env.reset(seed=0)
    print(*(process.pid for process in env._workers.processes), flush=True)
    while True:
        env.step(torch.zeros(2, 2))
"""
COMMAND = f"""
import sys
sys.path.insert(0, {str(HERE)!r})
sys.argv[0] = "manicm-ms"
from manicm_ms.cli import main

if __name__ == "__main__":
    print("begun", flush=True)
    import point_mass_env
    main(["check", *[point_mass_env.SOUND] * 50, "--backend", "cpu"])
"""


def of_session(session):
    """Processes of a session that still run."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state, _, _, its = (folder / "stat").read_text().rpartition(") ")[2].split()[:4]
            if int(its) == session and state != "Z":
                found.append(int(folder.name))
    return found


def wait_until(condition, seconds=30):
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        time.sleep(0.02)
    return condition()


def play_for(env, seconds):
    signal.setitimer(signal.ITIMER_REAL, seconds)
    while True:
        env.step(REST)


def test_a_call_that_was_interrupted_leaves_an_environment_that_says_so_and_closes():
    """As a notebook's stop button does: the interrupt may fall between a worker's answer and its reading."""
    moments = random.Random(0)

    def interrupt(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        for _ in range(3):
            env = make_vec(SOUND, 2, "cpu")
            env.reset(seed=0)
            with pytest.raises(KeyboardInterrupt):
                play_for(env, moments.uniform(0.001, 0.05))
            workers = env._workers.processes
            with contextlib.suppress(BackendError):  # the moment may have been outside of the workers' call
                env.step(REST)
            env.close()
            assert not any(worker.is_alive() for worker in workers)
    finally:
        signal.signal(signal.SIGALRM, before)


def test_an_answer_that_nobody_read_does_not_hold_up_closing():
    """The worst moment, made sure of: the actions are sent, the answers are not read."""
    env = make_vec(SOUND, 2, "cpu")
    env.reset(seed=0)

    def cut_off(timeout=None):
        raise KeyboardInterrupt

    env._workers.step_wait = cut_off
    with pytest.raises(KeyboardInterrupt):
        env.step(REST)
    for call in (lambda: env.step(REST), lambda: env.reset(seed=0)):
        with pytest.raises(BackendError, match=r"a call of toy/point-mass-env was interrupted.*make it anew"):
            call()
    env.close()
    assert not any(worker.is_alive() for worker in env._workers.processes)


def test_workers_end_without_a_word_when_their_parent_is_killed(tmp_path):
    (tmp_path / "play.py").write_text(PLAY)
    words = [sys.executable, tmp_path / "play.py"]
    piped = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    scripts = {number: subprocess.Popen(words, **piped) for number in (signal.SIGKILL, signal.SIGTERM)}
    for number, script in scripts.items():
        workers = [int(pid) for pid in script.stdout.readline().split()]
        assert len(workers) == 2
        script.send_signal(number)
        _, err = script.communicate(timeout=30)  # until those who hold its other end have ended as well
        assert wait_until(lambda pids=workers: not any(Path(f"/proc/{pid}").exists() for pid in pids))
        assert [line for line in err.splitlines() if "Error" in line or "Traceback" in line] == []


def test_a_command_ends_with_one_word_at_any_moment(tmp_path):
    """Three at once, each interrupted at another moment: while it imports, while workers start, while they play.

    Ctrl-C on a terminal reaches every process of the session; a service manager's SIGTERM the command alone. Moments
    count from our first line on: what an interrupt of Python's own start-up prints is not ours.
    """
    (tmp_path / "command.py").write_text(COMMAND)
    moments = random.Random(1)
    plan = [(signal.SIGINT, moments.uniform(0, 3)), (signal.SIGTERM, moments.uniform(3, 7)), (signal.SIGINT, 8.0)]
    commands = [
        subprocess.Popen([sys.executable, tmp_path / "command.py"], stderr=subprocess.PIPE, stdout=subprocess.PIPE,
                         text=True, start_new_session=True)
        for _ in plan
    ]  # fmt: skip
    assert [command.stdout.readline() for command in commands] == ["begun\n"] * 3
    started = time.monotonic()
    for command, (number, moment) in zip(commands, plan, strict=True):
        time.sleep(max(started + moment - time.monotonic(), 0))
        for pid in of_session(command.pid) if number == signal.SIGINT else [command.pid]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)
    for command, (number, _) in zip(commands, plan, strict=True):
        _, err = command.communicate(timeout=60)
        assert command.returncode == 128 + number, err
        assert err.splitlines() == ["stopped"]
        assert wait_until(lambda session=command.pid: not of_session(session)), of_session(command.pid)
