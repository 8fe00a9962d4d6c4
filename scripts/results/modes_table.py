"""Which policies keep both ways of a task that has two? Reads reports of Slide Block and the demonstrations.

`python scripts/results/modes_table.py runs/modes/*-report --demos runs/modes/plus.zarr runs/modes/minus.zarr`

The demonstrations hold both sides from the very same start states, so that what is seen does not tell the side. For
each policy: success, how many of its successes go to either side, and the energy distance between its approaches and
the demonstrated ones (metres along y that the commands go before the push). The side is that of the push: the sign of
what the commands go along y after the approach; the approach alone does not tell it where the block lies far off.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro
from scipy.stats import energy_distance
from sides_table import APPROACH_STEPS

from manicm_ms.demos.store import DemoStore
from manicm_ms.evaluation.intervals import rate_interval
from manicm_ms.evaluation.protocol import slug
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.robots.ur3e_ag95 import TCP_STEP

Y = 1  # index of the translation along y in an action
HEAD = (
    "| policy | NFE | success | 95 % interval | successes pushed to -y, +y | rarer side | energy distance | "
    "one decision |\n|---|---|---|---|---|---|---|---|"
)


class Ways(NamedTuple):
    """How far the commands of some episodes go along y, m, each (E,): before the push, and from then on."""

    approach: np.ndarray
    push: np.ndarray


def ways_of(episodes: Iterable[np.ndarray]) -> Ways:
    """Return the ways of episodes' actions, (L, Da) each."""
    moved = [actions[:, Y] * TCP_STEP for actions in episodes]
    approach, push = (
        [m[part].sum() for m in moved] for part in (slice(None, APPROACH_STEPS), slice(APPROACH_STEPS, None))
    )
    return Ways(np.array(approach), np.array(push))


def demonstrated(stores: tuple[Path, ...]) -> Ways:
    """Return the ways of the demonstrations."""
    found = []
    for path in stores:
        with DemoStore.open(path) as store:
            found += np.split(np.asarray(store.action[: store.num_frames]), store.episode_ends[:-1])
    return ways_of(found)


def episodes_of(report: Path, policy: str) -> list[EpisodeResult]:
    """Return the episodes of a policy of a report, by seed."""
    lines = (report / "episodes" / f"{slug(policy)}.jsonl").read_text().splitlines()
    return sorted((EpisodeResult.from_record(json.loads(line)) for line in lines), key=lambda e: e.seed)


def row(name: str, played: list[EpisodeResult], demos: Ways, nfe: int, decision_ms: float) -> str:
    """Return the table's line of a policy."""
    ways = ways_of(episode.actions.reshape(-1, episode.actions.shape[-1]) for episode in played)
    won = np.array([episode.success for episode in played])
    low, high = rate_interval(int(won.sum()), len(won))
    minus, plus = int((ways.push[won] < 0).sum()), int((ways.push[won] > 0).sum())
    rarer = f"{100 * min(minus, plus) / (minus + plus):.0f} %" if minus + plus else "-"
    cells = [
        name,
        str(nfe),
        f"{won.sum()}/{len(won)}",
        f"{100 * low:.1f} to {100 * high:.1f} %",
        f"{minus}, {plus}",
        rarer,
        f"{energy_distance(ways.approach, demos.approach):.3f}",
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
    print(f"{len(shown.push)} demonstrations: {(shown.push < 0).sum()} push to -y, {(shown.push > 0).sum()} to +y\n")
    print(HEAD)
    for report in reports:
        for policy in json.loads((report / "results.json").read_text())["policies"]:
            played = episodes_of(report, policy["name"])
            print(row(policy["name"], played, shown, policy["nfe"], policy["latency_ms"]["median"]))


if __name__ == "__main__":
    tyro.cli(main)
