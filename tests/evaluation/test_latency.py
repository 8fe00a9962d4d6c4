"""Latency measures what it says: ratios of real work, threads restored, every policy timed in turn."""

import time

import numpy as np
import pytest
import torch
from point_mass import SPEC, Proportional

from manicm_ms.demos.stats import field_stats
from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.latency import measure_latency
from manicm_ms.machine.devices import torch_threads
from manicm_ms.policies import example_observations
from manicm_ms.policies.methods import make_policy
from manicm_ms.policies.policy import typical_observations


class Busy(Proportional):
    """Takes at least `seconds` per decision and notes when it was asked, and with how many threads."""

    def __init__(self, seconds, calls, name):
        super().__init__()
        self.seconds, self.calls, self.name = seconds, calls, name

    def act(self, obs, *, generator=None, noise=None):
        self.calls.append((self.name, torch.get_num_threads()))
        until = time.perf_counter() + self.seconds
        while time.perf_counter() < until:
            pass
        return super().act(obs, generator=generator, noise=noise)


def test_times_have_the_work_as_lower_bound_and_the_right_order():
    calls = []
    fast, slow = Busy(0.001, calls, "fast"), Busy(0.01, calls, "slow")
    measured = measure_latency({"fast": fast, "slow": slow}, repetitions=9, warmup=2)
    assert measured["fast"].median_ms >= 1.0
    assert measured["slow"].median_ms >= 10.0
    assert measured["fast"].median_ms < measured["slow"].median_ms
    assert measured["slow"].p95_ms >= measured["slow"].median_ms


def test_policies_take_turns_after_warm_up():
    calls = []
    measured = measure_latency({n: Busy(0.0, calls, n) for n in "ab"}, repetitions=5, warmup=2)
    assert [name for name, _ in calls] == ["a", "b"] * 7
    assert measured["a"].n == 5


def test_threads_are_set_within_and_restored_after_also_on_an_error():
    before = torch.get_num_threads()
    calls = []
    measured = measure_latency({"a": Busy(0.0, calls, "a")}, repetitions=1, warmup=0, threads=before + 1)
    assert calls == [("a", before + 1)]
    assert (measured["a"].threads, torch.get_num_threads()) == (before + 1, before)
    with pytest.raises(RuntimeError, match="inside"), torch_threads(before + 2):
        raise RuntimeError("inside")
    assert torch.get_num_threads() == before


def test_the_circumstances_travel_with_the_number():
    policy = Proportional().double()
    measured = measure_latency({"a": policy}, repetitions=1, warmup=0)["a"]
    assert (measured.dtype, measured.device, measured.nfe) == ("float64", "cpu", 1)


def test_example_observations_have_the_shapes_of_the_spec():
    policy = Proportional()
    obs = example_observations(policy)
    assert obs.keys() == {"point_cloud", "agent_pos"}
    assert obs["point_cloud"].shape == (1, 2, 4, 3)
    assert obs["agent_pos"].shape == (1, 2, 2)
    assert torch.equal(obs["point_cloud"], example_observations(policy)["point_cloud"])
    assert not torch.equal(obs["point_cloud"], example_observations(policy, seed=1)["point_cloud"])
    assert example_observations(policy, batch=5)["agent_pos"].shape == (5, 2, 2)


def test_example_observations_are_of_what_the_policy_reads():
    policy = Proportional()
    policy.keys = ("agent_pos", "image")
    obs = example_observations(policy, 3)
    assert {key: tuple(value.shape) for key, value in obs.items()} == {
        "agent_pos": (3, 2, 2),
        "image": (3, 2, *SPEC.obs.image_size, 3),
    }


def test_senseless_counts_are_refused():
    with pytest.raises(ConfigError, match="repetitions=0"):
        measure_latency({"a": Proportional()}, repetitions=0)


def test_decisions_are_timed_on_observations_within_what_was_learnt():
    """A hair's breadth of training data: numbers from 0 to 1 would lie a thousand ranges away, and blow networks up."""
    policy = make_policy("pocket_dp3", SPEC, size="smoke", seed=0)
    rng = np.random.default_rng(0)
    channels = {"point_cloud": 3, "agent_pos": SPEC.obs.agent_pos_dim, "action": SPEC.action.dim}
    data = {key: rng.uniform(0.5, 0.501, (8, n)).astype(np.float32) for key, n in channels.items()}
    policy.fit_normalizer({key: field_stats(values, key) for key, values in data.items()})
    obs = typical_observations(policy, 4)
    for key, value in obs.items():
        assert policy.normalizer.normalize(key, value).abs().max() <= 1 + 1e-3
        assert value.std() > 0
    assert policy.normalizer.normalize("point_cloud", example_observations(policy)["point_cloud"]).abs().max() > 100
    assert measure_latency({"pocket": policy}, repetitions=1, warmup=0)["pocket"].nfe == 2
