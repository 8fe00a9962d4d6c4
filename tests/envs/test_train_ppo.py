"""The script that trains PPO: what it writes can be read back and played, and a stop keeps what was done."""

import json
import os
import signal
import sys
from pathlib import Path

import pytest
import torch
from point_mass_env import MAX_STEPS, SOUND

pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed (extra rl)")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts" / "examples"))

import train_ppo
from train_ppo import (
    CURVE,
    HELD,
    SETTINGS,
    WEIGHTS,
    Evaluate,
    Held,
    IdlePlayer,
    Train,
    evaluate,
    load_player,
    play,
    train,
)

from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import ConfigError
from manicm_ms.spec import STATE

SHORT = Train(env=SOUND, steps=2048, eval_every=1024, eval_episodes=6)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a short run on the point mass."""
    out = tmp_path_factory.mktemp("ppo") / "run"
    train(Train(**{**vars(SHORT), "out": out}))
    return out


@pytest.fixture(scope="module")
def env():
    env = make_vec(SOUND, 2, "cpu", obs=(STATE,), reward_mode="normalized_dense")
    yield env
    env.close()


def test_the_curve_begins_before_training_and_ends_after_it(run):
    curve = json.loads((run / CURVE).read_text())
    steps = [point["steps"] for point in curve]
    assert steps[0] == 0
    assert steps == sorted(set(steps))
    assert steps[-1] >= SHORT.steps
    assert all(point["episodes"] == SHORT.eval_episodes for point in curve)
    assert json.loads((run / SETTINGS).read_text())["env"] == SOUND


def test_the_weights_on_disk_play_the_last_point_of_the_curve(run, env):
    last = json.loads((run / CURVE).read_text())[-1]
    score = play(env, Held(load_player(run / WEIGHTS, env)), range(SHORT.eval_episodes))
    assert score.successes == last["successes"]
    assert score.mean_return == pytest.approx(last["mean_return"], abs=1e-9)


def test_a_run_is_never_overwritten(run):
    before = (run / WEIGHTS).read_bytes()
    with pytest.raises(ConfigError, match="exists"):
        train(Train(**{**vars(SHORT), "out": run}))
    assert (run / WEIGHTS).read_bytes() == before


def test_only_a_run_can_be_evaluated(tmp_path):
    with pytest.raises(ConfigError, match=WEIGHTS):
        evaluate(Evaluate(tmp_path))


def test_a_stop_keeps_curve_and_weights(tmp_path, monkeypatch):
    """The signal comes while the first point of the curve is made, a million steps before the end."""
    out = tmp_path / "stopped"
    save, signals = train_ppo.save_policy, [signal.SIGINT]

    def save_and_stop(*args):
        save(*args)
        for number in signals:
            os.kill(os.getpid(), number)
        signals.clear()

    monkeypatch.setattr(train_ppo, "save_policy", save_and_stop)
    train(Train(**{**vars(SHORT), "steps": 10**6, "out": out}))
    assert not signals
    steps = [point["steps"] for point in json.loads((out / CURVE).read_text())]
    assert steps[0] == 0
    assert steps[-1] < 100
    assert (out / WEIGHTS).is_file()


def test_an_action_is_held(env):
    class Counting(IdlePlayer):
        asked = 0

        def act(self, state):
            self.asked += 1
            return super().act(state) + self.asked

    player = Counting(2)
    held = Held(player)
    held.begin(torch.zeros(2, 2), [0, 1])
    actions = [held.act(torch.zeros(2, 2))[0, 0].item() for _ in range(2 * HELD)]
    assert actions == [1.0] * HELD + [2.0] * HELD
    held.begin(torch.zeros(2, 2), [0, 1])
    assert held.act(torch.zeros(2, 2))[0, 0] == 3


def test_every_seed_is_played_once_and_scored_by_hand(env):
    """The idle point mass earns its x at each step: 0.1 times the first number that its seed draws."""
    seeds = [3, 4, 5]  # not a multiple of the rows
    score = play(env, IdlePlayer(2), seeds)
    x = [torch.rand(2, generator=torch.Generator().manual_seed(seed))[0].item() * 0.1 for seed in seeds]
    assert (score.episodes, score.successes, score.mean_steps) == (3, 0, MAX_STEPS)
    assert score.mean_return == pytest.approx(sum(x) / 3, rel=1e-5)
