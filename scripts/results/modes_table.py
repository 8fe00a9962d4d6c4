"""Which policies keep both ways of a task that has two? Reads reports of Slide Block and the demonstrations.

`python scripts/results/modes_table.py runs/modes/*-report --demos runs/modes/plus.zarr runs/modes/minus.zarr`

The demonstrations hold both sides from the very same start states, so that what is seen does not tell the side. For
each policy: success, how many of its successes go to either side, and the energy distance between its approaches and
the demonstrated ones (metres along y that the commands go before the push).
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import tyro
from scipy.stats import energy_distance
from sides_table import APPROACH_STEPS, approach

from manicm_ms.demos.store import DemoStore
from manicm_ms.evaluation.intervals import rate_interval
from manicm_ms.evaluation.protocol import slug
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.robots.ur3e_ag95 import TCP_STEP

Y = 1  # index of the translation along y in an action
HEAD = (
    "| policy | NFE | success | 95 % interval | successes to -y first, +y first | rarer side | energy distance | "
    "one decision |\n|---|---|---|---|---|---|---|---|"
)


def demonstrated(stores: tuple[Path, ...]) -> np.ndarray:
    """Return how far each demonstration's commands move along y before the push, m."""
    found = []
    for path in stores:
        with DemoStore.open(path) as store:
            begin = 0
            for end in store.episode_ends:
                actions = np.asarray(store.action[begin:end])[:APPROACH_STEPS]
                found.append(float(actions[:, Y].sum() * TCP_STEP))
                begin = int(end)
    return np.array(found)


def episodes_of(report: Path, policy: str) -> list[EpisodeResult]:
    """Return the episodes of a policy of a report, by seed."""
    lines = (report / "episodes" / f"{slug(policy)}.jsonl").read_text().splitlines()
    return sorted((EpisodeResult.from_record(json.loads(line)) for line in lines), key=lambda e: e.seed)


def row(name: str, played: list[EpisodeResult], demos: np.ndarray, nfe: int, decision_ms: float) -> str:
    """Return the table's line of a policy."""
    ways = np.array([approach(episode) for episode in played])
    won = np.array([episode.success for episode in played])
    low, high = rate_interval(int(won.sum()), len(won))
    minus, plus = int((ways[won] < 0).sum()), int((ways[won] > 0).sum())
    rarer = f"{100 * min(minus, plus) / (minus + plus):.0f} %" if minus + plus else "-"
    cells = [
        name,
        str(nfe),
        f"{won.sum()}/{len(won)}",
        f"{100 * low:.1f} to {100 * high:.1f} %",
        f"{minus}, {plus}",
        rarer,
        f"{energy_distance(ways, demos):.3f}",
        f"{decision_ms:.1f} ms",
    ]
    return f"| {' | '.join(cells)} |"


def main(reports: tyro.conf.Positional[tuple[Path, ...]], demos: tuple[Path, ...]) -> None:
    """Print the table.

    Args:
        reports: folders of finished evaluations of Slide Block.
        demos: stores that the policies were trained on.
    """
    shown = demonstrated(demos)
    print(f"{len(shown)} demonstrations: {(shown < 0).sum()} go to -y first, {(shown > 0).sum()} to +y\n")
    print(HEAD)
    for report in reports:
        for policy in json.loads((report / "results.json").read_text())["policies"]:
            played = episodes_of(report, policy["name"])
            print(row(policy["name"], played, shown, policy["nfe"], policy["latency_ms"]["median"]))


if __name__ == "__main__":
    tyro.cli(main)
