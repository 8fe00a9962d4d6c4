"""Plots of an evaluation as inline SVG that follows the page's colours."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from manicm_ms.evaluation.results import INTERVALS
from manicm_ms.evaluation.text import format_ms

PAPER_LATENCY_MS = {"DP3, paper": 177.6, "ManiCM, paper": 17.3}
"""Mean decision times on an RTX 4090, milliseconds: ManiCM (arXiv:2406.01586), table of results, last column."""

ROLE_COLORS = {
    "teacher": "#3b76c4",
    "control": "#8c93a0",
    "student": "#e07b39",
    "policy": "#5b9a68",
    "paper": "#b9bec7",
}

# Plots are drawn in this colour and then told to use the page's own, so that they follow light and dark.
_INK = "#010203"


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


class Line(NamedTuple):
    """Values over the steps of a training.

    Attributes:
        steps: (N,) optimizer steps.
        values: (N,) at these steps.
        intervals: (N,) lowest and highest, or none.
    """

    steps: Sequence[float]
    values: Sequence[float]
    intervals: Sequence[tuple[float, float]] = ()


class Panel(NamedTuple):
    """Lines that share a vertical axis.

    Attributes:
        label: of that axis.
        lines: name -> line.
        log: whether the axis is logarithmic.
    """

    label: str
    lines: Mapping[str, Line]
    log: bool = False


LINE_COLORS = ("#3b76c4", "#e07b39", "#5b9a68", "#8c5fb0", "#b0893b")


def curves_plot(panels: Sequence[Panel], description: str) -> str:
    """Return an SVG of panels one below the other over the same steps; names are told where a panel has several."""
    figure = Figure(figsize=(7.4, 0.5 + 2.0 * len(panels)), layout="constrained")
    for axes, panel in zip(figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0], panels, strict=True):
        for k, (name, line) in enumerate(panel.lines.items()):
            color = LINE_COLORS[k % len(LINE_COLORS)]
            axes.plot(line.steps, line.values, color=color, lw=1.6, marker="o", ms=3 if len(line.steps) < 30 else 0,
                      label=name)  # fmt: skip
            if line.intervals:
                axes.fill_between(line.steps, *zip(*line.intervals, strict=True), color=color, alpha=0.15, lw=0)
        if panel.log:
            axes.set_yscale("log")
        _plain_axes(axes, panel.label)
        if len(panel.lines) > 1:
            axes.legend(
                frameon=False, labelcolor=_INK, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, fontsize="small"
            )
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("optimizer steps")
    axes.xaxis.label.set_color(_INK)
    return _svg(figure, description)


def _plain_axes(axes: Any, label: str) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["bottom", "left"]].set_color(_INK)
    axes.tick_params(colors=_INK, which="both")
    axes.set_ylabel(label, color=_INK)
    axes.grid(color=_INK, alpha=0.12, lw=0.8)
    axes.set_axisbelow(True)
    axes.patch.set_alpha(0)
