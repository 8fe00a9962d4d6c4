"""Claiming a job: by one process at a time, and not for ever by those that die at it."""

import io
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console

from manicm_ms.benchmark.jobs import CollectJob
from manicm_ms.benchmark.plan import Plan
from manicm_ms.benchmark.pool import BUSY, DONE, FAILED, attempt
from manicm_ms.errors import ConfigError
from manicm_ms.paths import exclusive_lock, write_json


class Counted(CollectJob):
    """Work that does nothing but say how often it was done, and raise what it is told."""

    done = 0
    trouble = None

    def work(self, console):
        type(self).done += 1
        assert json.loads(self.begun_file.read_text())["tries"] >= 1
        if self.trouble is not None:
            raise self.trouble
        return {"done": self.done}


@pytest.fixture
def job(tmp_path):
    plan = Plan(
        env_ids=("adroit/door",), methods=("manicm",), seeds=(0,), preset="smoke", out=tmp_path, data=Path("data")
    )
    Counted.done, Counted.trouble = 0, None
    return Counted(plan, "adroit/door")


def console():
    return Console(file=io.StringIO())


def test_a_job_is_done_once(job):
    assert attempt(job, console()) == attempt(job, console()) == DONE
    assert job.done == 1
    assert job.result()["job"] == "adroit/door/collect"
    assert not job.begun_file.exists()


def test_a_job_that_another_holds_is_busy_and_untouched(job):
    job.stem.parent.mkdir(parents=True)
    with exclusive_lock(job.lock_file, lambda holder: ConfigError(holder)):
        assert attempt(job, console()) == BUSY
    assert job.done == 0
    assert not job.failure_file.exists()


@pytest.mark.parametrize(
    ("trouble", "reason"), [(ConfigError("so it is"), "so it is"), (OSError("disk"), "OSError: disk")]
)
def test_a_failure_is_written_down_and_the_next_run_tries_again(job, trouble, reason):
    Counted.trouble = trouble
    assert attempt(job, console()) == FAILED
    assert json.loads(job.failure_file.read_text())["reason"] == reason
    Counted.trouble = None
    assert attempt(job, console()) == DONE
    assert not job.failure_file.exists()


def test_ctrl_c_is_no_failure(job):
    Counted.trouble = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        attempt(job, console())
    assert not job.failure_file.exists()
    assert not job.begun_file.exists()


def test_a_job_at_which_three_processes_died_since_the_start_has_failed(job):
    job.stem.parent.mkdir(parents=True)
    write_json(job.begun_file, {"tries": 3})
    assert attempt(job, console(), started=time.time() - 60) == FAILED
    assert "3 processes in a row died at it" in json.loads(job.failure_file.read_text())["reason"]
    assert job.done == 0
    assert attempt(job, console(), started=time.time() - 60) == DONE, "and the next run tries again"


def test_deaths_of_an_earlier_run_do_not_count(job):
    job.stem.parent.mkdir(parents=True)
    write_json(job.begun_file, {"tries": 3})
    assert attempt(job, console(), started=time.time() + 60) == DONE


STUBBORN = """
import multiprocessing, os, signal, time
from manicm_ms.benchmark import pool

def stubborn():
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt that gets lost
    pool._STOP_S = 0.2
    pool._end_with_parent()
    print(os.getpid(), flush=True)
    time.sleep(600)

if __name__ == "__main__":
    multiprocessing.get_context("fork").Process(target=stubborn).start()
    time.sleep(600)
"""


def test_a_job_ends_with_the_process_that_started_it_even_if_the_interrupt_is_lost(tmp_path):
    (tmp_path / "stubborn.py").write_text(STUBBORN)
    parent = subprocess.Popen([sys.executable, tmp_path / "stubborn.py"], stdout=subprocess.PIPE, text=True)
    job = Path("/proc") / parent.stdout.readline().strip()
    assert job.exists()
    parent.kill()
    parent.communicate(timeout=30)  # until the job, which holds the other end, has ended as well
