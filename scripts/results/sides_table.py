"""Which way do the policies of a Slide Block report push? `python scripts/results/sides_table.py runs/two/report`.

Two-sided demonstrations hold two modes. A policy that averaged them would approach the block in its middle, or always
from the same side. The side is read from the recorded actions: the way along y that the commands went before the push.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import tyro

from manicm_ms.evaluation.protocol import slug
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.robots.ur3e_ag95 import TCP_STEP

APPROACH_STEPS = 24  # control steps until the expert stands behind the block
Y = 1  # index of the translation along y in an action


def approach(episode: EpisodeResult) -> float:
    """Return how far the commands moved along y in the approach, m: negative before a push towards +y."""
    actions = episode.actions.reshape(-1, episode.actions.shape[-1])[:APPROACH_STEPS]
    return float(actions[:, Y].sum() * TCP_STEP)


def ways(report: Path, policy: str) -> np.ndarray:
    """Return the way of each episode, m, in the order of seeds."""
    lines = (report / "episodes" / f"{slug(policy)}.jsonl").read_text().splitlines()
    episodes = sorted((EpisodeResult.from_record(json.loads(line)) for line in lines), key=lambda e: e.seed)
    return np.array([approach(episode) for episode in episodes])


def main(report: tyro.conf.Positional[Path]) -> None:
    """Print the table.

    Args:
        report: folder of a finished evaluation.
    """
    names = [policy["name"] for policy in json.loads((report / "results.json").read_text())["policies"]]
    teacher = ways(report, names[0])
    print("| policy | first goes to -y | first goes to +y | same side as the teacher on the same seed |")
    print("|---|---|---|---|")
    for name in names:
        way = ways(report, name)
        agree = (np.sign(way) == np.sign(teacher)).sum()
        print(f"| {name} | {(way < 0).sum()} | {(way > 0).sum()} | {agree} of {len(way)} |")


if __name__ == "__main__":
    tyro.cli(main)
