"""The command line collects Slide Block: killed and continued, with one worker or two, it stores the same bytes."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import redirect_stderr, redirect_stdout

import pytest

from manicm_ms.cli import main
from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import StoreError

EPISODES = 4


def words(out, num_envs, **options):
    given = ["collect", "ur3e/slide-block", "--episodes", EPISODES, "--num-envs", num_envs, "--seed", 7, "--out", out]
    return [*given, *(word for name, value in options.items() for word in (f"--{name}", value))]


def run(*words, status=0):
    """Run a command in this process, where the simulator is imported once for all; return what it printed."""
    with redirect_stdout(io.StringIO()) as printed, redirect_stderr(printed), pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    assert end.value.code == status, printed.getvalue()
    return printed.getvalue()


def committed(out):
    try:
        with DemoStore.open(out) as store:
            return len(store)
    except StoreError:
        return 0


def content(out):
    with DemoStore.open(out) as store:
        return [store.frames(f).tobytes() for f in store.fields], store.seeds.tolist(), store.lengths.tolist()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "demos.zarr"
    run(*words(out, num_envs=2))
    return out


def test_killed_and_continued_with_another_number_of_workers(whole, tmp_path):
    out = tmp_path / "demos.zarr"
    command = [sys.executable, "-m", "manicm_ms.cli", *map(str, words(out, num_envs=1))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    while not committed(out):
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert 1 <= committed(out) < EPISODES
    run(*words(out, num_envs=1))
    assert content(out) == content(whole)


def test_inspect_and_refusals(whole, tmp_path):
    found = json.loads(run("inspect", whole, "--json"))
    assert (found["env_id"], found["episodes"], found["problems"]) == ("ur3e/slide-block", EPISODES, [])
    assert found["success"] == [True] * EPISODES
    assert found["seeds"] == sorted(found["seeds"])
    assert found["seeds"][0] >= 7
    assert found["attempts"] == found["seeds"][-1] - 7 + 1
    refusal = run(*words(whole, num_envs=1, style="two-sided"), status=2)
    assert "style 'one-sided'" in refusal
    assert "Traceback" not in refusal
    assert len(refusal.strip().splitlines()) == 1
