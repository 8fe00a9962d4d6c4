"""Several trainings on the same start states: their mean, and what of it the start states or the trainings leave open.

Trainings of one task replay the same start states, so that T trainings on S states are not T x S independent episodes:
a hard state is hard for all of them. What is drawn again is therefore the start state, all trainings on it together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.intervals import CONFIDENCE, Interval, rate_interval, score_interval

MANY_TRAININGS = 5
"""From so many trainings on the interval speaks of the recipe: the trainings are drawn again as well."""
FEW = 10
"""Resampling fewer start states than this that differ from the rest gives intervals that are too short."""
DRAWS = 10_000
THESE_NETWORKS, RECIPE = "these networks", "the recipe"


class MeanOverTrainings(NamedTuple):
    """The mean over tasks and trainings, each task and each training of it counted once.

    Attributes:
        mean: a rate, or a difference of two rates.
        ci95: its interval.
        by_training: mean over tasks of each training, in their order.
        speaks_of: `THESE_NETWORKS`, or `RECIPE` where the interval holds what other trainings would give as well.
    """

    mean: float
    ci95: Interval
    by_training: tuple[float, ...]
    speaks_of: str


def mean_rate(tasks: Sequence[np.ndarray]) -> MeanOverTrainings:
    """Return the mean success rate over tasks with its interval.

    The interval is that of `resampled_interval`. Two cases, in which resampling gives intervals that are too short,
    get `exact_interval` with Clopper-Pearson limits: one training of one task, and fewer than `FEW` start states
    whose outcome differs from what is usual in their task.

    Args:
        tasks: (T, S) bool for each task, success of training t from start state s; T is the same for all, S may differ.

    Raises ConfigError where there is no task, or one without an episode.
    """
    return _mean(tasks, _rate_limits)


def mean_difference(tasks: Sequence[np.ndarray]) -> MeanOverTrainings:
    """Return the mean over tasks of a paired difference of success rates with its interval.

    As `mean_rate`, with Tango's score limits in the place of Clopper-Pearson's.

    Args:
        tasks: (T, S) integers in {-1, 0, 1} for each task: second minus first policy, training t, start state s.
    """
    return _mean(tasks, _difference_limits)


def resampled_interval(
    tasks: Sequence[np.ndarray], confidence: float = CONFIDENCE, draws: int = DRAWS, seed: int = 0
) -> Interval:
    """Return the percentile bootstrap interval of the mean over tasks, each counted once.

    Start states are drawn again within each task, all trainings together. From `MANY_TRAININGS` trainings on
    the trainings of each task are drawn again as well, apart from the start states (rows and columns of a table each on
    their own: A. B. Owen, "The pigeonhole bootstrap", Annals of Applied Statistics 1 (2007) 386-411).

    Args:
        tasks: (T, S) outcomes of each task.
        confidence: level of the interval.
        draws: resamples.
        seed: of the resamples.
    """
    random = np.random.default_rng(seed)
    total = np.zeros(draws)
    for values in tasks:
        trainings, states = values.shape
        drawn = random.integers(states, size=(draws, states))
        if trainings < MANY_TRAININGS:
            total += values.mean(axis=0)[drawn].mean(axis=1)
        else:
            weights = random.multinomial(trainings, np.full(trainings, 1 / trainings), size=draws) / trainings
            total += np.take_along_axis(weights @ values, drawn, axis=1).mean(axis=1)
    low, high = np.quantile(total / len(tasks), [0.5 - confidence / 2, 0.5 + confidence / 2])
    return Interval(float(low), float(high))


def _mean(tasks: Sequence[np.ndarray], limits: Callable[[np.ndarray], Interval]) -> MeanOverTrainings:
    values = _checked(tasks)
    single = len(values) == 1 and len(values[0]) == 1
    exact = single or sum(_unusual(task) for task in values) < FEW
    interval = exact_interval(values, limits) if exact else resampled_interval(values)
    by_training = np.mean([task.mean(axis=1) for task in values], axis=0)
    speaks_of = RECIPE if len(by_training) >= MANY_TRAININGS else THESE_NETWORKS
    return MeanOverTrainings(float(by_training.mean()), interval, tuple(map(float, by_training)), speaks_of)


def _checked(tasks: Sequence[np.ndarray]) -> list[np.ndarray]:
    values = [np.asarray(task, dtype=float) for task in tasks]
    if not values or any(task.ndim != 2 or task.size == 0 for task in values):
        raise ConfigError("a mean over tasks needs at least one task with one training and one episode")
    if len({len(task) for task in values}) > 1:
        raise ConfigError(f"all tasks need the same number of trainings, got {[len(task) for task in values]}")
    return values


def _unusual(task: np.ndarray) -> int:
    """Return how many start states (of many trainings: episodes) of a task differ from the most frequent outcome."""
    drawn = task.mean(axis=0) if len(task) < MANY_TRAININGS else task.ravel()
    return int(drawn.size - np.unique(drawn.round(9), return_counts=True)[1].max())


def exact_interval(tasks: Sequence[np.ndarray], limits: Callable[[np.ndarray], Interval]) -> Interval:
    """Return the interval of the mean of K tasks from the limits (l_k, u_k) of each, `limits` of its (T, S) outcomes.

    Tasks are independent. With the mean p_k of each, the limits are p - sqrt(sum_k (p_k - l_k)^2) / K and
    p + sqrt(sum_k (u_k - p_k)^2) / K; one task keeps its own.

    Source: "method of variance estimates recovery", G. Y. Zou and A. Donner, Statistics in Medicine 27 (2008)
    1693-1702.
    """
    below = above = 0.0
    for task in tasks:
        low, high = limits(task)
        below += (task.mean() - low) ** 2
        above += (high - task.mean()) ** 2
    mean, count = float(np.mean([task.mean() for task in tasks])), len(tasks)
    return Interval(mean - math.sqrt(below) / count, mean + math.sqrt(above) / count)


# Trainings on the same states count as one: the mean number of successes among S states. That is exact where trainings
# agree on every state, and too wide where they do not.


def _rate_limits(task: np.ndarray) -> Interval:
    return rate_interval(task.mean(axis=0).sum(), task.shape[1])


def _difference_limits(task: np.ndarray) -> Interval:
    won, lost = (np.mean(task == sign, axis=0).sum() for sign in (1, -1))
    return score_interval(won, lost, task.shape[1])
