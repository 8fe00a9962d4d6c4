"""Print one Markdown table of several reports.

`python scripts/results/results_table.py "one-sided=runs/one/report" "two-sided=runs/two/report"`

Every figure is read from the reports' results.json, or from a copy of one; intervals are computed anew from the counts,
so that reports of earlier versions get the present ones.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import tyro

from manicm_ms.evaluation.intervals import DIFFERENCE_METHOD
from manicm_ms.evaluation.results import renewed
from manicm_ms.evaluation.text import interval_text, success_text

HEAD = (
    "| {first} | policy | NFE | success | 95 % interval | at some step, at the last | one decision, CPU |\n"
    "|---|---|---|---|---|---|---|"
)


def rows(label: str, results: dict[str, Any]) -> list[str]:
    """Return a table row for each policy of a report."""
    lines = []
    for policy in results["policies"]:
        cells = [
            label,
            policy["name"],
            str(policy["nfe"]),
            success_text(policy),
            interval_text(policy["ci95"]),
            ", ".join(_successes(policy[kind]) for kind in ("success_once", "success_at_end")),
            f"{policy['latency_ms']['median']:.1f} ms",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _successes(entry: dict[str, Any] | None) -> str:
    return "-" if entry is None else str(entry["successes"])


def paired(label: str, results: dict[str, Any]) -> str:
    """Return a sentence on the pair of a report."""
    pair = results["paired"]
    if pair is None:
        return f"{label}: no pair to compare."
    low, high = (100 * bound for bound in pair["difference_ci95"])
    counts = f"both {pair['both']}, only teacher {pair['only_first']}, only student {pair['only_second']}"
    return (
        f"{label}: student minus teacher {100 * pair['difference']:+.1f} points "
        f"({DIFFERENCE_METHOD}, 95 %: {low:+.1f} to {high:+.1f}; "
        f"McNemar's exact test p = {pair['mcnemar_p']:.2g}; {counts}, neither {pair['neither']})."
    )


def main(reports: tyro.conf.Positional[tuple[str, ...]], first: str = "demos") -> None:
    """Print the table and the sentences.

    Args:
        reports: each LABEL=FOLDER, or LABEL=FILE of a results.json that was kept elsewhere.
        first: head of the first column.
    """
    read = {}
    for item in reports:
        label, _, place = item.rpartition("=")
        file = Path(place) / "results.json" if Path(place).is_dir() else Path(place)
        read[label] = renewed(json.loads(file.read_text()))
    print(HEAD.format(first=first))
    print("\n".join(line for label, results in read.items() for line in rows(label, results)))
    print("\n" + "\n".join(f"- {paired(label, results)}" for label, results in read.items()))


if __name__ == "__main__":
    tyro.cli(main)
