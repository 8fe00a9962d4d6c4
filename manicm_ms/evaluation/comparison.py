"""The numbers of a comparison: a row for each policy, a verdict for each pair, p values corrected together."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

from manicm_ms.evaluation.anytime import ALPHA
from manicm_ms.evaluation.contestants import Contestant, states_known
from manicm_ms.evaluation.pairs import Paired, StateComparison, compare_states, pair_up
from manicm_ms.evaluation.results import INTERVALS, rate_entry
from manicm_ms.evaluation.statistics import holm
from manicm_ms.evaluation.verdicts import judge, sentence

SCHEMA_VERSION = 1
CORRECTION = "Holm"


class _Pair(NamedTuple):
    first: Contestant
    second: Contestant
    paired: Paired
    found: StateComparison


def compile_comparison(
    contestants: Sequence[Contestant],
    baseline: Contestant,
    seeds: Sequence[int],
    margin: float,
    all_pairs: bool,
    remarks: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the content of compare.json.

    Args:
        contestants: the policies, all of which were played from the start states of `seeds`.
        baseline: the one of them that the others are compared with.
        seeds: those that all have in common.
        margin: difference of success rates that does not matter.
        all_pairs: compare every policy with every other, not with the baseline alone.
        remarks: what else a reader must know.
    """
    others = [c for c in contestants if c is not baseline]
    asked = list(combinations([baseline, *others], 2)) if all_pairs else [(baseline, other) for other in others]
    pairs = []
    for first, second in asked:
        paired = pair_up(first.results(seeds), second.results(seeds))
        pairs.append(_Pair(first, second, paired, compare_states(paired.pairs)))
    corrected = holm([pair.found.p for pair in pairs])
    return {
        "schema_version": SCHEMA_VERSION,
        "env_id": baseline.env_id,
        "conditions": dict(baseline.conditions),
        "seeds": list(seeds),
        "start_states": "digest" if states_known(contestants, seeds) else "seed",
        "margin": margin,
        "alpha": ALPHA,
        "intervals": INTERVALS,
        "correction": CORRECTION,
        "baseline": baseline.name,
        "remarks": [*remarks, *_remarks(contestants, seeds)],
        "policies": [_row(contestant, seeds) for contestant in contestants],
        "pairs": [_entry(pair, p, margin, len(pairs)) for pair, p in zip(pairs, corrected, strict=True)],
    }


def _row(contestant: Contestant, seeds: Sequence[int]) -> dict[str, Any]:
    return {
        "name": contestant.name,
        "role": contestant.role,
        "source": contestant.source,
        "checkpoint": contestant.checkpoint,
        **rate_entry(contestant.results(seeds)),
    }


def _entry(pair: _Pair, corrected: float, margin: float, tests: int) -> dict[str, Any]:
    found, verdict = pair.found, judge(pair.found, corrected, margin)
    first, second = pair.first.name, pair.second.name
    return {
        "first": first,
        "second": second,
        "verdict": verdict.word,
        "sentence": sentence(first, second, found, verdict, margin, tests),
        "start_states": found.n,
        "both": found.both,
        "only_first": found.only_first,
        "only_second": found.only_second,
        "neither": found.neither,
        "difference": found.difference,
        "difference_ci95": list(found.ci95),
        "mcnemar_p": found.p,
        "corrected_p": corrected,
        "within_margin": verdict.within_margin,
        "needed": None if verdict.needed is None else verdict.needed._asdict(),
        "repeats": found.repeats,
        "left_out": pair.paired.left_out,
        "crashed_first": pair.paired.crashed_first,
        "crashed_second": pair.paired.crashed_second,
    }


def _remarks(contestants: Sequence[Contestant], seeds: Sequence[int]) -> list[str]:
    lines = []
    if not states_known(contestants, seeds):
        lines.append(
            "Some of these records hold no digest of the first states (an earlier version wrote them): start states "
            "are taken for the same by environment, realism preset, camera and seed."
        )
    for contestant in contestants:
        if (more := len(contestant.episodes) - len(seeds)) > 0:
            lines.append(f"{contestant.name}: {more} further episodes that not all of the others played are left out.")
        if contestant.stopped_when_decided:
            lines.append(
                f"{contestant.name}: its evaluation stopped when it was decided ({contestant.source}), so that its "
                "number of episodes was not planned; intervals and p values hold their level at planned numbers only."
            )
    return lines
