"""NumPy at the border: Gymnasium's vector contract, kept with every vector wrapper that Gymnasium ships."""

import tempfile
from pathlib import Path

import gymnasium.wrappers.vector as wrappers
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import ClipAction, FlattenObservation, TransformReward
from point_mass_env import MAX_STEPS, SOUND, Raises, make_spec

from manicm_ms.envs.gpu_vec_env import GpuVecEnv
from manicm_ms.envs.numpy_arrays import NumpyVecEnv
from manicm_ms.envs.simulator import EnvEntry, SimulatorConfig
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import ConfigError
from manicm_ms.spec import AGENT_POS, IMAGE, STATE

FAST = np.array([[0.6, 0.0], [0.0, 0.0]], np.float32)  # the first row succeeds in its second step
REST = np.zeros((2, 2), np.float32)


def build(obs=(STATE,), video=False):
    """Two rows in this process: the point mass behind the border that `make_vec(..., arrays="numpy")` builds."""
    entry = EnvEntry(make_spec("toy/in-process"), Raises, __name__)
    config = SimulatorConfig(num_rows=2, obs=obs, video=video, num_points=4, image_size=(6, 8))
    return NumpyVecEnv(GpuVecEnv(entry, config.specialise(entry.spec), 2, config, None))


@pytest.fixture
def env():
    return build()


def test_make_vec_offers_it_and_refuses_other_kinds():
    env = make_vec(SOUND, 1, "cpu", arrays="numpy")
    try:
        assert isinstance(env, NumpyVecEnv)
        assert env.backend == "cpu"
        assert isinstance(env.reset(seed=1)[0][AGENT_POS], np.ndarray)
        assert isinstance(env.unwrapped.reset(seed=1)[0][AGENT_POS], torch.Tensor)
    finally:
        env.close()
    with pytest.raises(ConfigError, match="unknown arrays 'jax': choose from torch, numpy"):
        make_vec(SOUND, 1, "cpu", arrays="jax")


def test_everything_is_an_array_of_the_same_values(env):
    tensors = build().unwrapped
    for mine, theirs in ((env.reset(seed=3), tensors.reset(seed=3)), (env.step(FAST), tensors.step(FAST))):
        *mine, info = mine
        *theirs, facts = theirs
        np.testing.assert_array_equal(mine[0][STATE], theirs[0][STATE].numpy())
        for a, b in zip(mine[1:], theirs[1:], strict=True):
            np.testing.assert_array_equal(a, b.numpy())
        assert set(info) == {*facts, "ended"}
        assert all(isinstance(values, np.ndarray) and values.shape == (2,) for values in info.values())
        assert info["error"].tolist() == [None, None]
    assert env.observation_space.contains(mine[0])
    assert [flags.dtype for flags in mine[2:]] == [bool, bool]


def test_it_is_a_vector_environment_that_says_how_it_resets(env):
    assert isinstance(env, VectorEnv)
    assert env.autoreset_mode is env.metadata["autoreset_mode"] is AutoresetMode.DISABLED
    assert env.render_mode is None
    assert build(video=True).render_mode == "rgb_array"
    assert env.metadata["render_fps"] == 20
    assert env.env_spec.env_id == "toy/in-process"
    assert not hasattr(env, "no_such_thing")


def test_an_end_is_announced_once_and_remembered(env):
    env.reset(seed=1)
    seen = [env.step(FAST) for _ in range(4)]
    assert [terminated.tolist() for _, _, terminated, _, _ in seen] == [[False] * 2, [True, False]] + [[False] * 2] * 2
    assert [info["ended"].tolist() for *_, info in seen] == [[False] * 2] + [[True, False]] * 3
    _, info = env.reset(seed=1, options={"reset_mask": np.array([False, True])})
    assert info["ended"].tolist() == [True, False]
    _, info = env.reset(seed=1, options={"reset_mask": np.array([True, False])})
    assert info["ended"].tolist() == [False, False]
    env.step(FAST)
    assert env.step(FAST)[2].tolist() == [True, False], "the next episode's end is announced again"


def test_a_row_that_crashes_at_its_reset_ends_with_its_first_step(env):
    env.reset(seed=1)
    _, info = env.reset(seed=[13, 1])
    assert info["ended"].tolist() == [True, False]
    assert "no start for this seed" in info["error"][0]
    *_, terminated, _, _ = env.step(REST)
    assert terminated.tolist() == [True, False]


# ---- Gymnasium's wrappers -------------------------------------------------------------------------------------------

NOT_HERE = {
    "RecordVideo": "moviepy",
    "HumanRendering": "pygame",
    "ArrayConversion": "array_api_compat",
    "NumpyToTorch": "array_api_compat",
    "JaxToNumpy": "jax",
    "JaxToTorch": "jax",
}
"""Wrappers that need a library which the package does not bring: tried where it is installed."""


def of_key(key, **options):
    """Rows whose observation is the one array `key`."""
    env = build(obs=(key,), **options)
    spaces = env.observation_space[key], env.single_observation_space[key]
    return wrappers.TransformObservation(env, lambda obs: obs[key], *spaces)


def within_one(obs):
    return np.clip(obs, -1, 1)


def bounded():
    spaces = Box(-1, 1, (2, 2), np.float32), Box(-1, 1, (2,), np.float32)
    return wrappers.TransformObservation(of_key(STATE), within_one, *spaces)


WRAP = {
    "VectorizeTransformObservation": lambda: wrappers.VectorizeTransformObservation(build(), FlattenObservation),
    "VectorizeTransformAction": lambda: wrappers.VectorizeTransformAction(build(), ClipAction),
    "VectorizeTransformReward": lambda: wrappers.VectorizeTransformReward(build(), TransformReward, func=np.square),
    "DictInfoToList": lambda: wrappers.DictInfoToList(build()),
    "TransformObservation": bounded,
    "FilterObservation": lambda: wrappers.FilterObservation(build(obs=(STATE, AGENT_POS)), [STATE]),
    "FlattenObservation": lambda: wrappers.FlattenObservation(build(obs=(STATE, AGENT_POS))),
    "GrayscaleObservation": lambda: wrappers.GrayscaleObservation(of_key(IMAGE)),
    "ResizeObservation": lambda: wrappers.ResizeObservation(of_key(IMAGE), (3, 4)),
    "ReshapeObservation": lambda: wrappers.ReshapeObservation(of_key(STATE), (2, 1)),
    "RescaleObservation": lambda: wrappers.RescaleObservation(bounded(), 0.0, 1.0),
    "DtypeObservation": lambda: wrappers.DtypeObservation(of_key(STATE), np.float64),
    "TransformAction": lambda: wrappers.TransformAction(build(), within_one),
    "ClipAction": lambda: wrappers.ClipAction(build()),
    "RescaleAction": lambda: wrappers.RescaleAction(build(), -1.0, 1.0),
    "TransformReward": lambda: wrappers.TransformReward(build(), np.square),
    "ClipReward": lambda: wrappers.ClipReward(build(), -1.0, 0.5),
    "NormalizeReward": lambda: wrappers.NormalizeReward(build()),
    "RecordEpisodeStatistics": lambda: wrappers.RecordEpisodeStatistics(build()),
    "RecordVideo": lambda: wrappers.RecordVideo(build(video=True), tempfile.mkdtemp()),
    "HumanRendering": lambda: wrappers.HumanRendering(build(video=True)),
    "ArrayConversion": lambda: wrappers.ArrayConversion(build(), np, torch),
    "NumpyToTorch": lambda: wrappers.NumpyToTorch(build()),
}
JAX_ENVIRONMENTS_ALONE = {"JaxToNumpy", "JaxToTorch"}
NEXT_STEP_ALONE = {"NormalizeObservation"}


def test_every_wrapper_that_gymnasium_ships_is_tried_or_has_its_reason():
    assert set(wrappers.__all__) == set(WRAP) | JAX_ENVIRONMENTS_ALONE | NEXT_STEP_ALONE
    guide = (Path(__file__).resolve().parents[2] / "docs/guides/vector_env.md").read_text(encoding="utf-8")
    for name, library in (NOT_HERE | dict.fromkeys(NEXT_STEP_ALONE, "NEXT_STEP")).items():
        (line,) = [line for line in guide.splitlines() if f"`{name}`" in line]
        assert library in line


@pytest.mark.parametrize("name", WRAP)
def test_a_wrapper_of_gymnasium_takes_two_rows(name):
    if name in NOT_HERE:
        pytest.importorskip(NOT_HERE[name])
    env = WRAP[name]()
    for options in ({"seed": 1}, {"seed": [1, None]}, {"options": {"reset_mask": np.array([True, False])}}):
        obs, _ = env.reset(**options)
    for _ in range(3):
        obs, reward, terminated, truncated, info = env.step(FAST.copy())
    parts = obs.values() if isinstance(obs, dict) else [obs]
    assert all(len(values) == 2 for values in (*parts, reward, terminated, truncated))
    if isinstance(obs, (dict, np.ndarray)):
        assert env.observation_space.contains(obs)
    assert len(info) == 2 if isinstance(info, list) else {"success", "ended", "error"} <= set(info)
    env.close()


def test_the_wrapper_that_wants_rows_that_reset_themselves_says_so():
    with pytest.raises(ValueError, match="NEXT_STEP"):
        wrappers.NormalizeObservation(of_key(STATE))


def test_statistics_count_each_episode_once_when_a_loop_steps_on():
    env = wrappers.RecordEpisodeStatistics(build())
    env.reset(seed=1)
    for k in range(2 * MAX_STEPS):
        env.step(FAST if k < 2 else REST)
    assert env.episode_count == 2
    assert list(env.length_queue) == [2, MAX_STEPS]
    start = torch.rand(2, generator=torch.Generator().manual_seed(1))[0].item() * 0.1
    np.testing.assert_allclose(env.return_queue[0], (start + 0.6) + (start + 1.2), rtol=1e-6)


def test_actions_and_rewards_are_converted_by_value():
    env = wrappers.RescaleAction(build(), 0.0, 1.0)
    start = env.reset(seed=1)[0][STATE]
    moved = env.step(np.array([[0.5, 0.6], [0.5, 0.5]], np.float32))[0][STATE]
    np.testing.assert_allclose(moved - start, [[0, 0.2], [0, 0]], atol=1e-6)
    listed = wrappers.DictInfoToList(build())
    listed.reset(seed=1)
    *_, info = listed.step(FAST)
    assert info[0]["elapsed_steps"] == info[1]["elapsed_steps"] == 1
    assert info[0]["error"] is None


def test_what_a_wrapper_writes_into_an_observation_stays_out_of_the_environment():
    env = build()
    env.reset(seed=1)
    frames = [env.step(REST)[0][STATE]]
    frames[0] += 100
    np.testing.assert_array_less(env.step(REST)[0][STATE], 1)
    held, _, terminated, *_ = env.step(FAST + 1)
    assert terminated.tolist() == [True, True]
    held[STATE] += 100
    np.testing.assert_array_less(env.step(REST)[0][STATE], 3)
