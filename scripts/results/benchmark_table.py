"""Print the tables of a finished benchmark as Markdown.

`python scripts/results/benchmark_table.py runs/bench/results.json`

All that follows from the outcomes is computed anew, so that results of earlier versions get the present intervals.
"""

from __future__ import annotations

import json
from pathlib import Path

import tyro

from manicm_ms.benchmark.report import TextTable, all_tables, interval_lines, paired_lines
from manicm_ms.benchmark.summary import summarised


def markdown(table: TextTable) -> str:
    """Return a table as Markdown, its title in bold above it."""
    lines = [table.headers, ("---",) * len(table.headers), *table.rows]
    return f"**{table.title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main(results: tyro.conf.Positional[Path]) -> None:
    """Print every table and sentence.

    Args:
        results: results.json of a benchmark, of any version.
    """
    summary = summarised(json.loads(results.read_text()))
    print("\n\n".join(markdown(table) for table in all_tables(summary)))
    print("\n" + "\n".join(f"- {sentence}" for sentence in paired_lines(summary)))
    print("\n" + "\n".join(interval_lines(summary)))


if __name__ == "__main__":
    tyro.cli(main)
