"""Turn results.json into tables, plots, a Markdown file and one self-contained HTML page."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
from matplotlib.figure import Figure
from rich.table import Table

from manicm_ms.evaluation.results import INTERVALS, without_rate
from manicm_ms.paths import write_text

PAPER_LATENCY_MS = {"DP3, paper": 177.6, "ManiCM, paper": 17.3}
"""Mean decision times on an RTX 4090, milliseconds: ManiCM (arXiv:2406.01586), table of results, last column."""

ROLE_COLORS = {
    "teacher": "#3b76c4",
    "control": "#8c93a0",
    "student": "#e07b39",
    "policy": "#5b9a68",
    "paper": "#b9bec7",
}

NOTHING = "-"

# Plots are drawn in this colour and then told to use the page's own, so that they follow light and dark.
_INK = "#010203"


class Row(NamedTuple):
    """One policy of the results, formatted for people."""

    name: str
    role: str
    nfe: str
    success: str
    interval: str
    once: str
    at_end: str
    crashed: str
    median: str
    p95: str
    where: str


def rows(results: Mapping[str, Any]) -> list[Row]:
    """Return one formatted row per policy, in the order of the results."""
    return [_row(policy) for policy in results["policies"]]


def _row(policy: Mapping[str, Any]) -> Row:
    threads = "1 thread" if policy["threads"] == 1 else f"{policy['threads']} threads"
    return Row(
        name=policy["name"],
        role=policy["role"],
        nfe=str(policy["nfe"]),
        success=success_text(policy),
        interval=interval_text(policy["ci95"]),
        once=_count_text(policy.get("success_once")),
        at_end=_count_text(policy.get("success_at_end")),
        crashed=str(policy["crashed"]),
        median=format_ms(policy["latency_ms"]["median"]),
        p95=format_ms(policy["latency_ms"]["p95"]),
        where=f"{policy['device']}, {threads}, {policy['dtype']}",
    )


def success_text(entry: Mapping[str, Any]) -> str:
    """Return successes, episodes and rate; a dash for the rate where nothing was measured."""
    rate = NOTHING if entry["success_rate"] is None else f"{100 * entry['success_rate']:.1f} %"
    return f"{entry['successes']}/{entry['n']} = {rate}"


def interval_text(ci95: Sequence[float] | None) -> str:
    """Return an interval of a rate in percent; a dash where nothing was measured."""
    return NOTHING if ci95 is None else f"{100 * ci95[0]:.1f} to {100 * ci95[1]:.1f} %"


def _count_text(entry: Mapping[str, Any] | None) -> str:
    return NOTHING if entry is None else f"{entry['successes']}/{entry['n']}"


def format_ms(milliseconds: float) -> str:
    """Return a time with three significant digits, one decimal at least above 1 ms."""
    return f"{milliseconds:.3g} ms" if milliseconds < 10 else f"{milliseconds:.1f} ms"


_HEADERS = (
    "Policy", "Role", "NFE", "Success", "95 % interval", "Once", "At the end", "Crashed", "Decision", "p95",
    "Measured on",
)  # fmt: skip


def paired_sentences(results: Mapping[str, Any]) -> list[str]:
    """Return what the paired comparison says, in words; nothing where there is no pair."""
    pair = results["paired"]
    if pair is None:
        return []
    low, high = pair["difference_ci95"]
    method = results.get("intervals", INTERVALS)["difference"]
    n = pair["both"] + pair["only_first"] + pair["only_second"] + pair["neither"]
    sentences = [
        f"On the same {n} seeds both succeeded on {pair['both']}, only {pair['first']} on {pair['only_first']}, "
        f"only {pair['second']} on {pair['only_second']}, neither on {pair['neither']}.",
        f"Success rate of {pair['second']} minus that of {pair['first']}: {100 * pair['difference']:+.1f} points "
        f"({method}, 95 %: {100 * low:+.1f} to {100 * high:+.1f}; McNemar's exact test p = {pair['mcnemar_p']:.3g}).",
    ]
    first, second = results["policies"][0]["latency_ms"]["median"], results["policies"][-1]["latency_ms"]["median"]
    sentences.append(
        f"The policy {pair['second']} decides {first / second:.1f} times as fast as {pair['first']}: "
        f"{results['policies'][-1]['nfe']} against {results['policies'][0]['nfe']} network evaluations a decision."
    )
    return sentences


def once_at_end_sentence(results: Mapping[str, Any]) -> str:
    """Return how often each policy succeeded at some step, and at the last one."""
    told = [f"{row.name} {row.once}, {row.at_end}" for row in rows(results)]
    return f"Success at some step, at the last step: {'; '.join(told)}."


def crash_lines(results: Mapping[str, Any]) -> list[str]:
    """Return a line for each policy without a rate, then one per crashed episode, of all realism presets."""
    silent = [f"{name}: every episode crashed, so there is no success rate." for name in without_rate(results)]
    entries = [(policy["name"], policy["episodes"]) for policy in results["policies"]]
    for row in results.get("realism", {"rows": []})["rows"]:
        if row["preset"] != results["realism"]["presets"][0]:  # those of the first stand among the policies
            entries.append((f"{row['policy']} under {row['preset']}", row["episodes"]))
    return silent + [
        f"{name}, seed {episode['seed']}: {episode['crashed']}"
        for name, episodes in entries
        for episode in episodes
        if episode["crashed"] is not None
    ]


def screen_lines(results: Mapping[str, Any]) -> list[str]:
    """Return what the command line prints below its tables."""
    lines = [*results["remarks"], once_at_end_sentence(results)]
    return [*lines, *paired_sentences(results), *crash_lines(results)]


class RealismRow(NamedTuple):
    """One policy under one realism preset, formatted for people."""

    preset: str
    policy: str
    success: str
    interval: str
    once_at_end: str
    difference: str
    p: str


def realism_headers(results: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the headers of `realism_rows`."""
    against = f"Against {results['realism']['reference']}"
    return ("Realism", "Policy", "Success", "95 % interval", "Once, at the end", against, "p")


def realism_rows(results: Mapping[str, Any]) -> list[RealismRow]:
    """Return one formatted row per preset and policy where several presets were played, else nothing."""
    realism = results.get("realism")
    return [_realism_row(row) for row in realism["rows"]] if realism and len(realism["presets"]) > 1 else []


def _realism_row(row: Mapping[str, Any]) -> RealismRow:
    pair = row["against_reference"]
    difference, p = "", ""
    if pair is not None:
        least, most = (100 * bound for bound in pair["difference_ci95"])
        difference = f"{100 * pair['difference']:+.1f} points ({least:+.1f} to {most:+.1f})"
        p = f"{pair['mcnemar_p']:.3g}"
    both = f"{_count_text(row.get('success_once'))}, {_count_text(row.get('success_at_end'))}"
    interval = interval_text(row["ci95"])
    return RealismRow(row["preset"], row["policy"], success_text(row), interval, both, difference, p)


def realism_sentence(results: Mapping[str, Any]) -> str:
    """Return under which preset the main results were obtained; nothing in the ideal world."""
    realism = results.get("realism")
    return f"Realism preset of these episodes: {realism['presets'][0]}." if realism else ""


def episodes_title(results: Mapping[str, Any]) -> str:
    """Return what was played: fresh seeds, or seeds of which some were seen in training."""
    count = len(results["seeds"])
    kind = "seeds, some of them seen in training" if results.get("seen_seeds") else "fresh seeds"
    return f"{count} {kind}"


_PRINTED = ("name", "nfe", "success", "interval", "median", "p95")


def summary_table(results: Mapping[str, Any]) -> Table:
    """Return the table that the command line prints, narrow enough for 80 columns."""
    seeds = results["seeds"]
    table = Table(title=f"{results['env_id']}, seeds {seeds[0]} to {seeds[-1]}")
    for header, key in zip(_HEADERS, Row._fields, strict=True):
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


def render_markdown(results: Mapping[str, Any]) -> str:
    """Return the report as Markdown."""
    return template("report.md.j2", autoescape=False).render(**_context(results))


def render_html(results: Mapping[str, Any], videos: Sequence[Mapping[str, Any]] = ()) -> str:
    """Return the report as one HTML page that loads nothing from elsewhere.

    Args:
        results: what results.json holds.
        videos: entries with seed, policy, success and `data` (the mp4 file's bytes).
    """
    scenes: dict[int, list[dict[str, Any]]] = {}
    for video in videos:
        source = "data:video/mp4;base64," + base64.b64encode(video["data"]).decode("ascii")
        scenes.setdefault(video["seed"], []).append({**video, "data": source})
    figures = {"success": success_plot(results), "latency": latency_plot(results)}
    return template("report.html.j2", autoescape=True).render(**_context(results), figures=figures, scenes=scenes)


def write_report(results: Mapping[str, Any], out: Path) -> None:
    """Write report.md and report.html, each whole or not at all; `results["videos"]` lie under `out`."""
    videos = [{**video, "data": (out / video["file"]).read_bytes()} for video in results.get("videos", ())]
    write_text(out / "report.md", render_markdown(results))
    write_text(out / "report.html", render_html(results, videos))


def success_plot(results: Mapping[str, Any]) -> str:
    """Return an SVG of the success rates with their 95 % intervals."""
    policies = results["policies"]
    figure, axes = _axes(len(policies))
    for y, policy in enumerate(policies):
        if policy["success_rate"] is None:
            axes.text(1, y, "every episode crashed", va="center", color=_INK)
            continue
        rate, (low, high) = policy["success_rate"], policy["ci95"]
        axes.barh(y, 100 * rate, color=ROLE_COLORS[policy["role"]], height=0.62)
        error = [[100 * max(rate - low, 0)], [100 * max(high - rate, 0)]]
        axes.errorbar(100 * rate, y, xerr=error, color=_INK, capsize=4, lw=1.4)
        axes.text(103, y, f"{100 * rate:.1f} %", va="center", color=_INK)
    axes.set_xlim(0, 100)
    axes.set_xlabel(f"success rate, % (bar) with 95 % {INTERVALS['rate']} interval")
    _label(axes, [p["name"] for p in policies])
    return _svg(figure, "Success rate of each policy with its 95 % interval")


def latency_plot(results: Mapping[str, Any]) -> str:
    """Return an SVG of the decision times on a log scale, the paper's beside ours."""
    ours = [(p["name"], p["latency_ms"]["median"], p["latency_ms"]["p95"], p["role"]) for p in results["policies"]]
    theirs = [(name, value, None, "paper") for name, value in PAPER_LATENCY_MS.items()]
    entries = ours + theirs
    figure, axes = _axes(len(entries))
    values = [value for _, value, _, _ in entries]
    left = 10 ** _floor_log10(min(values) / 1.5)
    for y, (_, median, p95, role) in enumerate(entries):
        axes.barh(y, median - left, left=left, color=ROLE_COLORS[role], height=0.62)
        if p95 is not None:
            axes.plot([p95], [y], marker="|", ms=13, mew=1.6, color=_INK)
        axes.text(max(median, p95 or 0) * 1.12, y, format_ms(median), va="center", color=_INK)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlim(left, 6 * max(values))
    axes.set_xlabel("one decision, ms, log scale (bar: median, tick: p95; paper: mean on an RTX 4090)")
    _label(axes, [name for name, *_ in entries])
    return _svg(figure, "Wall time of one decision of each policy beside the paper's")


def _floor_log10(value: float) -> int:
    exponent = 0
    while 10.0**exponent > value:
        exponent -= 1
    while 10.0 ** (exponent + 1) <= value:
        exponent += 1
    return exponent


def _axes(bars: int) -> tuple[Figure, Any]:
    figure = Figure(figsize=(7.4, 0.9 + 0.42 * bars), layout="constrained")
    axes = figure.subplots()
    axes.invert_yaxis()
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.spines["bottom"].set_color(_INK)
    axes.tick_params(colors=_INK, which="both")
    axes.xaxis.label.set_color(_INK)
    axes.grid(axis="x", color=_INK, alpha=0.12, lw=0.8)
    axes.set_axisbelow(True)
    axes.patch.set_alpha(0)
    return figure, axes


def _label(axes: Any, names: Sequence[str]) -> None:
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0)


def _svg(figure: Figure, description: str) -> str:
    """Return the figure as inline SVG whose text and lines take the page's colour."""
    from matplotlib import rc_context

    buffer = io.StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "manicm_ms", "font.size": 10}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :].replace(_INK, "currentColor")
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    return svg.replace("<svg", f'<svg role="img" aria-label="{description}"', 1)


def _context(results: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "results": results,
        "headers": _HEADERS,
        "rows": rows(results),
        "title": episodes_title(results),
        "remarks": results.get("remarks", []),
        "intervals": results.get("intervals", INTERVALS),
        "sentences": [*filter(None, [realism_sentence(results)]), *paired_sentences(results)],
        "realism_headers": realism_headers(results) if "realism" in results else (),
        "realism_rows": realism_rows(results),
        "crashes": crash_lines(results),
        "format_ms": format_ms,
        "paper": PAPER_LATENCY_MS,
    }


def template(name: str, *, autoescape: bool, package: str = "manicm_ms.evaluation") -> jinja2.Template:
    """Return a template of `package`; it may include those of this one."""
    loaders = [jinja2.PackageLoader(name) for name in dict.fromkeys((package, "manicm_ms.evaluation"))]
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(loaders), autoescape=autoescape, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template(name)
