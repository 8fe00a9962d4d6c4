"""A comparison in words: its page, and what the command line prints of it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from manicm_ms.evaluation.text import count_text, interval_text, success_text
from manicm_ms.wording import counted

POLICY_HEADERS = ("Policy", "Role", "Success", "95 % interval", "Once", "At the end", "Crashed")
PAIR_HEADERS = ("Against", "Policy", "Verdict", "Difference", "95 % interval", "Pairs", "+ / -", "p", "Corrected p")


def policy_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return one formatted row per policy under `POLICY_HEADERS`."""
    return [
        (
            row["name"],
            row["role"],
            success_text(row),
            interval_text(row["ci95"]),
            count_text(row["success_once"]),
            count_text(row["success_at_end"]),
            str(row["crashed"]),
        )
        for row in found["policies"]
    ]


def pair_rows(found: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return one formatted row per pair under `PAIR_HEADERS`."""
    rows: list[tuple[str, ...]] = []
    for pair in found["pairs"]:
        low, high = (100 * limit for limit in pair["difference_ci95"])
        rows.append((
            pair["first"],
            pair["second"],
            pair["verdict"],
            f"{100 * pair['difference']:+.1f}",
            f"{low:+.1f} to {high:+.1f}",
            str(pair["start_states"]),
            f"{pair['only_second']:g} / {pair['only_first']:g}",
            f"{pair['mcnemar_p']:.3g}",
            f"{pair['corrected_p']:.3g}",
        ))  # fmt: skip
    return rows


def notes(found: Mapping[str, Any]) -> list[str]:
    """Return what a reader must know beside the verdicts: pairs that were left out, repeats, remarks."""
    lines = list(found["remarks"])
    for row in found["policies"]:
        if row["crashed"]:
            lines.append(f"{row['name']}: {counted(row['crashed'], 'episode')} crashed, counted as failed in its rate.")
    for pair in found["pairs"]:
        names = f"{pair['second']} and {pair['first']}"
        if pair["left_out"]:
            lines.append(
                f"{names}: {counted(pair['left_out'], 'pair')} left out, for the simulation crashed "
                f"({pair['second']} {pair['crashed_second']}, {pair['first']} {pair['crashed_first']})."
            )
        if pair["repeats"]:
            lines.append(f"{names}: {counted(pair['repeats'], 'repeat')} of a start state, counted with it as one.")
    return lines


def method_sentence(found: Mapping[str, Any]) -> str:
    """Return by which methods the numbers were made."""
    tests, intervals = len(found["pairs"]), found["intervals"]
    correction = "" if tests == 1 else f", corrected together by {found['correction']} ({tests} p values)"
    return (
        f"Rates with {intervals['rate']} intervals, in which a crashed episode counts as a failure; differences in "
        f"points with {intervals['difference']}, each at 95 % by itself; p of McNemar's exact test{correction}. "
        f"Margin {100 * found['margin']:g} points."
    )


def show_comparison(found: Mapping[str, Any], out: Path, console: Console) -> bool:
    """Print what compare.json of the folder `out` holds; return whether every policy has a success rate."""
    seeds = found["seeds"]
    table = Table(title=f"{found['env_id']}, {counted(len(seeds), 'start state')}, seeds {seeds[0]} to {seeds[-1]}")
    kept = [k for k, header in enumerate(POLICY_HEADERS) if header not in ("Role", "Crashed")]
    for k in kept:
        table.add_column(POLICY_HEADERS[k], justify="right" if k else "left", overflow="fold")
    for row in policy_rows(found):
        table.add_row(*(row[k] for k in kept))
    console.print(table)
    for pair in found["pairs"]:
        told = f"{pair['verdict'].upper()}: {pair['sentence']} {_p_text(pair, len(found['pairs']))}"
        console.print(told, highlight=False, markup=False)
    for line in notes(found):
        console.print(line, highlight=False, markup=False)
    console.print(f"comparison: {out / 'compare.md'}", soft_wrap=True)
    return all(row["success_rate"] is not None for row in found["policies"])


def _p_text(pair: Mapping[str, Any], tests: int) -> str:
    corrected = "" if tests == 1 else f", {pair['corrected_p']:.3g} corrected for {tests} comparisons"
    return (
        f"{pair['second']} alone succeeded on {pair['only_second']:g} of {pair['start_states']}, {pair['first']} alone "
        f"on {pair['only_first']:g}; McNemar's exact p = {pair['mcnemar_p']:.3g}{corrected}."
    )


def render_comparison(found: Mapping[str, Any]) -> str:
    """Return the comparison as Markdown."""
    seeds = found["seeds"]
    lines = [
        f"# {found['env_id']}: {counted(len(found['policies']), 'policy')} on the same "
        f"{counted(len(seeds), 'start state')}",
        "",
        *(f"- **{pair['verdict']}**: {pair['sentence']}" for pair in found["pairs"]),
        "",
        *_markdown_table(POLICY_HEADERS, policy_rows(found)),
        "",
        *_markdown_table(PAIR_HEADERS, pair_rows(found)),
        "",
        f"Seeds {seeds[0]} to {seeds[-1]}. {method_sentence(found)}",
        "Once: success at some step; at the end: at the last step. + / -: start states on which only the policy "
        "succeeded, and only the one that it is compared with.",
    ]
    if told := notes(found):
        lines += ["", *(f"- {line}" for line in told)]
    return "\n".join(lines) + "\n"


def _markdown_table(headers: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    cells = [headers, tuple("---" for _ in headers), *rows]
    return [f"| {' | '.join(cell.replace('|', '/') for cell in row)} |" for row in cells]
