"""The episode protocol on a real vector env: every seed once, crashes in the denominator, paired noise."""

import dataclasses
import itertools
import json

import numpy as np
import pytest
import torch
from point_mass import CHUNK, DT, REACH, SPEC, PointMass, Proportional

from manicm_ms.errors import BackendError, ConfigError, SpecMismatchError
from manicm_ms.evaluation.decisions import decision_noise
from manicm_ms.evaluation.rollout import MAX_RESTARTS, EpisodeResult, RestartableEnv, rollout
from manicm_ms.machine.devices import torch_threads
from manicm_ms.policies.finite import require_finite_actions
from manicm_ms.policies.methods import make_policy, student_of
from manicm_ms.spec import ActionSpec, ChunkSpec

SEEDS = list(range(100, 123))


def straight_line(seed, policy):
    """Play one episode by the closed form of the point mass, without env or batch."""
    pos, steps, decision = np.random.default_rng(seed).uniform(-1, 1, 2), 0, 0
    while True:
        noise = decision_noise(seed, decision, (1, CHUNK.horizon, 2))[0].numpy()[CHUNK.executed]
        decision += 1
        chunk = np.clip(-policy.gain.item() * pos.astype(np.float32) + policy.noise_scale * noise, -1, 1)
        for action in chunk:
            pos, steps = pos + DT * action, steps + 1
            if np.linalg.norm(pos) < REACH:
                return True, steps
            if steps == SPEC.max_episode_steps:
                return False, steps


@pytest.mark.parametrize("num_envs", [1, 3, 8, 40])
def test_every_seed_is_played_once_and_results_follow_the_order_of_the_seeds(num_envs):
    env, order = PointMass(num_envs), list(reversed(SEEDS))
    seen = []
    results = rollout(env, Proportional(), order, on_episode=seen.append)
    assert [r.seed for r in results] == order
    assert sorted(r.seed for r in seen) == SEEDS
    # A row that has nothing to play still needs a first reset; beyond those, each seed was reset once.
    spare = max(0, num_envs - len(SEEDS))
    assert len(env.played) == len(SEEDS) + spare


@pytest.mark.parametrize("num_envs", [1, 4])
def test_each_episode_is_the_one_its_seed_fixes(num_envs):
    policy = Proportional(gain=2.0, noise_scale=0.6)
    results = rollout(PointMass(num_envs), policy, SEEDS)
    assert {(r.seed, r.success, r.steps) for r in results} == {(s, *straight_line(s, policy)) for s in SEEDS}
    assert len({r.success for r in results}) == 2, "the seeds should hold successes and failures"
    assert all(r.decisions == -(-r.steps // CHUNK.n_action_steps) == len(r.actions) for r in results)


def test_results_do_not_depend_on_num_envs_or_order():
    one, many = rollout(PointMass(1), Proportional(), SEEDS), rollout(PointMass(7), Proportional(), SEEDS[::-1])
    assert one == many[::-1]
    for a, b in zip(one, many[::-1], strict=True):
        np.testing.assert_array_equal(a.actions, b.actions)


def test_the_batch_keeps_one_size():
    policy = Proportional()
    rollout(PointMass(5), policy, SEEDS)
    assert set(policy.batches) == {5}


def test_noise_differs_between_seeds_and_decisions_and_not_between_policies():
    first, second = rollout(PointMass(2), Proportional(gain=0.0, noise_scale=0.1), [3, 4])
    again = rollout(PointMass(1), Proportional(gain=0.0, noise_scale=0.1), [4])[0]
    np.testing.assert_array_equal(second.actions, again.actions)
    chunks = [c.tobytes() for c in itertools.chain(first.actions, second.actions)]
    assert len(set(chunks)) == len(chunks)


@pytest.mark.parametrize("nfe", [None, 4])
def test_a_network_gives_the_same_bits_in_any_order_and_nearly_the_same_at_any_batch_size(nfe):
    config = {
        "encoder": {"state_widths": (16, 16), "point_widths": (16, 32, 32)},
        "backbone": {"down_dims": (16, 32, 48)},
    }
    policy = make_policy("simple_dp3", SPEC, CHUNK, config, seed=0)
    policy = policy if nfe is None else student_of(policy, nfe=nfe)
    seeds = SEEDS[:6]
    with torch_threads(1):
        straight = rollout(PointMass(4), policy, seeds)
        shuffled = {r.seed: r for r in rollout(PointMass(4), policy, [*seeds[4:0:-1], 99])}  # other order, a part only
        singly = rollout(PointMass(1), policy, seeds)
    for result in straight:
        if result.seed in shuffled:
            np.testing.assert_array_equal(shuffled[result.seed].actions, result.actions)
    for result, alone in zip(straight, singly, strict=True):
        np.testing.assert_allclose(alone.actions[0], result.actions[0], atol=1e-5)


def test_policies_that_draw_more_noise_start_from_the_same():
    once, often = decision_noise(7, 3, (1, 4, 2)), decision_noise(7, 3, (4, 4, 2))
    assert torch.equal(once[0], often[0])
    assert len({n.numpy().tobytes() for n in often}) == 4
    many = torch.stack([decision_noise(s, d, (1, 4, 2)) for s in range(60) for d in range(60)])
    assert abs(many.mean()) < 0.02
    assert many.std() == pytest.approx(1.0, abs=0.02)


def test_a_crashed_row_is_a_failure_with_its_reason_and_disturbs_no_other():
    clean = rollout(PointMass(3), Proportional(), SEEDS)
    crashed = rollout(PointMass(3, crash_at={105: 2, 110: 4}), Proportional(), SEEDS)
    for before, after in zip(clean, crashed, strict=True):
        if after.seed in (105, 110):
            assert (after.success, after.crashed) == (False, "solver diverged")
        else:
            assert after == before
    assert len(crashed) == len(SEEDS)


class FailsToReset(PointMass):
    """Cannot set up the scenes of some seeds."""

    def reset(self, *, seed=None, options=None):
        obs, _ = super().reset(seed=seed, options=options)
        for i in np.flatnonzero(options["reset_mask"]):
            if self.seeds[i] in (100, 101, 102, 107):
                self.error[i], self.finished[i] = "no room for the block", True
        return obs, self._info()


@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_row_that_fails_at_its_reset_is_a_failure_without_a_decision(num_envs):
    clean = rollout(PointMass(num_envs), Proportional(), SEEDS)
    results = rollout(FailsToReset(num_envs), Proportional(), SEEDS)
    for before, after in zip(clean, results, strict=True):
        if after.seed in (100, 101, 102, 107):
            assert (after.success, after.decisions, after.crashed) == (False, 0, "no room for the block")
        else:
            assert after == before


def test_an_action_that_is_not_finite_fails_its_episode_alone():
    policy = Proportional(nan_above=0.5)
    results = rollout(PointMass(4), policy, SEEDS)
    starts = {s: np.random.default_rng(s).uniform(-1, 1, 2)[0] for s in SEEDS}
    failed = {r.seed for r in results if r.crashed is not None}
    assert failed == {s for s, x in starts.items() if x > 0.5}
    assert all("not finite" in r.crashed and not r.success for r in results if r.seed in failed)


class Refusing(Proportional):
    """Raises where an action is not finite, as the policies of the package do."""

    def act(self, obs, *, generator=None, noise=None):
        actions = super().act(obs, generator=generator, noise=noise)
        require_finite_actions(actions, self.name)
        return actions


@pytest.mark.parametrize("nan_above", [0.5, -2.0])
def test_a_policy_that_refuses_to_act_in_some_rows_acts_in_the_others(nan_above):
    expected = rollout(PointMass(4), Proportional(nan_above=nan_above), SEEDS)
    assert rollout(PointMass(4), Refusing(nan_above=nan_above), SEEDS) == expected


def test_an_env_that_dies_is_rebuilt_and_the_episodes_in_flight_have_crashed():
    made = []

    def make_env():
        made.append(PointMass(4, dies={107} if not made else ()))
        return made[-1]

    results = rollout(RestartableEnv(make_env), Proportional(), SEEDS)
    lost = [r for r in results if r.crashed is not None]
    assert len(made) == 2
    assert 107 in {r.seed for r in lost}
    assert len(lost) <= 4
    assert all("worker 0 died" in r.crashed and not r.success for r in lost)
    assert sorted(made[0].played + made[1].played) == SEEDS
    healthy = {r.seed: r for r in rollout(PointMass(4), Proportional(), SEEDS)}
    assert all(r == healthy[r.seed] for r in results if r.crashed is None)


def test_an_env_that_keeps_dying_ends_the_roll_out():
    made = []

    def make_env():
        made.append(PointMass(2, dies=set(SEEDS)))
        return made[-1]

    with pytest.raises(BackendError, match="times in a row"):
        rollout(RestartableEnv(make_env), Proportional(), SEEDS)
    assert len(made) == 1 + MAX_RESTARTS


def test_an_env_without_a_maker_ends_the_roll_out_and_what_was_finished_is_told():
    finished = []
    with pytest.raises(BackendError, match="worker 0 died"):
        rollout(PointMass(1, dies={110}), Proportional(), SEEDS, on_episode=finished.append)
    assert [r.seed for r in finished] == list(range(100, 110))


def test_success_follows_the_rule_of_the_env():
    class PassesThrough(PointMass):
        """Does not end on success, so that a point can leave the goal again."""

        def _step_row(self, i, action):
            reward = super()._step_row(i, action)
            self.finished[i] = self.steps[i] >= self.env_spec.max_episode_steps
            return reward

        def step(self, actions):
            obs, reward, _, truncated, info = super().step(actions)
            return obs, reward, torch.zeros(self.num_envs, dtype=torch.bool), truncated, info

    policy = Proportional(gain=3.0, noise_scale=0.9)
    by_rule = {
        rule: rollout(PassesThrough(4, spec=dataclasses.replace(SPEC, success_rule=rule)), policy, SEEDS)
        for rule in ("any", "last")
    }
    reached = {rule: sum(r.success for r in results) for rule, results in by_rule.items()}
    assert reached["last"] < reached["any"]
    assert all(a.success or not b.success for a, b in zip(by_rule["any"], by_rule["last"], strict=True))


def test_the_return_is_the_sum_of_all_rewards():
    result = rollout(PointMass(2), Proportional(), [100])[0]
    pos, total = np.random.default_rng(100).uniform(-1, 1, 2), 0.0
    for action in result.actions.reshape(-1, 2)[: result.steps]:
        pos = pos + DT * action.astype(np.float64)
        total -= np.linalg.norm(pos)
    assert result.total_return == pytest.approx(total, rel=1e-5)


def test_what_does_not_fit_is_refused_before_anything_is_played():
    env = PointMass(2)
    with pytest.raises(ConfigError, match="repeats"):
        rollout(env, Proportional(), [1, 1])
    with pytest.raises(ConfigError, match=r"chunk=policy\.chunk"):
        rollout(env, Proportional(chunk=ChunkSpec(2, 4, 2)), [1])
    with pytest.raises(ConfigError, match=r"chunk=policy\.chunk"):
        rollout(PointMass(2, chunk=None), Proportional(), [1])
    other = dataclasses.replace(SPEC, action=ActionSpec(SPEC.action.names, "torque", 20.0))
    with pytest.raises(SpecMismatchError, match="control_mode"):
        rollout(env, Proportional(spec=other), [1])
    assert env.played == []


def test_no_seeds_no_results():
    assert rollout(PointMass(2), Proportional(), []) == []


def test_a_result_survives_json():
    result = rollout(PointMass(2, crash_at={101: 5}), Proportional(), [100, 101])[1]
    back = EpisodeResult.from_record(json.loads(json.dumps(result.to_record(), allow_nan=False)))
    assert back == result
    np.testing.assert_array_equal(back.actions, result.actions)
    assert back.crashed == "solver diverged"


@pytest.mark.parametrize("num_envs", [1, 4])
def test_an_episode_ends_with_the_chunk_that_makes_success_certain_though_the_env_goes_on(num_envs):
    ending = rollout(PointMass(num_envs), Proportional(), SEEDS)
    going_on = rollout(PointMass(num_envs, goes_on=True), Proportional(), SEEDS)
    assert [e.success for e in going_on] == [e.success for e in ending]
    assert any(e.success for e in ending)
    for first, second in zip(ending, going_on, strict=True):
        assert second.decisions == first.decisions
        limit = min(second.decisions * CHUNK.n_action_steps, SPEC.max_episode_steps)
        assert first.steps <= second.steps == limit


def test_success_at_some_step_and_at_the_last_are_told_apart():
    goes_on = PointMass(4, goes_on=True)
    walks = rollout(goes_on, Proportional(gain=2.0, noise_scale=0.9), SEEDS, to_the_end=True)
    cut = rollout(PointMass(4, goes_on=True), Proportional(gain=2.0, noise_scale=0.9), SEEDS)
    assert {e.steps for e in walks} == {SPEC.max_episode_steps}
    assert [e.success for e in walks] == [e.success_once for e in walks] == [e.success for e in cut]
    for episode in walks:  # the truth: where the recorded actions lead
        pos = np.random.default_rng(episode.seed).uniform(-1, 1, 2)
        distances = []
        for action in np.clip(episode.actions.reshape(-1, 2)[: episode.steps], -1, 1).astype(np.float64):
            pos = pos + DT * action
            distances.append(np.linalg.norm(pos))
        assert episode.success_once == (min(distances) < REACH)
        assert episode.success_at_end == (distances[-1] < REACH)
    assert any(e.success_once and not e.success_at_end for e in walks)
    # An episode that was cut off at its success has an unknown end; the others ended by their time limit.
    assert {(e.success, e.success_at_end) for e in cut} == {(True, None), (False, False)}


def test_where_success_ends_the_episode_both_are_one():
    assert all(e.success == e.success_once == e.success_at_end for e in rollout(PointMass(4), Proportional(), SEEDS))
    crashed = rollout(PointMass(2, crash_at=dict.fromkeys(SEEDS, 1)), Proportional(), SEEDS[:4])
    assert {(e.success, e.success_once, e.success_at_end) for e in crashed} == {(False, False, False)}


def test_where_success_must_last_nothing_ends_early():
    spec = dataclasses.replace(SPEC, success_rule="last")
    results = rollout(PointMass(4, goes_on=True, spec=spec), Proportional(spec=spec), SEEDS)
    assert {e.steps for e in results} == {SPEC.max_episode_steps}
