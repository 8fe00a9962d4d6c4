"""Collecting: the data depends on seeds alone, whatever the workers, interruptions and kills."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_point_mass import ENV_ID, FIRST_BROKEN_SEED, MAX_STEPS, unsolvable

from manicm_ms.demos.attempts import Collector
from manicm_ms.demos.collect import collect, fill
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import ConfigError, ManicmError, StoreError, UnknownNameError
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, STATE

HERE = Path(__file__).parent


def content(path):
    """All that a store holds, as bytes."""
    with DemoStore.open(path) as store:
        arrays = [store.frames(f) for f in store.fields]
        arrays += [store.episode_ends, store.seeds, store.successes, store.lengths]
        return [(a.shape, a.tobytes()) for a in arrays], store.attempts, store.provenance


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Twelve demonstrations collected in one go by one worker."""
    path = tmp_path_factory.mktemp("reference") / "demos.zarr"
    collect(ENV_ID, 12, path, num_envs=1, seed=100, style="wobbly")
    return path


def test_keeps_the_first_solved_seeds_in_order(reference):
    solvable = [s for s in range(100, 130) if not unsolvable(s)][:12]
    with DemoStore.open(reference) as store:
        assert store.seeds.tolist() == solvable
        assert store.successes.all()
        assert store.attempts == solvable[-1] - 100 + 1
        assert store.provenance["expert"] == "straight-line"
        assert store.provenance["style"] == "wobbly"
        assert ENV_ID in store.provenance["command"]
        assert store.provenance["versions"]["torch"] == torch.__version__


def test_frame_k_is_what_the_expert_saw_before_action_k(reference):
    with DemoStore.open(reference) as store:
        for episode in map(store.episode, range(len(store))):
            # The toy's dynamics link frames: x[k+1] = x[k] + 0.1 a[k].
            moved = episode.agent_pos[:-1] + 0.1 * episode.action[:-1]
            np.testing.assert_allclose(episode.agent_pos[1:], moved, atol=1e-6)
            rng = np.random.default_rng(episode.seed)
            start, goal = rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2)
            np.testing.assert_allclose(episode.agent_pos[0], start, atol=1e-6)
            last = episode.agent_pos[-1] + 0.1 * episode.action[-1]
            assert np.linalg.norm(last - goal) < 0.05
            assert len(episode) < MAX_STEPS


@pytest.mark.parametrize("num_envs", [2, 3])
def test_workers_do_not_change_the_data(reference, tmp_path, num_envs):
    collect(ENV_ID, 12, tmp_path / "demos.zarr", num_envs=num_envs, seed=100, style="wobbly")
    assert content(tmp_path / "demos.zarr") == content(reference)


def test_extending_gives_what_one_run_gives(reference, tmp_path):
    out = tmp_path / "demos.zarr"
    first = collect(ENV_ID, 5, out, num_envs=2, seed=100, style="wobbly")
    assert (first.episodes, first.added) == (5, 5)
    second = collect(ENV_ID, 12, out, num_envs=2, seed=100, style="wobbly")
    assert (second.episodes, second.added) == (12, 7)
    assert content(out) == content(reference)


def test_finished_store_is_left_alone(reference):
    before = {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in reference.rglob("*") if p.is_file()}
    again = collect(ENV_ID, 12, reference, num_envs=2, seed=100, style="wobbly")
    fewer = collect(ENV_ID, 3, reference, num_envs=2, seed=100, style="wobbly")
    assert (again.added, again.episodes, fewer.added, fewer.episodes) == (0, 12, 0, 12)
    assert {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in reference.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 7}, "seed 100"),
        ({"style": "direct"}, "style 'wobbly'"),
        ({"style": None}, "style 'wobbly'"),
        ({"tail_steps": 3}, "tail_steps"),
        ({"colors": True}, "point_channels"),
        ({"extras": ("privileged_state",)}, "fields"),
    ],
)
def test_other_data_is_not_mixed_in(reference, change, named):
    asked = {"seed": 100, "style": "wobbly"} | change
    with pytest.raises(StoreError, match=named):
        collect(ENV_ID, 20, reference, **asked)


def test_bad_input(tmp_path):
    with pytest.raises(UnknownNameError, match="point-mass"):
        collect("toy/point-mas", 1, tmp_path / "a.zarr")
    with pytest.raises(UnknownNameError, match="wobbly"):
        collect(ENV_ID, 1, tmp_path / "a.zarr", style="wobly")
    with pytest.raises(ConfigError, match="episodes"):
        collect(ENV_ID, 0, tmp_path / "a.zarr")
    with pytest.raises(ConfigError, match="sound"):
        collect(ENV_ID, 1, tmp_path / "a.zarr", extras=("sound",))
    with pytest.raises(ConfigError, match="seed must not be negative"):
        collect(ENV_ID, 1, tmp_path / "new" / "a.zarr", seed=-1)
    (tmp_path / "notes.txt").write_text("not a store")
    with pytest.raises(StoreError, match=r"is not a store of demonstrations.*: name another folder"):
        collect(ENV_ID, 1, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["notes.txt"]


def test_extras_are_stored(tmp_path):
    collect(ENV_ID, 2, tmp_path / "a.zarr", extras=("privileged_state",))
    with DemoStore.open(tmp_path / "a.zarr") as store:
        episode = store.episode(0)
        np.testing.assert_array_equal(episode.privileged_state[:, :2], episode.agent_pos)


class Idle:
    """An expert that never moves."""

    name, style, styles = "idle", "still", ("still",)

    def reset(self, state, seeds, mask):
        pass

    def act(self, state):
        return torch.zeros(len(state), 2)


def test_hopeless_expert_is_given_up(tmp_path):
    env = make_vec(ENV_ID, num_envs=2, backend="cpu", obs=(POINT_CLOUD, AGENT_POS, STATE))
    with DemoStore.create(tmp_path / "a.zarr", env.env_spec, {}) as store:
        with pytest.raises(ManicmError, match=r"61 of 61 attempts failed.*not solved in 40 steps"):
            fill(store, Collector(env, Idle()), 1, 0)
        assert (len(store), store.attempts) == (0, 61)
    env.close()


def test_ctrl_c_keeps_what_was_committed(reference, tmp_path):
    env = make_vec(ENV_ID, num_envs=2, backend="cpu", obs=(POINT_CLOUD, AGENT_POS, STATE))
    out = tmp_path / "demos.zarr"

    def interrupt(kept, attempts):
        if kept == 4:
            raise KeyboardInterrupt

    with DemoStore.open(reference) as store:
        spec, provenance = store.spec, store.provenance
    collector = Collector(env, EXPERTS.get(ENV_ID)(env.env_spec, 2, env.device, "wobbly"))
    with DemoStore.create(out, spec, provenance) as store, pytest.raises(KeyboardInterrupt):
        fill(store, collector, 12, 100, interrupt)
    env.close()
    with DemoStore.open(out) as store:
        assert len(store) == 4
    collect(ENV_ID, 12, out, seed=100, style="wobbly")
    assert content(out) == content(reference)


def collect_process(out, episodes=12):
    code = (
        "from pathlib import Path; import toy_point_mass; from manicm_ms.demos.collect import collect\n"
        f"collect({ENV_ID!r}, {episodes}, Path({str(out)!r}), num_envs=2, seed=100, style='wobbly')"
    )
    env = os.environ | {"PYTHONPATH": str(HERE), "TOY_STEP_SECONDS": "0.003", "OMP_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, "-c", code], env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def committed(out):
    try:
        with DemoStore.open(out) as store:
            return len(store)
    except StoreError:
        return 0


def test_kill_9_loses_and_doubles_nothing(reference, tmp_path):
    out, rng, seen = tmp_path / "demos.zarr", np.random.default_rng(0), 0
    for goal in (2, 7):
        process = collect_process(out)
        while committed(out) < goal:
            assert process.poll() is None, process.communicate()[0].decode()
            time.sleep(0.05)  # looking opens the store, which costs the process that is looked at
        time.sleep(rng.uniform(0, 0.03))  # anywhere within the next episode or its writing
        os.kill(process.pid, signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        assert goal <= committed(out) < 12
        assert committed(out) >= seen
        seen = committed(out)
    process = collect_process(out)
    output = process.communicate()[0].decode()
    assert process.returncode == 0, output
    assert content(out) == content(reference)


def test_a_simulator_that_does_not_run_leaves_no_store(tmp_path):
    with pytest.raises(Exception, match="no device to render with"):
        collect(ENV_ID, 1, tmp_path / "demos.zarr", num_envs=2, seed=FIRST_BROKEN_SEED)
    assert not any(tmp_path.iterdir())


def test_second_writer_is_refused_at_once(tmp_path):
    out = tmp_path / "demos.zarr"
    process = collect_process(out, episodes=500)
    try:
        while committed(out) < 1:
            assert process.poll() is None, process.communicate()[0].decode()
            time.sleep(0.01)
        with pytest.raises(StoreError, match=f"written by process {process.pid}"):
            collect(ENV_ID, 500, out, num_envs=2, seed=100, style="wobbly")
    finally:
        process.kill()
        process.communicate()
    DemoStore.open(out, "a").close()
