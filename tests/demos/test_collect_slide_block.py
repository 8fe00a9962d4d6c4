"""The command line collects Slide Block: killed and continued, with one worker or two, it stores the same bytes."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import StoreError

EPISODES = 4


def command(*words):
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "manicm_ms.cli", *map(str, words)]
    return subprocess.Popen(words, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def collect(out, num_envs, **options):
    words = ["collect", "ur3e/slide-block", "--episodes", EPISODES, "--num-envs", num_envs, "--seed", 7, "--out", out]
    return command(*words, *(w for name, value in options.items() for w in (f"--{name}", value)))


def finish(process, status=0):
    output, _ = process.communicate()
    assert process.returncode == status, output
    return output


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
    finish(collect(out, num_envs=2))
    return out


def test_killed_and_continued_with_another_number_of_workers(whole, tmp_path):
    out = tmp_path / "demos.zarr"
    process = collect(out, num_envs=1)
    while not committed(out):
        assert process.poll() is None, process.communicate()[0]
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert 1 <= committed(out) < EPISODES
    finish(collect(out, num_envs=1))
    assert content(out) == content(whole)


def test_inspect_and_refusals(whole, tmp_path):
    found = json.loads(finish(command("inspect", whole, "--json")))
    assert (found["env_id"], found["episodes"], found["problems"]) == ("ur3e/slide-block", EPISODES, [])
    assert found["success"] == [True] * EPISODES
    assert found["seeds"] == sorted(found["seeds"])
    assert found["seeds"][0] >= 7
    assert found["attempts"] == found["seeds"][-1] - 7 + 1
    refusal = finish(collect(whole, num_envs=1, style="two-sided"), status=2)
    assert "style 'one-sided'" in refusal
    assert "Traceback" not in refusal
    assert len(refusal.strip().splitlines()) == 1
