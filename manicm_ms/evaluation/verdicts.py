"""What may be concluded from a paired comparison, in one word and in a plain sentence."""

from __future__ import annotations

from typing import NamedTuple

from manicm_ms.evaluation.anytime import ALPHA, require_margin
from manicm_ms.evaluation.intervals import DIFFERENCE_METHOD
from manicm_ms.evaluation.pairs import StateComparison
from manicm_ms.evaluation.power import EQUAL, POWER, NeededPairs, needed_pairs
from manicm_ms.wording import counted

BETTER, WORSE, NOT_WORSE, UNDERPOWERED = "better", "worse", "not worse", "underpowered"
NOT_COMPARABLE = "not comparable"
MARGIN = 0.05
"""The margin where none is asked for: 5 points."""


class Verdict(NamedTuple):
    """The conclusion about the second policy of a pair.

    Attributes:
        word: `BETTER`, `WORSE`, `NOT_WORSE` or `UNDERPOWERED`; see `judge`.
        within_margin: whether it is shown to be not worse by more than the margin, whatever the word is.
        needed: how many pairs would do, where the word is `UNDERPOWERED` and there is a pair.
    """

    word: str
    within_margin: bool
    needed: NeededPairs | None


def judge(found: StateComparison, p: float, margin: float, alpha: float = ALPHA) -> Verdict:
    """Return what may be concluded; the first of these that holds:

    1. better: McNemar's exact p is at most alpha and the second policy succeeded more often. It is then not worse.
    2. worse: the same p and less often. It may be within the margin all the same, which `within_margin` tells.
    3. not worse by more than the margin: the lower end of Tango's interval lies above -margin.
    4. underpowered: none of them.

    `NOT_COMPARABLE` is no conclusion from numbers: policies of other environments or other start states are refused
    before any are made.

    Args:
        found: the comparison over start states.
        p: its p value, corrected for the others that are printed with it.
        margin: difference of success rates, in (0, 1).
        alpha: level.
    """
    require_margin(margin)
    within = found.n > 0 and found.ci95.low > -margin
    if found.n > 0 and p <= alpha and found.difference != 0:
        better = found.difference > 0
        return Verdict(BETTER if better else WORSE, better or within, None)
    if within:
        return Verdict(NOT_WORSE, True, None)
    needed = needed_pairs(found.only_second, found.only_first, found.n, margin) if found.n else None
    return Verdict(UNDERPOWERED, False, needed)


def sentence(first: str, second: str, found: StateComparison, verdict: Verdict, margin: float, tests: int = 1) -> str:
    """Return the conclusion as a plain sentence or two.

    Args:
        first: name of the policy that is compared against.
        second: name of the other.
        found: their comparison.
        verdict: as `judge` returned it.
        margin: difference of success rates.
        tests: how many p values are corrected together.
    """
    points = f"{100 * margin:g} points"
    if found.n == 0:
        return f"Nothing can be said about {second} and {first}: no start state was played by both without a crash."
    numbers = difference_text(found)
    if verdict.word == UNDERPOWERED:
        if found.ci95.low > 0 or found.ci95.high < 0:
            hint = f"{counted(found.n, 'start state')} hint at a difference between {second} and {first}: {numbers}"
            observed = verdict.needed is not None and verdict.needed.supposing != EQUAL
            more = needed_sentence(found, verdict.needed, second, margin) if observed else "Play more episodes."
            return f"{hint}, which {_test(tests)} does not confirm. {more}"
        settled = f"{counted(found.n, 'start state')} cannot tell {second} from {first}: {numbers}."
        return f"{settled} {needed_sentence(found, verdict.needed, second, margin)}".strip()
    test = _test(tests)
    if verdict.word == BETTER:
        return f"{second} is better than {first} by {test}: {numbers}."
    if verdict.word == WORSE:
        mild = f", though by less than {points}" if verdict.within_margin else ""
        return f"{second} is worse than {first} by {test}{mild}: {numbers}."
    return f"{second} is not worse than {first} by more than {points}: {numbers}."


def _test(tests: int) -> str:
    return f"McNemar's exact test{'' if tests == 1 else f' corrected for {tests} comparisons'}"


def difference_text(found: StateComparison) -> str:
    """Return the difference of the success rates with its interval, in points."""
    low, high = (100 * limit for limit in found.ci95)
    return f"{100 * found.difference:+.1f} points ({DIFFERENCE_METHOD}, 95 %: {low:+.1f} to {high:+.1f})"


def needed_sentence(found: StateComparison, needed: NeededPairs | None, second: str, margin: float) -> str:
    """Return how many episodes would do, and under which supposition."""
    if needed is None:
        return ""
    claim = "is worse" if needed.claim == WORSE else f"is not worse by more than {100 * margin:g} points"
    if needed.supposing == EQUAL:
        discordant = 100 * (found.only_first + found.only_second) / found.n
        supposed = f"If both are equally good and differ on as many start states as here ({discordant:.0f} %)"
    else:
        supposed = "Equally good policies would have shown it by now; if the rates are those observed"
    many = "more than a million episodes" if needed.pairs is None else f"about {needed.pairs} episodes"
    return f"{supposed}, {many} of each would show that {second} {claim}, with a chance of {100 * POWER:g} %."
