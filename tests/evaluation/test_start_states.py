"""The digest of the first state: that of its bytes, unseen by policies, alike for all of them, kept in the records."""

import dataclasses
import hashlib

import numpy as np
import pytest
import torch
from point_mass import PointMass, Proportional

from manicm_ms.envs.env_request import EnvRequest
from manicm_ms.errors import UserPolicyError
from manicm_ms.evaluation.pairs import states_differ
from manicm_ms.evaluation.play import env_maker
from manicm_ms.evaluation.rollout import EpisodeResult, rollout, start_digest
from manicm_ms.evaluation.user_policy import UserPolicy

ENV = "metaworld/reach"


def test_it_is_that_of_the_bytes_of_the_state_alone():
    state = torch.tensor([[[9.0, 9.0], [0.5, -1.0]]])
    digest = hashlib.sha256(np.array([0.5, -1.0], "<f4").tobytes()).hexdigest()[:16]
    assert start_digest({"state": state, "point_cloud": torch.rand(1, 2, 4, 3)}, 0) == digest
    assert start_digest({"agent_pos": state}, 0) is None
    assert start_digest({"state": torch.zeros(1, 2, 0)}, 0) is None


def test_two_policies_meet_on_the_same_states_and_other_seeds_are_others():
    seeds = range(30)
    first = rollout(PointMass(4), Proportional(gain=0.1), seeds)
    second = rollout(PointMass(3), Proportional(gain=3.0), list(seeds)[::-1])[::-1]
    assert [e.start_state for e in first] == [e.start_state for e in second]
    assert len({e.start_state for e in first}) == 30
    assert [EpisodeResult.from_record(e.to_record()).start_state for e in first] == [e.start_state for e in first]
    assert states_differ({e.seed: e for e in first}, {e.seed: e for e in second}) == []
    moved = {e.seed: EpisodeResult(e.seed, True, 1, 1, 0.0, start_state="x" if e.seed == 4 else None) for e in first}
    assert states_differ({e.seed: e for e in first}, moved) == [4], "where a digest lacks none is told"


class Sees(Proportional):
    def act(self, obs, **kwargs):
        self.seen = set(obs)
        return super().act(obs, **kwargs)


def test_a_policy_sees_the_state_only_where_it_reads_it():
    blind, told = Sees(), Sees()
    told.keys = ("agent_pos", "state")
    for policy in (blind, told):
        rollout(PointMass(2), policy, [1, 2])
    assert blind.seen == {"agent_pos", "point_cloud"}
    assert "state" in told.seen


def test_the_real_environments_of_an_evaluation_give_it_whatever_a_policy_reads():
    request, digests = EnvRequest(ENV, "cpu"), []
    for points in (16, 64):
        spec = request.entry.spec
        policy = Proportional(spec=dataclasses.replace(spec, obs=dataclasses.replace(spec.obs, num_points=points)))
        env = env_maker(request).for_policy(policy, 1, "clean")
        try:
            digests.append(start_digest(env.reset(seed=[7])[0], 0))
        finally:
            env.close()
    assert digests[0] is not None
    assert digests[0] == digests[1]


class TurnsBad:
    """Acts well at first, then with actions of another shape."""

    chunk = PointMass(1).chunk

    def __init__(self):
        self.decisions = 0

    def act(self, obs, noise, state):
        self.decisions += 1
        actions = torch.zeros(len(noise), 3, 2)
        return (actions if self.decisions < 3 else actions[:, :, :1]), state


def test_a_users_policy_whose_shape_turns_wrong_ends_in_one_line_and_no_success():
    finished = []
    env = PointMass(2)
    with pytest.raises(UserPolicyError, match=r"have shape \(2, 3, 1\), and \(N, Ta, Da\) is \(2, 3, 2\)"):
        rollout(env, UserPolicy("mine.py:make", TurnsBad(), env.env_spec), range(4), on_episode=finished.append)
    assert not any(episode.success for episode in finished)
