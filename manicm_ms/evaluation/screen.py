"""What the command line prints of an evaluation: tables narrow enough for 80 columns, and sentences."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from manicm_ms.evaluation.results import without_rate
from manicm_ms.evaluation.text import (
    HEADERS,
    Row,
    crash_lines,
    decision_sentences,
    once_at_end_sentence,
    paired_sentences,
    realism_headers,
    realism_rows,
    rows,
)

_PRINTED = ("name", "nfe", "success", "interval", "median", "p95")


def show(results: Mapping[str, Any], out: Path, console: Console) -> bool:
    """Print what results.json of the folder `out` holds; return whether every policy has a success rate."""
    for table in summary_tables(results):
        console.print(table)
    for sentence in screen_lines(results):
        console.print(sentence, highlight=False, markup=False)
    console.print(f"report: {out / 'report.html'}", soft_wrap=True)
    return not without_rate(results)


def screen_lines(results: Mapping[str, Any]) -> list[str]:
    """Return what the command line prints below its tables."""
    lines = [*results["remarks"], once_at_end_sentence(results)]
    return [*lines, *paired_sentences(results), *decision_sentences(results), *crash_lines(results)]


def summary_table(results: Mapping[str, Any]) -> Table:
    """Return the table that the command line prints, narrow enough for 80 columns."""
    seeds = results["seeds"]
    table = Table(title=f"{results['env_id']}, seeds {seeds[0]} to {seeds[-1]}")
    for header, key in zip(HEADERS, Row._fields, strict=True):
        if key in _PRINTED:
            table.add_column(header, justify="left" if key == "name" else "right", overflow="fold")
    for row in rows(results):
        table.add_row(*(getattr(row, key) for key in _PRINTED))
    return table


def summary_tables(results: Mapping[str, Any]) -> list[Table]:
    """Return the tables that the command line prints: that of the policies, and that of the realism presets if any."""
    tables = [summary_table(results)]
    if rows_ := realism_rows(results):
        table = Table(title="the same seeds under each realism preset")
        for header in realism_headers(results):
            table.add_column(header, justify="left" if header in ("Realism", "Policy") else "right", overflow="fold")
        for row in rows_:
            table.add_row(*row)
        tables.append(table)
    return tables
