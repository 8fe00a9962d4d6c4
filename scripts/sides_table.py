"""Which way do the policies of a Slide Block report push? `python scripts/sides_table.py runs/two/report`.

Two-sided demonstrations hold two modes. A policy that averaged them would approach the block in its middle, or always
from the same side. The side is read from the recorded actions: the way along y that the commands went before the push.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import tyro

from manicm_ms.evaluation.judge import slug
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.robots.ur3e_ag95 import TCP_STEP

APPROACH_STEPS = 24  # control steps until the expert stands behind the block
Y = 1  # index of the translation along y in an action


def approach(episode: EpisodeResult) -> float:
    """Return how far the commands moved along y in the approach, m: negative before a push towards +y."""
    actions = episode.actions.reshape(-1, episode.actions.shape[-1])[:APPROACH_STEPS]
    return float(actions[:, Y].sum() * TCP_STEP)


def main(report: tyro.conf.Positional[Path]) -> None:
    """Print the table.

    Args:
        report: folder of a finished evaluation.
    """
    print("| policy | episodes that go to -y first | to +y first | median distance, mm | median steps of a success |")
    print("|---|---|---|---|---|")
    for policy in json.loads((report / "results.json").read_text())["policies"]:
        lines = (report / "episodes" / f"{slug(policy['name'])}.jsonl").read_text().splitlines()
        episodes = [EpisodeResult.from_record(json.loads(line)) for line in lines]
        ways = np.array([approach(e) for e in episodes])
        steps = np.median([e.steps for e in episodes if e.success])
        distance = 1000 * np.median(np.abs(ways))
        print(f"| {policy['name']} | {(ways < 0).sum()} | {(ways > 0).sum()} | {distance:.0f} | {steps:.0f} |")


if __name__ == "__main__":
    tyro.cli(main)
