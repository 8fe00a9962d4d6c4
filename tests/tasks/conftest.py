"""ManiSkill environments of the UR3e's tasks without pictures, shared: building one takes longer than playing."""

import gymnasium as gym
import pytest
import torch


@pytest.fixture(scope="session")
def plain_env():
    """Return a function (gym id, which of its environments) -> environment with one row, made at the first call."""
    made = {}

    def get(gym_id, which=0):
        if (gym_id, which) not in made:
            torch.set_num_threads(1)
            made[gym_id, which] = gym.make(
                gym_id, num_envs=1, obs_mode="none", reward_mode="normalized_dense", sim_backend="physx_cpu"
            )
        return made[gym_id, which]

    yield get
    for env in made.values():
        env.close()
