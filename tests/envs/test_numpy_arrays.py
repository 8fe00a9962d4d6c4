"""NumPy at the border: Gymnasium's vector contract, kept with every vector wrapper that Gymnasium ships."""

import importlib.util

import gymnasium.wrappers.vector as wrappers
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.wrappers import TransformReward
from point_mass_env import DIVERGE_Y, MAX_STEPS, SOUND, Raises, make_spec

from manicm_ms.envs.simulator import EnvEntry, SimulatorConfig
from manicm_ms.envs.vec_env import GpuVecEnv, NumpyVecEnv, make_vec
from manicm_ms.errors import ConfigError
from manicm_ms.types import AGENT_POS, IMAGE, STATE

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
    with pytest.raises(AttributeError):
        env.no_such_thing


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


def play(env, steps=4):
    env.reset(seed=1)
    return [env.step(FAST) for _ in range(steps)]


def flat(env):
    """Observations of a single array, which most wrappers want."""
    return wrappers.VectorizeTransformObservation(env, importlib.import_module("gymnasium").wrappers.FlattenObservation)


NOT_HERE = {
    "RecordVideo": "moviepy",
    "HumanRendering": "pygame",
    "ArrayConversion": "array_api_compat",
    "NumpyToTorch": "array_api_compat",
    "JaxToNumpy": "jax",
    "JaxToTorch": "jax",
}
"""Wrappers that need a library which the package does not bring."""

WRAP = {
    "VectorizeTransformObservation": flat,
    "VectorizeTransformAction": lambda env: wrappers.VectorizeTransformAction(
        env, importlib.import_module("gymnasium").wrappers.ClipAction
    ),
    "VectorizeTransformReward": lambda env: wrappers.VectorizeTransformReward(
        env, TransformReward, func=lambda reward: 2 * reward
    ),
    "DictInfoToList": wrappers.DictInfoToList,
    "TransformObservation": lambda env: wrappers.TransformObservation(env, lambda obs: obs),
    "FilterObservation": lambda env: wrappers.FilterObservation(env, [STATE]),
    "FlattenObservation": wrappers.FlattenObservation,
    "GrayscaleObservation": lambda env: wrappers.GrayscaleObservation(image_alone(env)),
    "ResizeObservation": lambda env: wrappers.ResizeObservation(image_alone(env), (3, 4)),
    "ReshapeObservation": lambda env: wrappers.ReshapeObservation(flat(env), (2, -1)),
    "RescaleObservation": lambda env: wrappers.RescaleObservation(bounded(env), 0.0, 1.0),
    "DtypeObservation": lambda env: wrappers.DtypeObservation(flat(env), np.float64),
    "NormalizeObservation": lambda env: wrappers.NormalizeObservation(flat(env)),
    "TransformAction": lambda env: wrappers.TransformAction(env, lambda action: action),
    "ClipAction": wrappers.ClipAction,
    "RescaleAction": lambda env: wrappers.RescaleAction(env, 0.0, 1.0),
    "TransformReward": lambda env: wrappers.TransformReward(env, lambda reward: reward),
    "ClipReward": lambda env: wrappers.ClipReward(env, 0.0, 0.5),
    "NormalizeReward": wrappers.NormalizeReward,
    "RecordEpisodeStatistics": wrappers.RecordEpisodeStatistics,
}
