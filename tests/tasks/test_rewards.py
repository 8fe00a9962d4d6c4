"""The dense reward of every UR3e task that has an expert: bounded, rising towards success, never better for idlers."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.spec import STATE

TASKS = [env_id for env_id in ENVS.names(tag="ur3e") if env_id in EXPERTS.names()]
SEEDS = (500, 501)
ROW = torch.zeros(1, dtype=torch.int64)
MARGIN = 0.2  # of the return, which lies in [0, 1]


@dataclass
class Episode:
    """Per control step: the reward, (L,), and the terms by name, (L,) each; whether it was a success."""

    rewards: np.ndarray
    terms: dict[str, np.ndarray]
    success: bool

    def value(self, limit):
        """The mean reward over the time limit: after a success every step counts 1, after a failure 0."""
        return (self.rewards.sum() + (limit - len(self.rewards)) * self.success) / limit


class Task:
    """One row of a task in this process."""

    def __init__(self, env_id):
        config = SimulatorConfig(obs=(STATE,), reward_mode="normalized_dense")
        self.spec = config.specialise(ENVS.get(env_id).spec)
        self.rows = ActionChunk(ENVS.get(env_id).build(self.spec, config))
        self.weights = self.rows.simulator.env.reward_weights
        self.limit = self.spec.max_episode_steps
        self.played = {}

    def play(self, kind, seed):
        """Return the episode of a seed; one that was played already is not played again."""
        if (kind, seed) not in self.played:
            self.played[kind, seed] = self._play(kind, seed)
        return self.played[kind, seed]

    @torch.inference_mode()
    def _play(self, kind, seed):
        history, _ = self.rows.reset(ROW, [seed])
        act = self._actor(kind, seed, history[STATE][:, -1])
        env, rewards, terms = self.rows.simulator.env, [], []
        while not (self.rows.terminated | self.rows.truncated).any():
            history, reward, _ = self.rows.step(act(history[STATE][:, -1])[:, None])
            rewards.append(reward.item())
            terms.append({name: value.item() for name, value in env.reward_terms(env.evaluate()).items()})
        assert self.rows.errors == [None]
        by_name = {name: np.array([step[name] for step in terms]) for name in terms[0]}
        return Episode(np.array(rewards), by_name, bool(self.rows.success_once[0]))

    def _actor(self, kind, seed, state):
        if kind == "expert":
            expert = EXPERTS.get(self.spec.env_id)(self.spec, 1, torch.device("cpu"), None)
            expert.reset(state, [seed], torch.ones(1, dtype=torch.bool))
            return expert.act
        generator = torch.Generator().manual_seed(seed)
        size = 1.0 if kind == "random" else 0.0
        return lambda _: size * (torch.rand(1, self.spec.action.dim, generator=generator) * 2 - 1)


@pytest.fixture(scope="module", params=TASKS)
def task(request):
    made = Task(request.param)
    yield made
    made.rows.simulator.close()


def test_every_task_is_here():
    assert "ur3e/slide-block" in TASKS


@pytest.mark.parametrize("seed", SEEDS)
def test_rewards_and_terms_lie_in_the_unit_interval_and_belong_together(task, seed):
    total = sum(task.weights.values())
    for kind in ("expert", "random"):
        episode = task.play(kind, seed)
        assert set(episode.terms) == set(task.weights)
        for name, values in episode.terms.items():
            assert ((values >= 0) & (values <= 1)).all(), name
        weighted = sum(weight * episode.terms[name] for name, weight in task.weights.items()) / total
        before_success = slice(None, -1) if episode.success else slice(None)
        np.testing.assert_allclose(episode.rewards[before_success], weighted[before_success], atol=1e-6)
        assert ((episode.rewards >= 0) & (episode.rewards <= 1)).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_the_reward_of_an_expert_rises_to_the_largest(task, seed):
    rewards = task.play("expert", seed).rewards
    assert task.play("expert", seed).success
    assert rewards[-1] == 1.0
    assert rewards[:-1].max() < 1.0, "only success earns the largest reward"
    thirds = [part.mean() for part in np.array_split(rewards, 3)]
    assert thirds == sorted(thirds)
    assert thirds[2] - thirds[0] > 0.1


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["idle", "random"])
def test_an_expert_earns_far_more_than_idle_or_random_actions(task, kind, seed):
    other = task.play(kind, seed)
    assert not other.success
    assert task.play("expert", seed).value(task.limit) > other.value(task.limit) + MARGIN
