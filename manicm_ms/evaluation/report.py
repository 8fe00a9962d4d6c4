"""The report of an evaluation: a Markdown file and one self-contained HTML page."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from manicm_ms.evaluation.plots import PAPER_LATENCY_MS, latency_plot, success_plot
from manicm_ms.evaluation.results import INTERVALS
from manicm_ms.evaluation.text import (
    HEADERS,
    crash_lines,
    decision_sentences,
    episodes_title,
    format_ms,
    paired_sentences,
    realism_headers,
    realism_rows,
    realism_sentence,
    rows,
)
from manicm_ms.paths import write_text


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


def _context(results: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "results": results,
        "headers": HEADERS,
        "rows": rows(results),
        "title": episodes_title(results),
        "remarks": results.get("remarks", []),
        "intervals": results.get("intervals", INTERVALS),
        "sentences": [
            *filter(None, [realism_sentence(results)]),
            *decision_sentences(results),
            *paired_sentences(results),
        ],
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
