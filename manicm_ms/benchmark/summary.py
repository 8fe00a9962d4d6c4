"""What the outcomes of a benchmark say: rates of groups of tasks, and each method against the one it is made from.

Everything here is computed from the cells' `outcomes`, so that results of any version can be summed up anew.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from statsmodels.stats.multitest import multipletests

from manicm_ms.benchmark.methods import Method, parse_methods
from manicm_ms.envs.simulator import ENVS
from manicm_ms.evaluation.intervals import CONFIDENCE, DIFFERENCE_METHOD, RATE_METHOD
from manicm_ms.evaluation.resampling import DRAWS, FEW, MeanOverTrainings, mean_difference, mean_rate
from manicm_ms.evaluation.statistics import mcnemar_exact, paired_counts

SCHEMA_VERSION = 2
"""2: trainings that replay the same start states are no longer pooled; success at the end is told. 1 pooled them."""
INTERVALS = {
    "confidence": CONFIDENCE,
    "rate": f"start states drawn again within each task, all trainings together, {DRAWS} times; {RATE_METHOD} over "
    f"start states for one training of one task, and where fewer than {FEW} start states differ from the rest of their "
    "task",
    "difference": f"the same with {DIFFERENCE_METHOD}",
}

Outcomes = Mapping[str, Sequence[bool]]
"""Training seed -> success of each episode, in the order of the start states."""


PAPER_GROUPS = ("adroit", "easy", "medium", "hard", "very-hard")
"""Groups of tasks in the order of the paper's table."""


def group_of(env_id: str) -> str:
    """Return the group of a task in the table, or its suite where its entry names none."""
    return ENVS.get(env_id).group or env_id.partition("/")[0]


def summarised(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return a benchmark's results, of any version, with all that follows from the outcomes computed anew."""
    missing = {"success_once": None, "success_at_end": None}
    cells = [_without_old(missing | cell) | cell_rates(cell["outcomes"]) for cell in results["cells"]]
    methods = parse_methods(tuple(dict.fromkeys(cell["method"] for cell in cells)))
    decisions = {row["method"]: row["decision_ms"] for row in results["rows"]}
    parts = summarise(cells, results["env_ids"], methods)
    for row in parts["rows"]:
        row["decision_ms"] = decisions.get(row["method"])
    return {**results, **parts, "schema_version": SCHEMA_VERSION, "intervals": INTERVALS, "cells": cells}


def _without_old(cell: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in cell.items() if key != "sd_over_seeds"}


def summarise(
    cells: Sequence[Mapping[str, Any]], env_ids: Sequence[str], methods: Sequence[Method]
) -> dict[str, list[dict[str, Any]]]:
    """Return the table's rows, a method each, and the paired comparisons."""
    return {
        "rows": [_row(method, [c for c in cells if c["method"] == method.name]) for method in methods],
        "paired": _paired(cells, env_ids, methods),
    }


def cell_rates(outcomes: Outcomes) -> dict[str, Any]:
    """Return the success rate of one method on one task: the mean of its trainings, each of them, and its interval."""
    n = sum(len(episodes) for episodes in outcomes.values())
    won = sum(sum(episodes) for episodes in outcomes.values())
    if not n:
        nothing: dict[str, Any] = {"success_rate": None, "ci95": None, "by_seed": {}, "range": None, "speaks_of": None}
        return {"n": 0, "successes": 0, **nothing}
    return {"n": n, "successes": won, **_told("success_rate", mean_rate([_array(outcomes)]), list(outcomes))}


def mean_known(values: Sequence[float | None]) -> float | None:
    """Return the mean, or None where there is nothing or a value is missing."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None


def _array(outcomes: Outcomes, seeds: Sequence[str] | None = None) -> np.ndarray:
    return np.array([outcomes[seed] for seed in (outcomes if seeds is None else seeds)], dtype=bool)  # (T, S)


def _told(name: str, found: MeanOverTrainings, seeds: Sequence[str]) -> dict[str, Any]:
    return {
        name: found.mean,
        "ci95": list(found.ci95),
        "by_seed": dict(zip(seeds, found.by_training, strict=True)),
        "range": [min(found.by_training), max(found.by_training)],
        "speaks_of": found.speaks_of,
    }


def _row(method: Method, cells: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return one line of the table: a method by group, and over all tasks."""
    done = [c for c in cells if c["n"]]
    groups = {name: list(members) for name, members in groupby(sorted(done, key=_order), key=lambda c: c["group"])}
    times = [c["latency_ms"]["median_ms"] for c in done if c["latency_ms"]]
    return {
        "method": method.name,
        "nfe": done[0]["nfe"] if done else None,
        "groups": {name: _of_tasks(members) for name, members in groups.items()},
        "average": _of_tasks(done),
        "decision_ms": float(np.mean(times)) if times else None,
    }


def _order(cell: Mapping[str, Any]) -> tuple[int, str]:
    """Groups stand in the paper's order, others behind; which file of tasks was imported first does not matter."""
    group = cell["group"]
    return PAPER_GROUPS.index(group) if group in PAPER_GROUPS else len(PAPER_GROUPS), group


def _of_tasks(cells: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Return the mean over tasks, each counted once, of the trainings that are done on all of them."""
    if not cells or not (seeds := _common([c["outcomes"] for c in cells])):
        return None
    tasks = [_array(c["outcomes"], seeds) for c in cells]
    return {
        "tasks": len(cells),
        "n": sum(task.size for task in tasks),
        **_told("success_rate", mean_rate(tasks), seeds),
        "mean_of_5_highest": mean_known([c["mean_of_5_highest"] for c in cells]),
    }


def _common(outcomes: Sequence[Outcomes]) -> list[str]:
    """Return the training seeds that all hold, in the order of the first."""
    return [seed for seed in outcomes[0] if all(seed in other for other in outcomes)]


def _paired(
    cells: Sequence[Mapping[str, Any]], env_ids: Sequence[str], methods: Sequence[Method]
) -> list[dict[str, Any]]:
    """Return every method against the one that it is made from, on the same task, training and start states."""
    by_key = {(c["env_id"], c["method"]): c["outcomes"] for c in cells}
    names = [method.name for method in methods]
    pairs = []
    for method in methods:
        source = method.made_from
        if source is None or source.name not in names:
            continue
        both = {e: (by_key[e, source.name], by_key[e, method.name]) for e in env_ids}
        done = {e: outcomes for e, outcomes in both.items() if _common(outcomes)}
        if done:
            pairs.append({"first": source.name, "second": method.name, **_pair(done)})
    return pairs


def _pair(tasks: Mapping[str, tuple[Outcomes, Outcomes]]) -> dict[str, Any]:
    """Return the mean difference over tasks where trainings are done on all, and every task on its own."""
    by_task = [_task_pair(env_id, first, second) for env_id, (first, second) in tasks.items()]
    tests = [p for entry in by_task for p in entry["mcnemar_p"].values()]
    found: dict[str, Any] = {"tasks": len(tasks), "difference": None}
    if seeds := _common([outcomes for pair in tasks.values() for outcomes in pair]):
        differences = [_difference(first, second, seeds) for first, second in tasks.values()]
        found["start_states"] = sum(task.shape[1] for task in differences)
        found |= _told("difference", mean_difference(differences), seeds)
    smallest = {"tests": len(tests), "smallest_p": min(tests), "smallest_p_holm": float(_holm(tests).min())}
    return {**found, **smallest, "by_task": by_task}


def _task_pair(env_id: str, first: Outcomes, second: Outcomes) -> dict[str, Any]:
    """Return one task's comparison: counts over its trainings, and McNemar's exact test of each."""
    seeds = _common([first, second])
    tables = {seed: paired_counts(first[seed], second[seed]) for seed in seeds}
    counts = {name: sum(getattr(t, name) for t in tables.values()) for name in next(iter(tables.values()))._fields}
    told = _told("difference", mean_difference([_difference(first, second, seeds)]), seeds)
    return {"env_id": env_id, **counts, **told, "mcnemar_p": {s: mcnemar_exact(t) for s, t in tables.items()}}


def _difference(first: Outcomes, second: Outcomes, seeds: Sequence[str]) -> np.ndarray:
    return _array(second, seeds).astype(int) - _array(first, seeds)  # (T, S) of {-1, 0, 1}


def _holm(p_values: Sequence[float]) -> np.ndarray:
    """Return p values adjusted for their number: S. Holm, Scandinavian Journal of Statistics 6 (1979) 65-70."""
    return np.asarray(multipletests(p_values, method="holm")[1])
