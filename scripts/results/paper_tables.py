"""The paper's tables from finished runs, ours beside the printed figures; scripts/reproduce_tables.py prints them."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from manicm_ms.benchmark.method_names import read_name
from manicm_ms.benchmark.methods import parse_methods
from manicm_ms.benchmark.report import TextTable
from manicm_ms.benchmark.summary import PAPER_GROUPS, summarise, summarised
from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.plots import Line
from manicm_ms.evaluation.text import format_ms
from manicm_ms.wording import counted

REPO = Path(__file__).resolve().parents[2]
PRINTED: Mapping[str, Any] = json.loads(Path(__file__).with_name("manicm_paper.json").read_text())
MISSING = "\u2013"
LEGEND = f"{MISSING}: not run here, or not printed in the paper; never a zero."
TABLES: tuple[Literal["main"], Literal["ddim"], Literal["prediction"], Literal["real"]] = (
    "main",
    "ddim",
    "prediction",
    "real",
)
EPSILON = "[head.prediction_type=epsilon]"
CONTROL = "one_step"
_SAME = ("preset", "demos", "colors", "obs_preset", "episodes", "eval_seed")
"""Keys of a benchmark's plan in which results must agree to stand in one table."""
_NOT_RUN: Mapping[str, Any] = {"nfe": None, "groups": {}, "average": None, "decision_ms": None}
TEACHERS = ("dp3", "simple_dp3")


def ddim_rows(teacher: str) -> dict[str, tuple[str, ...]]:
    """Return row of the DDIM table -> names that its method may have, the one to be run where none is known last."""

    def steps(count: int) -> tuple[str, ...]:
        return (f"{teacher}_{count}", f"{teacher}[head.num_inference_steps={count}]")

    return {
        "teacher, 10 steps": (teacher,),
        "teacher, 4 steps": steps(4),
        "teacher, 2 steps": steps(2),
        "teacher, 1 step": (f"{CONTROL}:{teacher}", CONTROL),
        "student, 4 steps": (f"manicm_4:{teacher}", "manicm_4"),
        "student, 1 step": (f"manicm:{teacher}", "manicm"),
    }


def prediction_methods(teacher: str) -> tuple[str, ...]:
    """Return teacher and student of each prediction type."""
    other = f"{teacher}{EPSILON}"
    return (teacher, other, f"manicm:{teacher}", f"manicm:{other}")


# ---- results of finished runs ---------------------------------------------------------------------------------------


def read_results(places: Sequence[Path]) -> dict[str, Any]:
    """Return table -> results of finished runs.

    Args:
        places: folders, or files, of this script, of `manicm-ms benchmark`, or of the real-world table.

    Raises ConfigError where there are no results, damaged ones, or two of them hold the same task and method.
    """
    try:
        return _by_table(places)
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        names, why = ", ".join(map(str, places)), f"{type(error).__name__}: {error}"
        raise ConfigError(f"results of {names} lack something ({why}): run it again") from error


def _by_table(places: Sequence[Path]) -> dict[str, Any]:
    grids: dict[str, list[Mapping[str, Any]]] = {"main": [], "ddim": [], "prediction": []}
    found: dict[str, Any] = {}
    for place in places:
        results = stored(place)
        if "cells" in results:
            grids["prediction" if any(EPSILON in c["method"] for c in results["cells"]) else "main"].append(results)
        elif "tasks" in results:
            found["real"] = results
        else:
            for name, part in results.items():
                if name in grids:
                    grids[name].append(part)
                elif name == "real":
                    found[name] = part
    found |= {name: joined(parts) for name, parts in grids.items() if parts}
    return {"ddim": found["main"], **found} if "main" in found else found


def stored(place: Path) -> dict[str, Any]:
    """Return what a finished run has left in a folder, or in a file."""
    names = ("tables.json", "results.json", "real_world.json")
    files = [place] if place.is_file() else [place / name for name in names if (place / name).is_file()]
    if not files:
        raise ConfigError(f"{place} holds no finished run: none of {', '.join(names)} is there")
    try:
        found: dict[str, Any] = json.loads(files[0].read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(f"{files[0]} is not readable JSON ({error}): run it again") from error
    if not isinstance(found, dict) or not ({"cells", "tasks"} & set(found) or set(found) & set(TABLES)):
        raise ConfigError(f"{files[0]} holds no results of a benchmark and none of the real-world table")
    return found


def joined(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return several results of a benchmark as one, all that follows from the outcomes computed anew."""
    keys = [(cell["env_id"], cell["method"]) for part in parts for cell in part["cells"] if cell["n"]]
    if differing := [key for key in _SAME if len({json.dumps(part["plan"].get(key)) for part in parts}) > 1]:
        raise ConfigError(f"two of the results were made with another {differing[0]}: name those that belong together")
    if twice := [key for k, key in enumerate(keys) if key in keys[:k]]:
        raise ConfigError(f"two of the results hold {twice[0][1]} on {twice[0][0]}: name one of them")
    renewed = [summarised(part) for part in parts]
    cells = [cell for part in renewed for cell in part["cells"]]
    played = [cell for cell in cells if cell["n"]]
    rest = [cell for cell in cells if not cell["n"] and (cell["env_id"], cell["method"]) not in keys]
    chosen, env_ids = [*played, *rest], list(dict.fromkeys(cell["env_id"] for cell in cells))
    methods = parse_methods(list(dict.fromkeys(cell["method"] for cell in chosen)))
    return {
        **renewed[0],
        "cells": chosen,
        "env_ids": env_ids,
        "missing": [entry for part in parts for entry in part["missing"]],
        **(summarise(chosen, env_ids, methods) if len(parts) > 1 else {}),
    }


def real_world() -> Any:
    """Return the script of the real-world table, which lies beside this one."""
    if str(REPO / "scripts") not in sys.path:
        sys.path.append(str(REPO / "scripts"))  # last: former paths of other scripts lie there
    import reproduce_real_world_table

    return reproduce_real_world_table


# ---- tables ---------------------------------------------------------------------------------------------------------


def main_table(results: Mapping[str, Any] | None) -> TextTable:
    """Return the paper's main table: a method two lines, ours and the printed one."""
    sizes, rows = PRINTED["groups"], results["rows"] if results else []
    extra = [name for row in rows for name in row["groups"] if name not in sizes]
    groups = [*PAPER_GROUPS, *dict.fromkeys(extra)]
    heads = [f"{name} ({sizes[name]})" if name in sizes else name for name in groups]
    lines = []
    by_kind: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if not read_name(row["method"]).overrides:
            by_kind.setdefault(read_name(row["method"]).kind, []).append(row)
    for kind in (*PRINTED["main"], *(k for k in by_kind if k not in PRINTED["main"])):
        lines += [_ours(row, groups, sizes) for row in by_kind.get(kind, [{"method": kind, **_NOT_RUN}])]
        if kind in PRINTED["main"]:
            lines.append(_printed(PRINTED["main"][kind], groups))
    headers = ("method", "whose", "NFE", *heads, "average", "one decision")
    return TextTable("Success by group, % (95 % interval)", headers, lines)


def _ours(row: Mapping[str, Any], groups: Sequence[str], sizes: Mapping[str, int]) -> tuple[str, ...]:
    cells = [_rate(row["groups"].get(name), sizes.get(name)) for name in groups]
    nfe = MISSING if row["nfe"] is None else str(row["nfe"])
    return (row["method"], "here", nfe, *cells, _rate(row["average"], sum(sizes.values())), _time(row["decision_ms"]))


def _printed(figures: Mapping[str, Any], groups: Sequence[str]) -> tuple[str, ...]:
    cells = [f"{figures[name]:.1f}" if name in figures else MISSING for name in groups]
    average = f"{figures['average']:.1f} \u00b1 {figures['sd']:.1f}"
    return (figures["title"], "paper", str(figures["nfe"]), *cells, average, _time(figures["ms"]))


def _rate(entry: Mapping[str, Any] | None, of: int | None = None) -> str:
    """Return a rate with its interval, and over how many tasks it goes where these are not all."""
    if entry is None or entry["success_rate"] is None:
        return MISSING
    low, high = entry["ci95"]
    some = f" [{entry['tasks']} of {of} tasks]" if of is not None and entry["tasks"] < of else ""
    return f"{100 * entry['success_rate']:.1f} ({100 * low:.0f} to {100 * high:.0f}){some}"


def _time(milliseconds: float | None) -> str:
    return MISSING if milliseconds is None else format_ms(milliseconds)


def ddim_table(results: Mapping[str, Any] | None, teacher: str) -> TextTable:
    """Return success and time of a decision by network evaluations, by suite and on average, ours and the printed."""
    suites = ("adroit", "metaworld", "average")
    lines = []
    cells = [cell for cell in results["cells"] if cell["n"]] if results else []
    kinds = [read_name(cell["method"]).kind for cell in cells]
    teacher = next((kind for kind in (teacher, *TEACHERS) if kind in kinds), teacher)
    for title, names in ddim_rows(teacher).items():
        mine = [cell for name in names for cell in cells if cell["method"] == name]
        mine = [cell for cell in mine if cell["method"] == mine[0]["method"]]
        lines.append((f"{title}, here ({teacher})", *(text for suite in suites for text in _of_suite(mine, suite))))
    for title, figures in PRINTED["ddim"].items():
        texts = [text for suite in suites for text in (f"{figures[suite][0]:.1f}", f"{figures[suite][1]:.1f} ms")]
        lines.append((f"{title}, paper", *texts))
    headers = ("teacher or student", *(text for suite in suites for text in (f"{suite}, %", f"{suite}, decision")))
    return TextTable("DDIM steps", headers, lines)


def _of_suite(cells: Sequence[Mapping[str, Any]], suite: str) -> tuple[str, str]:
    """Return rate and time of one method's cells of a suite, or of all."""
    chosen = [cell for cell in cells if suite in ("average", cell["env_id"].partition("/")[0])]
    if not chosen:
        return MISSING, MISSING
    methods = parse_methods([chosen[0]["method"]])
    (row,) = summarise(chosen, [cell["env_id"] for cell in chosen], methods)["rows"]
    return f"{_rate(row['average'])}, {counted(len(chosen), 'task')}", _time(row["decision_ms"])


def curves(results: Mapping[str, Any] | None) -> dict[str, Line]:
    """Return method -> its success over the steps of the training, % averaged over tasks and trainings."""
    found: dict[str, dict[int, list[float]]] = {}
    for cell in results["cells"] if results else []:
        for evaluations in cell["evaluations"].values():
            for e in evaluations:
                found.setdefault(cell["method"], {}).setdefault(e["step"], []).append(100 * e["successes"] / e["n"])
    return {
        method: Line(sorted(steps), [float(np.mean(steps[step])) for step in sorted(steps)])
        for method, steps in found.items()
    }


def prediction_table(results: Mapping[str, Any] | None, teacher: str) -> TextTable:
    """Return the learning curves of sample against epsilon, and what each reached on the held-out seeds."""
    lines: list[tuple[str, ...]] = []
    drawn = curves(results)
    rows = {row["method"]: row for row in results["rows"]} if results else {}
    for name in list(drawn) or prediction_methods(teacher):
        line = drawn.get(name)
        told = (
            MISSING
            if line is None
            else ", ".join(f"{s}: {v:.0f}" for s, v in zip(line.steps, line.values, strict=True))
        )
        read = read_name(name)
        kind = "epsilon" if EPSILON in name else "sample"
        printed = f"{PRINTED['prediction'][kind]:.1f}" if read.kind == "manicm" else MISSING
        lines.append((name, kind, told, _rate(rows[name]["average"]) if name in rows else MISSING, printed))
    headers = ("method", "prediction", "step: success during training, %", "held-out seeds, %", "paper, average")
    return TextTable("Prediction of the sample against that of the noise", headers, lines)


def real_table(data: Mapping[str, Any] | None) -> str:
    """Return the real-world table, Markdown; without a run the printed figures alone."""
    real = real_world()
    if data is not None:
        return str(real.table(data)).replace("| - ", f"| {MISSING} ")
    lines = ["| task | method | real robot, paper: success | decision | simulation, here |", "|---|---|---|---|---|"]
    for task in real.TASKS.values():
        for role, cell in task.paper.items():
            figures = f"{cell.success:.0f} % | {cell.runtime_ms:.1f} ms"
            lines.append(f"| {task.title} | {real.METHODS[role]} | {figures} | {MISSING} |")
    return "\n".join(lines)


def document(found: Mapping[str, Any], only: Sequence[str], teacher: str, command: str) -> str:
    """Return all tables asked for as Markdown."""
    blocks = {
        "main": lambda: markdown(main_table(found.get("main"))),
        "ddim": lambda: markdown(ddim_table(found.get("ddim"), teacher)),
        "prediction": lambda: markdown(prediction_table(found.get("prediction"), teacher)),
        "real": lambda: f"**Real-world tasks**\n\n{real_table(found.get('real'))}",
    }
    parts = [f"{blocks[name]()}\n\n{how(found.get(name))}" for name in only]
    missing = [f"- {e['job']}: {e['reason']}" for name in only for e in found.get(name, {}).get("missing", ())]
    failed = ["Not in the tables:\n\n" + "\n".join(dict.fromkeys(missing))] if missing else []
    return "\n\n".join([*parts, LEGEND, f"Paper: {PRINTED['source']}.", *failed, f"Made by `{command}`."]) + "\n"


def how(results: Mapping[str, Any] | None) -> str:
    """Return in a sentence how our figures of a table were made."""
    if results is None:
        return "Nothing of it was run here."
    if "plan" not in results:
        return f"Made by `{results['command']}`."
    plan, seeds = results["plan"], results["fresh_seeds"]
    trained = f"training seeds {', '.join(map(str, results['seeds']))}"
    return (
        f"Here: preset {plan['preset']}, {counted(plan['demos'], 'demonstration')} a task, {trained}, held-out seeds "
        f"{seeds[0]} to {seeds[1]}, decisions on {results['machine']['cpu']}."
    )


def markdown(table: TextTable) -> str:
    """Return a table as Markdown, its title in bold above it."""
    lines = [table.headers, ("---",) * len(table.headers), *table.rows]
    return f"**{table.title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines)
