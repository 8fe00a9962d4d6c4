"""Stable-Baselines3's contract of a vector environment, kept by ours: resets, last frames, time limits."""

import numpy as np
import pytest
import torch
from point_mass_env import MAX_STEPS, SOUND

pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed (extra rl)")

from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from manicm_ms.envs.sb3 import AbsorbingSuccess, StableBaselinesEnv, normalized_return
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import ConfigError
from manicm_ms.spec import AGENT_POS, STATE, ChunkSpec

REST = np.zeros((2, 2), np.float32)
CRASH = np.array([[0.0, -1.0], [0.0, 0.0]], np.float32)  # the first row cannot be observed after its fourth step
FAST = np.array([[0.6, 0.0], [0.0, 0.0]], np.float32)  # the first row succeeds in its second step


@pytest.fixture(scope="module")
def two_rows():
    env = make_vec(SOUND, 2, "cpu", obs=(STATE,))
    yield env
    env.close()


@pytest.fixture
def venv(two_rows):
    return StableBaselinesEnv(two_rows, seed=10)


def start(seed):
    """Where the episode of a seed begins, by the definition of the point mass."""
    return (torch.rand(2, generator=torch.Generator().manual_seed(seed)) * 0.1).numpy()


def test_spaces_and_types(venv):
    assert venv.observation_space.shape == (2,)
    assert venv.action_space.shape == (2,)
    obs = venv.reset()
    assert obs.shape == (2, 2)
    obs, rewards, dones, infos = venv.step(REST)
    assert all(isinstance(part, np.ndarray) for part in (obs, rewards, dones))
    assert (obs.dtype, rewards.dtype, dones.dtype) == (np.float32, np.float32, bool)
    assert rewards.shape == dones.shape == (2,)
    assert infos == [{}, {}]
    assert venv.observation_space.contains(obs[0])


def test_several_keys_make_a_dictionary():
    env = make_vec(SOUND, 1, "cpu", obs=(STATE, AGENT_POS))
    try:
        venv = StableBaselinesEnv(env)
        obs = venv.reset()
        assert set(obs) == {STATE, AGENT_POS} == set(venv.observation_space.spaces)
        for _ in range(2):
            *_, dones, infos = venv.step(FAST[:1])
    finally:
        env.close()
    assert dones.tolist() == [True]
    assert set(infos[0]["terminal_observation"]) == {STATE, AGENT_POS}


def test_an_ended_row_begins_the_next_seed_and_keeps_its_last_frame(venv):
    first = venv.reset()
    np.testing.assert_allclose(first, [start(10), start(11)])
    venv.step(FAST)
    obs, rewards, dones, infos = venv.step(FAST)
    assert dones.tolist() == [True, False]
    np.testing.assert_allclose(obs, [start(12), start(11)])
    last = start(10) + 2 * FAST[0]
    np.testing.assert_allclose(infos[0]["terminal_observation"], last, rtol=1e-6)
    np.testing.assert_allclose(rewards[0], last[0], rtol=1e-6)
    assert infos[0]["is_success"] is True
    assert infos[0]["TimeLimit.truncated"] is False
    assert infos[1] == {}
    obs, rewards, dones, _ = venv.step(FAST)  # the new episode plays, and is not frozen
    np.testing.assert_allclose(obs[0], start(12) + FAST[0], rtol=1e-6)
    assert rewards[0] > 0
    assert not dones.any()


def test_the_time_limit_is_told_apart_from_an_end(venv):
    venv.reset()
    for _ in range(MAX_STEPS):
        _, _, dones, infos = venv.step(REST)
    assert dones.tolist() == [True, True]
    assert [info["TimeLimit.truncated"] for info in infos] == [True, True]
    assert [info["is_success"] for info in infos] == [False, False]
    np.testing.assert_allclose(infos[1]["terminal_observation"], start(11))


def test_a_crash_ends_an_episode_without_success(venv):
    venv.reset()
    dones = np.zeros(2, bool)
    while not dones.any():
        _, rewards, dones, infos = venv.step(CRASH)
    assert infos[0]["is_success"] is False
    assert infos[0]["TimeLimit.truncated"] is False
    assert "no picture" in infos[0]["error"]
    assert np.isfinite(rewards).all()


def test_episodes_follow_the_first_seed_alone(venv):
    def run():
        venv.seed(100)
        seen = [venv.reset()]
        rng = np.random.default_rng(0)
        for _ in range(3 * MAX_STEPS):
            obs, rewards, *_ = venv.step(rng.uniform(-1, 1, (2, 2)).astype(np.float32))
            seen.append(np.column_stack([obs, rewards]))
        return np.concatenate([seen[0].ravel(), *[s.ravel() for s in seen[1:]]])

    np.testing.assert_array_equal(run(), run())


def test_an_action_is_held_for_a_chunk():
    env = make_vec(SOUND, 2, "cpu", obs=(STATE,), chunk=ChunkSpec(n_obs_steps=2, horizon=4, n_action_steps=3))
    try:
        venv = StableBaselinesEnv(env, seed=10)
        assert venv.reset().shape == (2, *venv.observation_space.shape) == (2, 2)
        assert venv.action_space.shape == (2,)
        move = np.array([[0.1, 0.0], [0.0, -0.2]], np.float32)
        obs, rewards, *_ = venv.step(move)
        begin = np.array([start(10), start(11)])
        np.testing.assert_allclose(obs, begin + 3 * move, rtol=1e-5)
        np.testing.assert_allclose(rewards, 3 * begin[:, 0] + (1 + 2 + 3) * move[:, 0], rtol=1e-5)
        *_, infos = venv.step(np.array([[0.3, 0.0], [0.0, 0.0]], np.float32))  # beyond the goal after 3 of them
        np.testing.assert_allclose(infos[0]["terminal_observation"], begin[0] + (1.2, 0.0), rtol=1e-5)
    finally:
        env.close()


def test_rows_have_no_attributes_or_methods_of_their_own(venv):
    assert venv.get_attr("render_mode") == [None, None]
    with pytest.raises(ConfigError, match="video=True"):
        venv.get_images()
    assert venv.env_is_wrapped(VecMonitor) == [False, False]
    with pytest.raises(ConfigError, match="gravity"):
        venv.set_attr("gravity", 0)
    with pytest.raises(ConfigError, match="explode"):
        venv.env_method("explode")
    with pytest.raises(ConfigError, match="negative"):
        venv.seed(-1)


def test_pictures_and_the_spec_are_those_of_the_environment():
    env = make_vec(SOUND, 2, "cpu", obs=(STATE,), video=True, arrays="numpy")
    try:
        venv = StableBaselinesEnv(env, seed=10)
        np.testing.assert_allclose(venv.reset(), [start(10), start(11)])
        images = venv.get_images()
        assert venv.render_mode == "rgb_array"
        assert [image.shape for image in images] == [(4, 4, 3)] * 2
        assert venv.render().shape == (8, 4, 3), "both rows in one picture"
        assert [spec.id for spec in venv.get_attr("spec")] == [SOUND] * 2
        assert venv.get_attr("spec", indices=0)[0].max_episode_steps == MAX_STEPS
        assert venv.get_attr("env_spec")[0].env_id == SOUND
    finally:
        env.close()


# ---- what an ended episode is worth ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("gamma", "largest"), [(0.0, 1.0), (0.9, 1.0), (0.9, 4.0)])
def test_success_goes_on_to_earn_the_largest_reward(venv, gamma, largest):
    rows = AbsorbingSuccess(venv, gamma, largest)
    rows.reset()
    _, rewards, *_ = rows.step(FAST)
    np.testing.assert_allclose(rewards[0], start(10)[0] + 0.6, rtol=1e-6)
    _, rewards, dones, _ = rows.step(FAST)
    assert dones.tolist() == [True, False]
    for_ever = float(start(10)[0] + 1.2) + sum(gamma**k * largest for k in range(1, 1000))
    np.testing.assert_allclose(rewards, [for_ever, start(11)[0]], rtol=1e-5)


def test_neither_the_time_limit_nor_a_crash_pays(venv):
    rows = AbsorbingSuccess(venv, 0.9)
    rows.reset()
    for _ in range(MAX_STEPS):
        _, rewards, dones, infos = rows.step(CRASH)
        if dones[0]:
            assert infos[0]["error"]
            assert 0 <= rewards[0] <= 0.1
    assert dones[1]
    np.testing.assert_allclose(rewards[1], start(11)[0], rtol=1e-6)


@pytest.mark.parametrize("gamma", [-0.1, 1.0])
def test_a_discount_without_a_finite_sum_is_refused(venv, gamma):
    with pytest.raises(ConfigError, match="gamma"):
        AbsorbingSuccess(venv, gamma)


def test_normalized_return_prefers_early_success():
    rewards, steps = torch.tensor([30.0, 60.0, 5.0]), torch.tensor([50, 120, 20])
    value = normalized_return(rewards, steps, torch.tensor([True, False, False]), 120)
    torch.testing.assert_close(value, torch.tensor([100.0, 60.0, 5.0]) / 120)


# ---- PPO on top ------------------------------------------------------------------------------------------------------


def test_ppo_learns_to_reach_the_goal(two_rows):
    """The point mass needs 2 or more large steps to the right: a policy that drifts takes the time limit."""

    def successes(model, episodes=8):
        obs, ends = rows.reset(), []
        while len(ends) < episodes:
            obs, _, dones, infos = rows.step(model.predict(obs, deterministic=True)[0])
            ends += [info["is_success"] for done, info in zip(dones, infos, strict=True) if done]
        return sum(ends) / len(ends)

    rows = VecNormalize(AbsorbingSuccess(VecMonitor(StableBaselinesEnv(two_rows)), 0.9), gamma=0.9)
    model = PPO("MlpPolicy", rows, n_steps=64, n_epochs=5, gamma=0.9, learning_rate=3e-3, seed=0, device="cpu")
    before = successes(model)
    model.learn(1000)
    assert model.num_timesteps >= 1000
    assert before < 0.5 < 0.9 <= successes(model)
