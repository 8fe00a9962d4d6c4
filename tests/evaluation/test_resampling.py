"""Means over tasks and trainings: what replayed start states add, and what the interval then speaks of."""

import itertools

import numpy as np
import pytest

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.intervals import PairedCounts, paired_difference_interval, rate_interval
from manicm_ms.evaluation.resampling import (
    FEW,
    MANY_TRAININGS,
    RECIPE,
    THESE_NETWORKS,
    mean_difference,
    mean_rate,
    resampled_interval,
)


def outcomes(*rows):
    return np.array(rows, dtype=bool)


def test_one_training_of_one_task_gets_the_exact_interval():
    row = [True] * 7 + [False] * 3
    found = mean_rate([outcomes(row)])
    assert (found.mean, found.ci95) == (pytest.approx(0.7), pytest.approx(rate_interval(7, 10)))
    difference = mean_difference([np.array([[1, 0, 0, -1, 1, 0]])])
    assert difference.ci95 == pytest.approx(paired_difference_interval(PairedCounts(3, 1, 2, 0)))


def test_trainings_that_replay_the_same_outcomes_say_no_more_than_one():
    # As independent episodes, four such trainings would halve the interval.
    states = np.random.default_rng(0).random(50) < 0.7
    assert FEW <= states.sum() <= 50 - FEW
    once, often = resampled_interval([states[None]]), mean_rate([np.stack([states] * 4)]).ci95
    assert often == pytest.approx(once)
    low, high = rate_interval(int(4 * states.sum()), 200)
    assert often.high - often.low > 1.7 * (high - low)


def test_the_bootstrap_is_that_of_every_resample_of_the_start_states():
    tasks = [np.array([[1.0, 0.0, 1.0], [1.0, 1.0, 0.0]]), np.array([[0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])]
    means = [
        np.mean([task.mean(axis=0)[list(pick)].mean() for task, pick in zip(tasks, picks, strict=True)])
        for picks in itertools.product(itertools.product(range(3), repeat=3), repeat=2)
    ]  # 27 x 27 equally likely ones
    expected = np.quantile(means, [0.025, 0.975])
    assert resampled_interval(tasks, draws=40_000) == pytest.approx(expected, abs=0.09)
    low, high = resampled_interval(tasks, confidence=0.5, draws=40_000)
    assert (low, high) == pytest.approx(np.quantile(means, [0.25, 0.75]), abs=0.01)


def test_every_task_and_training_counts_once_and_is_listed():
    tasks = [outcomes([1, 1, 1, 1], [1, 1, 0, 0]), outcomes([0, 1], [0, 0])]
    found = mean_rate(tasks)
    assert found.by_training == pytest.approx(((1 + 0.5) / 2, (0.5 + 0) / 2))
    assert found.mean == pytest.approx(np.mean(found.by_training))
    assert found.speaks_of == THESE_NETWORKS


def test_from_five_trainings_on_the_interval_holds_how_trainings_differ():
    # Each training solves all of its start states or none: within these networks nothing is open, among others much.
    few = np.repeat([[True], [True], [False], [True]], 40, axis=1)
    many = np.repeat([[True], [True], [False], [True], [False]], 40, axis=1)
    assert len(many) == MANY_TRAININGS
    assert mean_rate([few]).speaks_of == THESE_NETWORKS
    found = mean_rate([many, many])
    assert found.speaks_of == RECIPE
    assert found.ci95.low < 0.4
    assert found.ci95.high > 0.8


def test_where_few_start_states_differ_the_exact_interval_of_the_states_stands():
    solved = np.ones((3, 50), dtype=bool)
    one = mean_rate([solved]).ci95
    assert one == pytest.approx(rate_interval(50, 50)), "of 50 states, not of 150 episodes"
    assert mean_rate([solved] * 4).ci95 == pytest.approx((1 - (1 - one.low) / 2, 1.0))
    nearly = solved.copy()
    nearly[1, 7] = False
    assert mean_rate([nearly]).ci95.low < one.low, "a failure more never narrows the interval"
    assert mean_rate([np.stack([nearly[1]] * 3)]).ci95 == pytest.approx(rate_interval(49, 50))
    equal = np.zeros((3, 50), dtype=int)
    assert mean_difference([equal]).ci95 == pytest.approx(paired_difference_interval(PairedCounts(50, 0, 0, 0)))


def test_the_interval_keeps_its_level_when_start_states_decide():
    # States of two tasks differ in how hard they are for all three trainings alike.
    random, covered, runs = np.random.default_rng(1), 0, 300
    for _ in range(runs):
        tasks = []
        for rate in (0.4, 0.8):
            hard = random.beta(rate, 1 - rate, size=50)  # success probability of each state, mean `rate`
            tasks.append(random.random((3, 50)) < hard)
        low, high = resampled_interval(tasks, draws=1000)
        covered += low <= 0.6 <= high
    assert 0.91 < covered / runs < 0.98


def test_what_cannot_be_averaged_is_refused():
    for tasks in ([], [np.zeros((0, 4))], [np.zeros((1, 0))], [np.zeros((1, 4)), np.zeros((2, 4))]):
        with pytest.raises(ConfigError, match=r"at least one task|same number of trainings"):
            mean_rate(tasks)
