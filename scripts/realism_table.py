"""Print one Markdown table of evaluations under several realism presets: a policy a row, a preset a column.

`python scripts/realism_table.py "Stack Cube=runs/realism/stack_cube" ...`; every figure is read from results.json,
intervals (Clopper-Pearson) are computed anew from the counts.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import tyro

from manicm_ms.evaluation.results import renewed


def rows(label: str, realism: dict[str, Any]) -> list[str]:
    """Return a table row for each policy of a report: success under each preset, with its 95 % interval."""
    cells: dict[str, dict[str, str]] = {}
    for row in realism["rows"]:
        interval = "-" if row["ci95"] is None else "{:.0f} to {:.0f} %".format(*(100 * bound for bound in row["ci95"]))
        text = f"{row['successes']}/{row['n']} ({interval})"
        cells.setdefault(row["policy"], {})[row["preset"]] = text
    return [
        f"| {label} | {policy} | " + " | ".join(by_preset[preset] for preset in realism["presets"]) + " |"
        for policy, by_preset in cells.items()
    ]


def main(reports: tyro.conf.Positional[tuple[str, ...]]) -> None:
    """Print the table.

    Args:
        reports: each LABEL=FOLDER, the folder of an evaluation with several presets, or LABEL=FILE of its results.json.
    """
    read = {}
    for item in reports:
        label, _, place = item.rpartition("=")
        file = Path(place) / "results.json" if Path(place).is_dir() else Path(place)
        read[label] = renewed(json.loads(file.read_text()))["realism"]
    presets = {tuple(realism["presets"]) for realism in read.values()}
    if len(presets) != 1:
        raise SystemExit(f"the reports hold different presets: {sorted(presets)}")
    (names,) = presets
    print("| task | policy | " + " | ".join(names) + " |\n|---|---|" + "---|" * len(names))
    print("\n".join(line for label, realism in read.items() for line in rows(label, realism)))


if __name__ == "__main__":
    tyro.cli(main)
