"""A rollout survives the death of a worker process of the real simulator."""

import os
import signal

import pytest

from manicm_ms.envs.vec_env import make_vec
from manicm_ms.evaluation.rollout import RestartableEnv, rollout
from manicm_ms.policies.methods import make_policy
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, ChunkSpec

CHUNK = ChunkSpec(n_obs_steps=2, horizon=4, n_action_steps=3)
SEEDS = list(range(6))


@pytest.fixture
def home():
    home = RestartableEnv(lambda: make_vec("ur3e/slide-block", 2, "cpu", obs=(POINT_CLOUD, AGENT_POS), chunk=CHUNK))
    yield home
    home.close()


def test_a_killed_worker_costs_the_episodes_in_flight_and_no_other(home):
    tiny = {
        "inputs": {"points": {"max_points": 64}},
        "backbone": {"down_dims": (16, 32)},
        "head": {"num_inference_steps": 1},
    }
    policy = make_policy("simple_dp3", home.env.env_spec, CHUNK, tiny, seed=0)
    killed = []

    def kill_once(_):
        if not killed:
            killed.append(home.env._workers.processes[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    results = rollout(home, policy, SEEDS, on_episode=kill_once)
    assert [r.seed for r in results] == SEEDS
    crashed = [r for r in results if r.crashed]
    assert 1 <= len(crashed) <= 2, "as many as were in flight on two rows"
    assert all("died" in r.crashed and not r.success for r in crashed)
    assert all(r.steps > 0 for r in results if not r.crashed)
