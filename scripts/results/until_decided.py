"""How many pairs an evaluation takes that stops when it is decided, by simulation, beside a planned number.

`python scripts/results/until_decided.py --write` keeps the tables in docs/results/until_decided.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from numpy.typing import NDArray

from manicm_ms.evaluation.anytime import EACH_ALPHA, log_not_worse, log_worse
from manicm_ms.evaluation.power import LOOK, chance_of_not_worse, least_pairs, shows_not_worse
from manicm_ms.paths import write_text

PAGE = Path(__file__).parents[2] / "docs" / "results" / "until_decided.md"
PATHS = 200
"""Comparisons simulated at once, for memory."""


class Case(NamedTuple):
    """Two policies: in which shares of pairs the second alone succeeds, and the first alone."""

    name: str
    only_second: float
    only_first: float


CASES = (
    Case("always agree", 0.0, 0.0),
    Case("equal, 2 % each way", 0.02, 0.02),
    Case("equal, 5 % each way", 0.05, 0.05),
    Case("equal, 10 % each way", 0.10, 0.10),
    Case("2 points better", 0.05, 0.03),
    Case("2 points worse", 0.03, 0.05),
    Case("10 points worse", 0.02, 0.12),
    Case("20 points worse", 0.02, 0.22),
    Case("40 points worse", 0.02, 0.42),
)


class Stops(NamedTuple):
    """Where simulated comparisons stopped, (draws,) each: after how many pairs, and with which claim."""

    pairs: NDArray[np.int64]
    not_worse: NDArray[np.bool_]
    worse: NDArray[np.bool_]


def simulate(case: Case, margin: float, most: int, draws: int, seed: int) -> Stops:
    """Return where `draws` comparisons of `case` stop that are looked at after every block, up to `most` pairs."""
    rng, parts = np.random.default_rng(seed), []
    for _ in range(0, draws, PATHS):
        u = rng.random((PATHS, most))
        differences = (u < case.only_second).astype(float) - (u > 1 - case.only_first)
        parts.append([_reached(bet(differences, margin)) for bet in (log_not_worse, log_worse)])
    up, down = (np.concatenate(column) for column in zip(*parts, strict=True))
    pairs = np.minimum(-(-np.minimum(up, down) // LOOK) * LOOK, most)
    return Stops(pairs, (up < down) & (up <= most), (down < up) & (down <= most))


def _reached(log_capital: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the pair at which each capital (draws, T) reached 1 / alpha; T + 1 where it did not."""
    reached = log_capital >= -np.log(EACH_ALPHA)
    return np.where(reached.any(axis=1), reached.argmax(axis=1) + 1, log_capital.shape[1] + 1)


def stop_row(case: Case, margin: float, most: int, draws: int, seed: int) -> list[str]:
    """Return how many pairs a case takes and how it ends, beside the planned number for the same claim."""
    stops = simulate(case, margin, most, draws, seed)
    ends = [f"{100 * share.mean():.1f} %" for share in (stops.not_worse, stops.worse, ~(stops.not_worse | stops.worse))]
    planned = _planned(case, margin)
    told = [f"{np.median(stops.pairs):.0f}", f"{stops.pairs.mean():.0f}", f"{np.quantile(stops.pairs, 0.9):.0f}"]
    return [case.name, *told, *ends, planned]


def _planned(case: Case, margin: float) -> str:
    """Return the planned number of pairs that shows "not worse" with a chance of 80 %; a dash where it is not so."""
    if case.only_second - case.only_first <= -margin:
        return "-"
    return str(least_pairs(lambda n: chance_of_not_worse(n, case.only_second, case.only_first, margin)))


def boundary_row(discordant: float, margin: float, most: int, draws: int, seed: int) -> list[str]:
    """Return how often either claim is made where the second policy is worse by exactly the margin."""
    case = Case("", (discordant - margin) / 2, (discordant + margin) / 2)
    stops = simulate(case, margin, most, draws, seed)
    peeked = _peeking(case, margin, most, draws, seed)
    fixed = chance_of_not_worse(most, case.only_second, case.only_first, margin)
    shares = [stops.not_worse.mean(), stops.worse.mean(), fixed, peeked]
    return [f"{100 * discordant:.0f} % of pairs", *(f"{100 * share:.1f} %" for share in shares)]


def _peeking(case: Case, margin: float, most: int, draws: int, seed: int) -> float:
    """Return how often the test for a planned number shows "not worse" at one look at least, as it must not be used."""
    rng = np.random.default_rng(seed)
    shares = [case.only_second, case.only_first, 1 - case.only_second - case.only_first]
    counts = rng.multinomial(LOOK, shares, size=(draws, most // LOOK)).cumsum(axis=1)
    shown = np.zeros(draws, dtype=bool)
    for look in range(counts.shape[1]):
        shown |= shows_not_worse(counts[:, look, 0], counts[:, look, 1], LOOK * (look + 1), margin)
    return float(shown.mean())


def table(headers: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table, numbers to the right."""
    marks = ["---", *["---:"] * (len(headers) - 1)]
    return "\n".join(f"| {' | '.join(row)} |" for row in (headers, marks, *rows))


def page(margin: float, most: int, draws: int, seed: int) -> str:
    """Return the page."""
    stops = [stop_row(case, margin, most, draws, seed) for case in CASES]
    boundary = [boundary_row(share, margin, most, draws, seed) for share in (0.06, 0.1, 0.2, 0.4)]
    points = f"{100 * margin:g} points"
    headers = ["Second against first", "median", "mean", "90 %", "not worse", "worse", "underpowered", "planned number"]
    claims = ["They differ in", "not worse", "worse", f"planned: {most} pairs", "the same test at every look"]
    return f"""# How many pairs until it is decided

`manicm-ms evaluate --until-decided` plays pairs until it may claim that the last policy is not worse than the first by
more than a margin, or that it is. Simulated here: a margin of {points}, {most} pairs at most, looked at after every
{LOOK}.

{table(headers, stops)}

Median, mean and 90 % quantile of the pairs played, how it ended, and the planned number of pairs at which the lower end
of Tango's 95 % interval lies above -{points} with a chance of 80 %. Stopping when decided costs equal policies about as
many pairs as a plan that knew beforehand how often they differ, which no plan does; policies that never differ cost
some more. A policy that is clearly worse is found out soon, where a plan would play on to its end.

## Wrong claims at the boundary

The second policy is worse by exactly {points}, so that both claims are wrong. Each bet may err in 2.5 % of comparisons,
whenever one looks.

{table(claims, boundary)}

The last column is the test for a planned number, made after every {LOOK} pairs until it says "not worse": that is why
it is not what stops an evaluation.

`python scripts/results/until_decided.py --write`: {draws} simulated comparisons a row, seed {seed}.
"""


def main(margin: float = 5.0, most: int = 1000, draws: int = 2000, seed: int = 0, write: bool = False) -> None:
    """Print the page.

    Args:
        margin: points.
        most: pairs at most.
        draws: simulated comparisons a row, a multiple of 200.
        seed: of the simulation.
        write: keep it in docs/results.
    """
    text = page(margin / 100, most, draws, seed)
    print(text)
    if write:
        write_text(PAGE, text)


if __name__ == "__main__":
    tyro.cli(main)
