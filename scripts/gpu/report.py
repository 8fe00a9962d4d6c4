"""Turn the result lines of the GPU kit into Markdown.

python scripts/gpu/report.py OUT/results.jsonl > docs/results/gpu.md
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from kit import Results

Line = dict[str, Any]


def table(columns: dict[str, Callable[[Line], Any]], lines: Sequence[Line]) -> str:
    """Return a Markdown table; `columns` maps a heading to what it shows of a line."""
    rows = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    rows += ["| " + " | ".join(str(show(line)) for show in columns.values()) + " |" for line in lines]
    return "\n".join(rows)


def latency(lines: Sequence[Line]) -> str:
    """Return the section of part 1."""
    mine = [line for line in lines if line["part"] == "latency"]
    measured = [line for line in mine if "median_ms" in line]
    if not measured:
        return ""
    where = next(line for line in mine if "bandwidth_gb_s" in line)
    device = where["machine"].get("cuda", where["machine"]["cpu"])
    columns: dict[str, Callable[[Line], Any]] = {
        "policy": lambda x: x["model"],
        "NFE": lambda x: x["nfe"],
        "type": lambda x: x["dtype"],
        "batch": lambda x: x["batch"],
        "mode": lambda x: x["mode"],
        "median": lambda x: f"{x['median_ms']:.2f} ms",
        "p95": lambda x: f"{x['p95_ms']:.2f} ms",
        "decisions/s": lambda x: f"{x['decisions_per_s']:.0f}",
        "weights' floor": lambda x: f"{x['floor_ms']:.3f} ms",
        "largest difference": lambda x: f"{x['error']:.1e}",
    }
    ordered = sorted(measured, key=lambda x: (x["model"], -x["nfe"], x["batch"], x["dtype"], x["mode"]))
    intro = (
        f"{device}, torch {where['torch']}, {where['bandwidth_gb_s']} GB/s by copying (bytes read plus written); "
        f"float32 convolutions {'may use' if where['tf32_convolutions'] else 'do not use'} TF32, as torch has it. "
        "The floor is the bytes of weights that a decision reads at that bandwidth; the difference is to the CPU's "
        "float32 action from the same observation and noise."
    )
    return f"## One decision\n\n{intro}\n\n{table(columns, ordered)}"


def training(lines: Sequence[Line]) -> str:
    """Return the section of part 2."""
    mine = [line for line in lines if line["part"] == "training" and "steps" in line]
    columns: dict[str, Callable[[Line], Any]] = {
        "task": lambda x: x["task"],
        "policy": lambda x: x["kind"],
        "steps": lambda x: x["steps"],
        "of the preset's": lambda x: f"{x['preset_steps']} ({x['share']:.1%})",
        "steps/s": lambda x: x["steps_per_s"],
        "loss": lambda x: "-" if x["loss"] is None else f"{x['loss']:.2e}",
        "archive": lambda x: f"{x['archive']}, {x['bytes']} bytes",
    }
    return f"## Trainings\n\n{table(columns, mine)}" if mine else ""


def families(lines: Sequence[Line]) -> str:
    """Return the section of part 4."""
    mine = [line for line in lines if line["part"] == "families"]
    trained = [line for line in mine if "steps" in line]
    if not trained:
        return ""
    columns: dict[str, Callable[[Line], Any]] = {
        "method": lambda x: x["method"],
        "steps": lambda x: x["steps"],
        "of the preset's": lambda x: f"{x['preset_steps']} ({x['share']:.1%})",
        "steps/s, alone": lambda x: x["steps_per_s"],
        "loss": lambda x: "-" if x["loss"] is None else f"{x['loss']:.2e}",
        "archive": lambda x: f"{x['archive']}, {x['bytes']} bytes" if "archive" in x else "-",
    }
    first = trained[0]
    used = "at once" if first["at_once"] else "one after another"
    intro = (
        f"{first['task']}, {first['episodes']} demonstrations, batch {first['batch_size']}; "
        f"{first['planned_steps']} steps planned for each, trained {used}. Losses of different methods do not compare."
    )
    for rounds in (line["steps_of_all_per_s"] for line in mine if "used" in line):
        took = {way: 1000 / rate for way, rate in rounds.items()}
        intro += (
            f" A step of all takes {took['one_after_another']:.0f} ms one after another, {took['at_once']:.0f} at once."
        )
    return f"## Families of methods\n\n{intro}\n\n{table(columns, trained)}"


def simulation(lines: Sequence[Line]) -> str:
    """Return the section of part 3."""
    mine = [line for line in lines if line["part"] == "simulation"]
    tried = [f"- {x['driver']}: {x.get('device') or x['failed']}" for x in mine if "driver" in x]
    rates = [x for x in mine if x["name"] == "rate" and "steps_per_s" in x]
    checks = [x for x in mine if x["name"] == "check" and "passed" in x]
    speed: dict[str, Callable[[Line], Any]] = {
        "workers": lambda x: x["workers"],
        "control steps/s of all": lambda x: x["steps_per_s"],
        "best": lambda x: x["best"],
        "pictures by": lambda x: x["device"],
    }
    conformance: dict[str, Callable[[Line], Any]] = {
        "task": lambda x: x["task"],
        "checks passed": lambda x: x["passed"],
        "broken": lambda x: "; ".join(x["broken"]) or x.get("failed", "none"),
    }
    parts = ["\n".join(tried), table(speed, rates) if rates else "", table(conformance, checks) if checks else ""]
    return "## Simulation\n\n" + "\n\n".join(filter(None, parts)) if mine else ""


def failures(lines: Sequence[Line]) -> str:
    """Return the section of what failed or was left out."""

    def told(line: Line) -> str:
        about = " ".join(str(v) for k, v in line.items() if k not in ("failed", "left_out"))
        return f"- {about}: {line.get('failed', line.get('left_out'))}"

    said = [told(line) for line in lines if "failed" in line or "left_out" in line]
    return "## What failed or was left out\n\n" + "\n".join(said) if said else ""


def report(lines: Sequence[Line]) -> str:
    """Return the page."""
    sections = [section(lines) for section in (latency, training, families, simulation, failures)]
    return "\n\n".join(["# What the GPU kit measured", *filter(None, sections)]) + "\n"


def main() -> None:
    """Print the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("results", type=Path, nargs="+", help="results.jsonl of one call or of several")
    print(report([line for path in parser.parse_args().results for line in Results.read(path)]), end="")


if __name__ == "__main__":
    main()
