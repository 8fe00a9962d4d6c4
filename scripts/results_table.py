"""Print one Markdown table of several reports: `python scripts/results_table.py "one-sided=runs/one/report" ...`.

Every figure is read from the reports' results.json.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import tyro

HEAD = "| {first} | policy | NFE | success | 95 % interval | one decision, CPU |\n|---|---|---|---|---|---|"


def rows(label: str, results: dict[str, Any]) -> list[str]:
    """Return a table row for each policy of a report."""
    lines = []
    for policy in results["policies"]:
        low, high = (100 * bound for bound in policy["ci95"])
        rate = f"{policy['successes']}/{policy['n']} = {100 * policy['success_rate']:.1f} %"
        decision = f"{policy['latency_ms']['median']:.1f} ms"
        lines.append(
            f"| {label} | {policy['name']} | {policy['nfe']} | {rate} | {low:.1f} to {high:.1f} % | {decision} |"
        )
    return lines


def paired(label: str, results: dict[str, Any]) -> str:
    """Return a sentence on the pair of a report."""
    pair = results["paired"]
    low, high = (100 * bound for bound in pair["difference_ci95"])
    counts = f"both {pair['both']}, only teacher {pair['only_first']}, only student {pair['only_second']}"
    return (
        f"{label}: student minus teacher {100 * pair['difference']:+.1f} points "
        f"(95 % interval {low:+.1f} to {high:+.1f}; "
        f"McNemar's exact test p = {pair['mcnemar_p']:.2g}; {counts}, neither {pair['neither']})."
    )


def main(reports: tyro.conf.Positional[tuple[str, ...]], first: str = "demos") -> None:
    """Print the table and the sentences.

    Args:
        reports: each LABEL=FOLDER.
        first: head of the first column.
    """
    read = {}
    for item in reports:
        label, folder = item.rsplit("=", 1)
        read[label] = json.loads((Path(folder) / "results.json").read_text())
    print(HEAD.format(first=first))
    print("\n".join(line for label, results in read.items() for line in rows(label, results)))
    print("\n" + "\n".join(f"- {paired(label, results)}" for label, results in read.items()))


if __name__ == "__main__":
    tyro.cli(main)
