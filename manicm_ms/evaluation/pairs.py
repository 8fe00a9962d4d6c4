"""Pairs of episodes of two policies from the same start state: which count, and which are repeats of one state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from manicm_ms.evaluation.intervals import CONFIDENCE, Interval, PairedCounts, score_interval
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.evaluation.statistics import mcnemar_exact


class Pair(NamedTuple):
    """Two episodes from one start state.

    Attributes:
        state: what tells the start state from others: its digest, or the seed where records lack digests.
        first: whether the first policy succeeded.
        second: whether the second did.
    """

    state: str | int
    first: bool
    second: bool


class Paired(NamedTuple):
    """The pairs of two policies.

    Attributes:
        pairs: those that count, in the order of the seeds.
        crashed_first: pairs left out because the simulation of the first policy's episode crashed.
        crashed_second: those of the second's; a pair may be among both.
        left_out: pairs left out, each counted once.
    """

    pairs: list[Pair]
    crashed_first: int
    crashed_second: int
    left_out: int


def pair_up(first: Sequence[EpisodeResult], second: Sequence[EpisodeResult]) -> Paired:
    """Pair two lists of episodes of which entry i has the same seed.

    A crash of the infrastructure says nothing about a policy and takes its pair out on both sides. An action that is
    not finite is the policy's own doing: that episode stays, as a failure.
    """
    both = list(zip(first, second, strict=True))
    crashed = [(a.infrastructure_crashed, b.infrastructure_crashed) for a, b in both]
    pairs = [
        Pair(a.seed if a.start_state is None else a.start_state, a.success, b.success)
        for (a, b), either in zip(both, crashed, strict=True)
        if not any(either)
    ]
    return Paired(pairs, sum(a for a, _ in crashed), sum(b for _, b in crashed), sum(map(any, crashed)))


def without_repeats(pairs: Sequence[Pair]) -> list[Pair]:
    """Return the first pair of each start state, in their order: what a bet on the next pair may go on."""
    first: dict[str | int, Pair] = {}
    for pair in pairs:
        first.setdefault(pair.state, pair)
    return list(first.values())


def differences(pairs: Sequence[Pair]) -> NDArray[np.float64]:
    """Return second minus first of each pair, (T,) of -1, 0 and 1."""
    return np.array([float(pair.second) - float(pair.first) for pair in pairs])


class StateComparison(NamedTuple):
    """Two policies compared over start states, of which several pairs on one state count as one.

    Attributes:
        n: start states.
        both: start states on which both succeeded; a fraction where repeats of one state differ.
        only_first: those on which the first policy alone did.
        only_second: those on which the second alone did.
        neither: those on which neither did.
        difference: success rate of the second minus that of the first; 0 where there is no state.
        ci95: Tango's score interval of it.
        p: two-sided p of McNemar's exact test; of states with repeats the sign of their mean difference counts.
        repeats: pairs beyond the first of their start state.
    """

    n: int
    both: float
    only_first: float
    only_second: float
    neither: float
    difference: float
    ci95: Interval
    p: float
    repeats: int


def compare_states(pairs: Sequence[Pair], confidence: float = CONFIDENCE) -> StateComparison:
    """Compare two policies over the start states of their pairs; repeats on one state are one cluster, its mean.

    Without repeats these are the paired counts, Tango's interval and McNemar's exact test as ever. The mean of repeats
    varies less than one pair does, so that the interval does not become too short.
    """
    by_state: dict[str | int, list[Pair]] = {}
    for pair in pairs:
        by_state.setdefault(pair.state, []).append(pair)
    n = len(by_state)
    if n == 0:
        return StateComparison(0, 0, 0, 0, 0, 0.0, Interval(-1.0, 1.0), 1.0, 0)
    cells = np.array([_cells(those) for those in by_state.values()])  # (n, 4)
    both, c, b, neither = (float(total) for total in cells.sum(axis=0))
    signs = np.sign(cells[:, 2] - cells[:, 1])
    p = mcnemar_exact(PairedCounts(0, int((signs < 0).sum()), int((signs > 0).sum()), 0))
    ci95 = score_interval(b, c, n, confidence)
    return StateComparison(n, both, c, b, neither, (b - c) / n, ci95, p, len(pairs) - n)


def _cells(pairs: Sequence[Pair]) -> list[float]:
    """Return the shares of pairs in which both, the first alone, the second alone and neither succeeded."""
    kinds = [(True, True), (True, False), (False, True), (False, False)]
    return [sum((pair.first, pair.second) == kind for pair in pairs) / len(pairs) for kind in kinds]


def states_differ(first: Mapping[int, EpisodeResult], second: Mapping[int, EpisodeResult]) -> list[int]:
    """Return the common seeds on which two policies met different start states; where a digest lacks none is told."""
    known = [s for s in first if s in second and None not in (first[s].start_state, second[s].start_state)]
    return [s for s in known if first[s].start_state != second[s].start_state]
