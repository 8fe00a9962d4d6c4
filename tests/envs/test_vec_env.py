"""The vector environments: their contract on every registered id, that a broken one is caught, and errors."""

import os
import signal
import time
from contextlib import closing

import numpy as np
import point_mass_env
import pytest
import torch
from gymnasium.vector import AutoresetMode
from point_mass_env import BROKEN, RAISING, SOUND

from manicm_ms.envs.backends import resolve_backend
from manicm_ms.envs.conformance import PROPERTIES, check_vec_env
from manicm_ms.envs.cpu_vec_env import CpuVecEnv
from manicm_ms.envs.gpu_vec_env import GpuVecEnv
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import ActionError, BackendError, ConfigError, ManicmError, RenderDeviceError, UnknownNameError
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, STATE, ChunkSpec

SUITES = ("toy/", "adroit/", "metaworld/")  # 50 and 3 tasks of one kind: test_mujoco_suites.py takes some of each
OURS = [env_id for env_id in ENVS.names() if not env_id.startswith(SUITES)]
NO_GPU = not torch.cuda.is_available()


# ---- conformance ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", [*OURS, SOUND])
def test_every_registered_environment_keeps_the_contract(env_id):
    told = []
    results = check_vec_env(env_id, "cpu", on_result=told.append)
    assert [f"{r.name}: {r.detail}" for r in results if not r.passed] == []
    assert len(results) == len(PROPERTIES)
    assert told == results


@pytest.mark.parametrize("env_id", BROKEN)
def test_a_broken_environment_is_caught(env_id):
    _, check = BROKEN[env_id]
    failed = {r.name: r.detail for r in check_vec_env(env_id, "cpu") if not r.passed}
    assert check in failed
    assert failed[check], "the detail says what was seen"


def checked_as_on_a_gpu(env_id, monkeypatch):
    """Results of the conformance check where every environment says that its backend is gpu."""
    monkeypatch.setattr(CpuVecEnv, "backend", "gpu")
    return {r.name: r for r in check_vec_env(env_id, "cpu")}


def test_on_a_gpu_a_seed_fixes_the_start_alone(monkeypatch):
    results = checked_as_on_a_gpu("toy/remembers", monkeypatch)
    assert [r.name for r in results.values() if not r.passed] == []
    assert "gpu" in results["unreset row goes on"].detail


def test_on_a_gpu_the_start_is_compared(monkeypatch):
    results = checked_as_on_a_gpu("toy/global-random", monkeypatch)
    assert not results["same seed same episode"].passed
    assert "at frame 0" in results["same seed same episode"].detail


def test_checks_have_names_of_their_own():
    names = [check.__name__ for check in PROPERTIES]
    assert len(set(names)) == len(names) >= 15


# ---- a cheap environment of two rows --------------------------------------------------------------------------------


@pytest.fixture
def env():
    env = make_vec(SOUND, 2, "cpu")
    env.reset(seed=[1, 2])
    yield env
    env.close()


def test_says_what_it_is(env):
    assert env.backend == "cpu"
    assert env.autoreset_mode is env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert env.device == torch.device("cpu")
    assert env.num_envs == 2
    assert env.chunk is None
    assert env.env_spec.env_id == SOUND
    assert env.env_spec.obs.num_points == 512, "the number of points that was asked for, not the entry's own"
    assert env.single_observation_space[POINT_CLOUD].shape == (512, 3)


def test_values_against_the_closed_form(env):
    start = env.reset(seed=[1, 2])[0][AGENT_POS]
    torch.testing.assert_close(start[0], torch.rand(2, generator=torch.Generator().manual_seed(1)) * 0.1)
    moves = torch.tensor([[0.2, 0.1], [-0.3, 0.0]])
    obs, reward, terminated, truncated, info = env.step(moves)
    torch.testing.assert_close(obs[AGENT_POS], start + moves)
    torch.testing.assert_close(reward, (start + moves)[:, 0])
    assert reward.dtype == torch.float32
    assert terminated.tolist() == truncated.tolist() == [False, False]
    assert info["elapsed_steps"].tolist() == [1, 1]


def test_success_terminates_and_freezes(env):
    for _ in range(2):
        obs, _, terminated, _, info = env.step(torch.tensor([[0.6, 0.0], [0.0, 0.0]]))
    assert terminated.tolist() == info["success"].tolist() == [True, False]
    again, reward, terminated, _, info = env.step(torch.tensor([[0.6, 0.0], [0.1, 0.0]]))
    assert torch.equal(again[AGENT_POS][0], obs[AGENT_POS][0])
    assert terminated.tolist() == info["success_once"].tolist() == [True, False]
    assert reward[0] == 0
    _, info = env.reset(seed=[3, 4], options={"reset_mask": np.array([True, False])})
    assert info["success"].tolist() == [False, False]
    assert info["elapsed_steps"].tolist() == [0, 3]


def test_crash_of_a_row_is_told_and_the_other_goes_on(env):
    for _ in range(5):
        _, _, terminated, _, info = env.step(torch.tensor([[0.0, 0.9], [-0.1, 0.0]]))
    assert terminated.tolist() == [True, False]
    assert info["error"] == ["the simulation diverged: the observation holds NaN or infinity", None]
    assert info["success"].tolist() == [False, False]
    _, info = env.reset(seed=[5, 6])
    assert info["error"] == [None, None]


def test_seed_forms(env):
    counted = env.reset(seed=4)[0][AGENT_POS]
    for listed in ([4, 5], (4, 5), np.array([4, 5]), torch.tensor([4, 5])):
        assert torch.equal(counted, env.reset(seed=listed)[0][AGENT_POS])
    assert not torch.equal(env.reset()[0][AGENT_POS], env.reset()[0][AGENT_POS])


def test_resets_without_a_seed_go_on_from_the_last_one(env):
    def starts():
        env.reset(seed=5)
        return [env.reset()[0][AGENT_POS], env.reset(seed=[None, 6])[0][AGENT_POS], env.reset()[0][AGENT_POS]]

    first, again = starts(), starts()
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    torch.testing.assert_close(first[1][1], torch.rand(2, generator=torch.Generator().manual_seed(6)) * 0.1)
    assert not torch.equal(first[0], first[1])
    assert torch.equal(first[0][1], first[2][1]), "the second row's stream began again with its seed 6"


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (np.full((2, 2), np.nan), "rows [0, 1]"),
        (np.array([[0, 0], [0, np.inf]]), "rows [1]"),
        (np.zeros((3, 2)), "(3, 2)"),
        (np.zeros(2), "takes (2, 2)"),
        ("left", "not an array"),
        (None, "not an array"),
    ],
)
def test_bad_actions(env, actions, words):
    with pytest.raises(ActionError) as error:
        env.step(actions)
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    _, info = env.reset(seed=[1, 2])
    assert info["elapsed_steps"].tolist() == [0, 0]


def test_bad_resets(env):
    with pytest.raises(ConfigError, match="3 seeds for num_envs=2"):
        env.reset(seed=[1, 2, 3])
    for mask in (np.array([True]), np.array([1, 0])):
        with pytest.raises(ConfigError, match="reset_mask must be"):
            env.reset(seed=[1, 2], options={"reset_mask": mask})
    with pytest.raises(ConfigError, match="names no row"):
        env.reset(options={"reset_mask": np.zeros(2, dtype=bool)})
    for options, words in (
        ({"mask": [True, False]}, "'mask': did you mean 'reset_mask'"),
        ([True, False], "dictionary"),
    ):
        with pytest.raises(ConfigError, match=words):
            env.reset(options=options)
    for seed in (-1, 2**32, 2**32 - 1, [0, -7], 1.5, "3", True, [0, 1.0]):
        with pytest.raises(ConfigError, match=f"seed .*{SOUND} takes whole numbers from 0 to 4294967295"):
            env.reset(seed=seed)
    _, info = env.reset(seed=[2**32 - 1, 0])
    assert info["error"] == [None, None], "none of these has harmed the workers"


def test_first_reset_must_cover_every_row():
    mask = [True, False]
    entry, config = ENVS.get(SOUND), SimulatorConfig(num_rows=2, video=True)
    on_gpu_code = GpuVecEnv(entry, config.specialise(entry.spec), 2, config, None)
    for env in (make_vec(SOUND, 2, "cpu", video=True), on_gpu_code):
        with closing(env):
            for early in (lambda env=env: env.step(torch.zeros(2, 2)), env.render_video_frames):
                with pytest.raises(ConfigError, match="before the first reset"):
                    early()
            with pytest.raises(ConfigError, match="the first reset must cover every row"):
                env.reset(seed=[1, 2], options={"reset_mask": np.array(mask)})
            env.reset(seed=[1, 2])
            env.reset(seed=[1, 2], options={"reset_mask": np.array(mask)})


def test_video_must_be_asked_for(env):
    with pytest.raises(ConfigError, match="video=True"):
        env.render_video_frames()
    assert env.render_mode is None
    with closing(make_vec(SOUND, 2, "cpu", video=True)) as filmed:
        assert filmed.render_mode == "rgb_array"
        filmed.reset(seed=[1, 2])
        frames = filmed.render_video_frames()
    assert frames.shape == (2, 4, 4, 3)
    assert frames.dtype == torch.uint8


def test_chunks_have_a_history_and_an_action_axis():
    with closing(make_vec(SOUND, 2, "cpu", chunk=ChunkSpec(2, 4, 3), obs=(AGENT_POS, STATE))) as env:
        first, _ = env.reset(seed=[1, 2])
        assert set(first) == {AGENT_POS, STATE}
        assert first[AGENT_POS].shape == (2, 2, 2)
        obs, reward, *_, info = env.step(torch.full((2, 3, 2), 0.1))
        torch.testing.assert_close(obs[AGENT_POS][:, 1], first[AGENT_POS][:, 1] + 0.3)
        torch.testing.assert_close(reward, 3 * first[AGENT_POS][:, 1, 0] + 0.1 + 0.2 + 0.3)
        assert info["elapsed_steps"].tolist() == [3, 3]
        with pytest.raises(ActionError):
            env.step(torch.zeros(2, 2))


# ---- processes ------------------------------------------------------------------------------------------------------


def test_killed_worker_is_told_and_closing_still_works():
    env = make_vec(SOUND, 2, "cpu")
    env.reset(seed=[1, 2])
    victim, other = env._workers.processes
    os.kill(victim.pid, signal.SIGKILL)
    victim.join()
    with pytest.raises(BackendError, match=r"worker processes \[0\] \(exit codes \[-9\]\) .* died.*make it anew"):
        env.step(torch.zeros(2, 2))
    env.close()
    env.close()
    deadline = time.monotonic() + 20
    while other.is_alive() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not other.is_alive()


def test_an_error_at_a_reset_fails_its_row_and_the_environment_lives():
    with closing(make_vec(RAISING, 2, "cpu", obs=(AGENT_POS,))) as env:
        env.reset(seed=[1, 2])
        _, info = env.reset(seed=[1, 13])
        assert info["error"] == [None, "RuntimeError: a long story:\nno start for this seed"]
        *_, terminated, _, info = env.step(torch.zeros(2, 2))
        assert terminated.tolist() == [False, True]
        assert info["elapsed_steps"].tolist() == [1, 0]
        assert env.reset(seed=[1, 2])[1]["error"] == [None, None]


@pytest.mark.parametrize(
    ("first", "seed", "kind", "message"),
    [
        (13, 1, BackendError, r"^a worker process of toy/raising failed \(no start for this seed\): .*make it anew"),
        (1, 14, RenderDeviceError, "^no device: install one$"),
    ],
)
def test_an_error_in_a_worker_ends_the_environment(first, seed, kind, message):
    env = make_vec(RAISING, 2, "cpu", obs=(AGENT_POS,), video=True)
    if first == 1:
        env.reset(seed=[1, 1])
    with pytest.raises(kind, match=message) as told:
        env.reset(seed=[1, seed if first == 1 else first])
    assert "\n" not in str(told.value)
    if kind is BackendError:
        assert isinstance(told.value.__cause__, RuntimeError)
    for call in (
        lambda: env.step(torch.zeros(2, 2)),
        lambda: env.reset(seed=[1, 2]),
        env.render_video_frames,
    ):
        if first == 13:
            env._every_row_started = True  # else the missing reset would be told
        with pytest.raises(BackendError, match=r"toy/raising failed .*make it anew"):
            call()
    env.close()
    env.close()
    with pytest.raises(ConfigError, match="closed"):
        env.reset()


def test_closing_ends_the_workers():
    env = make_vec(SOUND, 1, "cpu")
    (worker,) = env._workers.processes
    env.reset(seed=[1])
    env.close()
    assert not worker.is_alive()


# ---- what cannot be made --------------------------------------------------------------------------------------------


def test_unknown_id_suggests_the_nearest():
    with pytest.raises(UnknownNameError, match="did you mean 'ur3e/slide-block'"):
        make_vec("ur3e/slideblock")


@pytest.mark.parametrize(
    "options",
    [
        {"num_envs": 0},
        {"num_points": 0},
        {"image_size": (0, 84)},
        {"obs": ()},
        {"obs": ("pointcloud",)},
        {"reward_mode": "denser"},
    ],
)
def test_impossible_options(options):
    with pytest.raises(ConfigError):
        make_vec(SOUND, **{"backend": "cpu"} | options)


def test_unknown_observation_key_lists_those_that_exist():
    with pytest.raises(ConfigError, match=r"pointcloud.*point_cloud, agent_pos"):
        make_vec(SOUND, backend="cpu", obs=("pointcloud",))


def test_unknown_backend_lists_those_that_exist():
    with pytest.raises(BackendError, match="auto, cpu, gpu"):
        make_vec(SOUND, backend="tpu")


@pytest.mark.skipif(not NO_GPU, reason="this machine has a CUDA device")
def test_gpu_is_refused_with_the_reason_where_there_is_none():
    with pytest.raises(BackendError, match="finds no CUDA device; use backend 'cpu'") as error:
        make_vec(SOUND, backend="gpu")
    assert isinstance(error.value, ManicmError)


@pytest.mark.skipif(not NO_GPU, reason="this machine has a CUDA device")
def test_auto_takes_the_cpu_and_says_so():
    assert resolve_backend("auto") == "cpu"
    with closing(make_vec(SOUND)) as env:
        assert env.backend == "cpu"


def test_the_gpu_backend_s_own_code_on_two_rows():
    """GpuVecEnv with a simulator that lives on the CPU: everything but the physics is the same."""
    entry, chunk = ENVS.get(SOUND), ChunkSpec(2, 4, 3)
    rng = torch.Generator().manual_seed(0)
    plan = torch.rand(6, 2, 3, 2, generator=rng) * 0.3 - 0.15
    played = []
    for kind, rows in ((CpuVecEnv, 1), (GpuVecEnv, 2)):
        config = SimulatorConfig(num_rows=rows)
        with closing(kind(entry, config.specialise(entry.spec), 2, config, chunk)) as env:
            frames = [env.reset(seed=[1, 2])]
            for k, action in enumerate(plan):
                frames.append(env.step(action))
                if k == 3:
                    frames.append(env.reset(seed=[7, 7], options={"reset_mask": np.array([False, True])}))
            played.append(frames)
    for cpu, gpu in zip(*played, strict=True):
        *cpu, cpu_info = cpu
        *gpu, gpu_info = gpu
        assert all(torch.equal(cpu[0][key], gpu[0][key]) for key in cpu[0])
        assert all(torch.equal(a, b) for a, b in zip(cpu[1:], gpu[1:], strict=True))
        assert set(cpu_info) == set(gpu_info)
        for name in set(cpu_info) - {"error"}:
            assert torch.equal(cpu_info[name], gpu_info[name]), name
        assert cpu_info["error"] == gpu_info["error"] == [None, None]


def test_point_mass_is_registered_under_its_module():
    """Workers import this module by name; the tests above rely on it."""
    assert ENVS.get(SOUND).module == point_mass_env.__name__
