"""Writes a benchmark's table as Markdown and as one self-contained page, and shows it on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table

from manicm_ms.benchmark.summary import PAPER_GROUPS
from manicm_ms.evaluation.report import template
from manicm_ms.evaluation.resampling import MANY_TRAININGS, RECIPE
from manicm_ms.evaluation.text import format_ms
from manicm_ms.paths import write_json, write_text

_PAPER_COLUMNS = (*PAPER_GROUPS, "average", "ms")
PAPER: Mapping[str, Mapping[str, float]] = {
    method: dict(zip(_PAPER_COLUMNS, figures, strict=True))
    for method, figures in {
        "dp3": (76.1, 91.7, 46.3, 44.8, 62.3, 77.5, 177.6),
        "simple_dp3": (73.0, 90.4, 47.3, 45.6, 56.5, 75.8, 120.6),
        "manicm": (74.9, 92.9, 47.7, 44.2, 65.7, 78.5, 17.3),
        "manicm_4": (78.2, 93.0, 48.0, 46.7, 64.5, 79.0, 66.2),
    }.items()
}
"""Success rates in percent and decision times in milliseconds of ManiCM (arXiv:2406.01586), main table: 3000 epochs,
31 tasks, the mean of the five highest evaluations, an RTX 4090."""


class TextTable(NamedTuple):
    """A table of text."""

    title: str
    headers: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def main_table(results: Mapping[str, Any]) -> TextTable:
    """Return success by group and average on held-out seeds, with the 95 % interval, NFE and time of a decision."""

    def shown(entry: Mapping[str, Any]) -> str:
        return f"{_percent(entry['success_rate'])} ({_interval(entry['ci95'])})"

    return _by_group(results, "Success on held-out seeds, % (95 % interval)", shown)


def training_table(results: Mapping[str, Any]) -> TextTable | None:
    """Return the average over tasks of each training, their mean and range, or None where there is one training."""
    rows = [(row, row["average"]) for row in results["rows"] if row["average"] is not None]
    seeds = list(dict.fromkeys(seed for _, entry in rows for seed in entry["by_seed"]))
    if len(seeds) < 2:
        return None
    lines = []
    for row, entry in rows:
        each = [_percent(entry["by_seed"][s]) if s in entry["by_seed"] else "-" for s in seeds]
        low, high = entry["range"]
        interval = f"{_interval(entry['ci95'], 1)} ({entry['speaks_of']})"
        spread = f"{_percent(low)} to {_percent(high)}"
        lines.append((row["method"], *each, _percent(entry["success_rate"]), spread, interval))
    headers = ("method", *(f"training {seed}" for seed in seeds), "mean", "range", "95 % interval of the mean")
    return TextTable("Average over all tasks by training, %", headers, lines)


def highest_table(results: Mapping[str, Any]) -> TextTable | None:
    """Return the paper's mean of the five highest evaluations by group, or None where none were made."""

    def shown(entry: Mapping[str, Any]) -> str:
        return "-" if entry["mean_of_5_highest"] is None else _percent(entry["mean_of_5_highest"])

    if not any(cell["mean_of_5_highest"] is not None for cell in results["cells"]):
        return None
    return _by_group(results, "The paper's mean of the five highest evaluations during training, %", shown)


def _by_group(results: Mapping[str, Any], title: str, shown: Callable[[Mapping[str, Any]], str]) -> TextTable:
    groups: dict[str, int] = {}
    for row in results["rows"]:
        for name, entry in row["groups"].items():
            groups[name] = max(groups.get(name, 0), entry["tasks"])
    headers = ("method", "NFE", *(f"{name} ({tasks})" for name, tasks in groups.items()), "average", "one decision")
    lines = []
    for row in results["rows"]:
        of = [*groups.values(), len(results["env_ids"])]
        entries = [*(row["groups"].get(name) for name in groups), row["average"]]
        cells = [_marked(entry, shown, tasks) for entry, tasks in zip(entries, of, strict=True)]
        time = "-" if row["decision_ms"] is None else format_ms(row["decision_ms"])
        lines.append((row["method"], "-" if row["nfe"] is None else str(row["nfe"]), *cells, time))
    return TextTable(title, headers, lines)


def _marked(entry: Mapping[str, Any] | None, shown: Callable[[Mapping[str, Any]], str], tasks: int) -> str:
    """Return a cell, which says so where it covers fewer tasks than its column: it is then no match for the others."""
    if entry is None:
        return "-"
    return shown(entry) + (f" [{entry['tasks']} of {tasks} tasks]" if entry["tasks"] < tasks else "")


def paper_table(results: Mapping[str, Any]) -> TextTable | None:
    """Return the paper's own figures of the methods that it has, for the groups that the benchmark has."""
    groups = {cell["group"] for cell in results["cells"]}
    known = [name for name in PAPER_GROUPS if name in groups]
    methods = [row["method"] for row in results["rows"] if row["method"] in PAPER]
    if not known or not methods:
        return None
    lines = [
        (m, *(f"{PAPER[m][name]:.1f}" for name in (*known, "average")), f"{PAPER[m]['ms']:.1f} ms") for m in methods
    ]
    return TextTable(
        "The paper's figures, % (all tasks of a group)", ("method", *known, "average", "one decision"), lines
    )


def task_table(results: Mapping[str, Any]) -> TextTable:
    """Return every task: successes of each method and its interval."""
    methods = [row["method"] for row in results["rows"]]
    cells = {(c["env_id"], c["method"]): c for c in results["cells"]}
    lines = []
    for env_id in results["env_ids"]:
        mine = [cells[env_id, method] for method in methods]
        lines.append((env_id, mine[0]["group"], *(_counted(c) for c in mine)))
    return TextTable("By task, held-out seeds", ("task", "group", *methods), lines)


def _counted(cell: Mapping[str, Any]) -> str:
    if not cell["n"]:
        return "-"
    crashed = f", {cell['crashed']} crashed" if cell["crashed"] else ""
    seeds = ", ".join(f"{100 * rate:.0f}" for rate in cell["by_seed"].values())
    by_seed = f"; trainings {seeds} %" if len(cell["by_seed"]) > 1 else ""
    return f"{cell['successes']}/{cell['n']} ({_interval(cell['ci95'])}{by_seed}{crashed})"


def end_table(results: Mapping[str, Any]) -> TextTable | None:
    """Return success at some step and at the last one, or None where neither is known of any task."""
    cells = {(c["env_id"], c["method"]): c for c in results["cells"]}
    kinds = ("success_once", "success_at_end")
    if not any(cell.get(kind) for cell in cells.values() for kind in kinds):
        return None
    methods = [row["method"] for row in results["rows"]]

    def told(cell: Mapping[str, Any]) -> str:
        return ", ".join("-" if not cell.get(k) else f"{_won(cell[k])}/{cell['n']}" for k in kinds)

    lines = [(e, *(told(cells[e, m]) if cells[e, m]["n"] else "-" for m in methods)) for e in results["env_ids"]]
    return TextTable("Success at some step, at the last step of the episode", ("task", *methods), lines)


def _won(outcomes: Mapping[str, Sequence[bool]]) -> int:
    return sum(sum(episodes) for episodes in outcomes.values())


def paired_table(pair: Mapping[str, Any]) -> TextTable:
    """Return one comparison task by task, McNemar's exact test for each training on its own."""
    lines = []
    for entry in pair["by_task"]:
        low, high = (100 * bound for bound in entry["ci95"])
        difference = f"{100 * entry['difference']:+.1f} ({low:+.1f} to {high:+.1f})"
        counts = (str(entry[name]) for name in ("both", "only_first", "only_second", "neither"))
        p_values = ", ".join(f"{p:.2g}" for p in entry["mcnemar_p"].values())
        lines.append((entry["env_id"], difference, *counts, p_values))
    first, second = pair["first"], pair["second"]
    headers = ("task", "points (95 % interval)", "both", f"only {first}", f"only {second}", "neither", "McNemar's p")
    return TextTable(f"{second} minus {first} by task", headers, lines)


def paired_lines(results: Mapping[str, Any]) -> list[str]:
    """Return what the paired comparisons say, in words; no p value pools tasks or trainings."""
    lines = []
    for pair in results["paired"]:
        tests = (
            f"McNemar's exact test, each task and training on its own: the smallest p of {pair['tests']} is "
            f"{pair['smallest_p']:.2g}, {pair['smallest_p_holm']:.2g} after Holm's correction."
        )
        if pair["difference"] is None:
            lines.append(f"{pair['second']} minus {pair['first']}: no training is done on all tasks yet. {tests}")
            continue
        low, high = (100 * bound for bound in pair["ci95"])
        tasks = f"{pair['tasks']} task{'' if pair['tasks'] == 1 else 's'}"
        each = ", ".join(f"{100 * d:+.1f}" for d in pair["by_seed"].values())
        by_training = f"by training {each}; " if len(pair["by_seed"]) > 1 else ""
        lines.append(
            f"{pair['second']} minus {pair['first']}, mean of {tasks} on the same {pair['start_states']} "
            f"start states: {100 * pair['difference']:+.1f} points ({by_training}95 % interval {low:+.1f} to "
            f"{high:+.1f}, of {pair['speaks_of']}). {tests}"
        )
    return lines


def interval_lines(results: Mapping[str, Any]) -> list[str]:
    """Return how the intervals were made and what they speak of."""
    methods = results["intervals"]
    recipe = any(row["average"] and row["average"]["speaks_of"] == RECIPE for row in results["rows"])
    scope = (
        f"From {MANY_TRAININGS} trainings on these are drawn again too, and the interval speaks of the recipe"
        if recipe
        else "They speak of these networks, not of what another training would give"
    )
    return [
        f"95 % intervals of rates: {methods['rate']}. Of differences: {methods['difference']}. {scope}; nor do they "
        "hold the choice of tasks."
    ]


def write_benchmark(results: Mapping[str, Any], out: Path) -> None:
    """Write results.json, report.md and report.html into `out`."""
    context = {"results": results, "tables": all_tables(results), "sentences": paired_lines(results)}
    context["notes"] = interval_lines(results)
    write_json(out / "results.json", results)
    package = "manicm_ms.benchmark"
    write_text(out / "report.md", template("benchmark.md.j2", autoescape=False, package=package).render(context))
    write_text(out / "report.html", template("benchmark.html.j2", autoescape=True, package=package).render(context))


def all_tables(results: Mapping[str, Any]) -> list[TextTable]:
    """Return every table of a report."""
    main = [main_table(results), training_table(results), highest_table(results), paper_table(results)]
    by_task = [task_table(results), end_table(results), *(paired_table(pair) for pair in results["paired"])]
    return [table for table in (*main, *by_task) if table is not None]


def rich_tables(results: Mapping[str, Any]) -> list[Table]:
    """Return the main tables for a terminal."""
    found = []
    for text in (main_table(results), training_table(results), highest_table(results), task_table(results)):
        if text is None:
            continue
        table = Table(*text.headers, title=text.title)
        for row in text.rows:
            table.add_row(*row)
        found.append(table)
    return found


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f}"


def _interval(ci95: Sequence[float], digits: int = 0) -> str:
    return f"{100 * ci95[0]:.{digits}f} to {100 * ci95[1]:.{digits}f}"
