"""The suites beside ours: physics, rewards and success to the bit; and each difference that docs/suites.md names."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch
from suite_rows import simulator, smooth_actions

if find_spec("metaworld") is None or find_spec("gymnasium_robotics") is None:
    pytest.skip("the MuJoCo suites are an extra, which is not installed", allow_module_level=True)

from manicm_ms.tasks.metaworld import MAX_EPISODE_STEPS, MetaWorldEnv
from test_adroit_table import suite_env as adroit_env
from test_metaworld_table import ROWS, suite_env

from manicm_ms.spec import STATE

STALE = ("dial-turn", "drawer-open", "faucet-open", "lever-pull", "window-close", "window-open")
SOME = (*STALE, "door-lock", "reach", "pick-place", "stick-pull", "hand-insert", "assembly")
STEPS = 15
NOW, FIRST_OBJECT, GOAL = slice(0, 18), slice(4, 7), slice(36, 39)  # of the state; the rest is the frame before


def actions(dim):
    return [action[0].numpy().astype(np.float64) for action in smooth_actions(dim, STEPS)]


@pytest.mark.parametrize("name", SOME)
def test_meta_world_plays_as_the_suite_does(name):
    theirs, ours = suite_env(name, seed=11), MetaWorldEnv(ROWS[f"metaworld/{name}"])
    ours.reset(11)
    assert np.array_equal(ours.data.qpos, theirs.data.qpos)
    for action in actions(4):
        obs, reward, _, _, info = theirs.step(action)
        outcome = ours.step(action)
        assert np.array_equal(ours.data.qpos, theirs.data.qpos)
        assert np.array_equal(ours.data.qvel, theirs.data.qvel)
        assert (outcome.reward, outcome.success) == (float(reward), bool(info["success"]))
        assert np.array_equal(ours.state()[NOW], obs[NOW])
        assert np.array_equal(ours.state()[GOAL], obs[GOAL])
    theirs.seed(12)
    first, _ = theirs.reset()
    ours.reset(12)
    gap = np.linalg.norm(ours.state()[FIRST_OBJECT] - first[FIRST_OBJECT])
    assert (gap > 0.01) == (name in STALE), "the suite's own first observation tells of the reset before it"
    assert gap < 0.25
    ours.close()


@pytest.mark.parametrize("name", ["door", "hammer", "pen"])
def test_adroit_plays_as_the_suite_does(name):
    theirs = adroit_env(name, seed=11)
    with simulator(f"adroit/{name}", seed=11, obs=(STATE,), reward_mode="dense") as ours:
        for action in smooth_actions(ours.spec.action.dim, STEPS):
            rewards = [theirs.step(action[0].numpy().astype(np.float64))[1] for _ in range(2)]
            result = ours.step(action)
            assert np.array_equal(ours.env.data.qpos, theirs.data.qpos)
            assert np.array_equal(ours.env.data.qvel, theirs.data.qvel)
            assert result.reward.item() == np.float32(sum(rewards))


# ---- what differs ---------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_mt1_draws_from_fifty_goals_and_ours_from_the_seed():
    import gymnasium
    import metaworld  # noqa: F401  (registers its ids)

    env = gymnasium.make("Meta-World/MT1", env_name="reach-v3", seed=5)
    assert env.spec.max_episode_steps == 500 > MAX_EPISODE_STEPS == 200
    again = [env.reset(seed=5)[0][GOAL].tolist() for _ in range(4)]
    assert len(set(map(tuple, again))) > 1, "the seed of its reset is not what decides"
    fixed = {tuple(env.reset()[0][GOAL].tolist()) for _ in range(80)}
    assert len(fixed) <= 50
    env.close()
    ours = MetaWorldEnv(ROWS["metaworld/reach"])
    goals = []
    for seed in (5, 5, *range(6, 26)):
        ours.reset(seed)
        goals.append(tuple(ours.state()[GOAL]))
    assert goals[0] == goals[1]
    assert len(set(goals)) == 21


def test_sparse_rewards_are_one_for_a_success_and_zero_else():
    """The suite's sparse Adroit tasks give 10 and -0.1 an environment step."""
    from gymnasium_robotics.envs.adroit_hand.adroit_door import AdroitHandDoorEnv

    theirs = AdroitHandDoorEnv(reward_type="sparse")
    theirs.reset(seed=3)
    still = np.zeros(28)
    assert theirs.step(still)[1] == -0.1
    with simulator("adroit/door", seed=3, obs=(STATE,)) as ours:
        assert ours.step(torch.zeros(1, 28)).reward.item() == 0
        ours.env.data.qpos[ours.env._env.door_hinge_addrs] = 1.4
        theirs.data.qpos[theirs.door_hinge_addrs] = 1.4
        assert theirs.step(still)[1] == 10
        assert ours.step(torch.zeros(1, 28)).reward.item() == 1
