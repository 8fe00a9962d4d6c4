"""The paper's main table from the results of a benchmark: success by group, average, NFE and time of a decision."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from rich.console import Console

from manicm_ms.benchmark.jobs import CollectJob, JudgeJob, TrainJob
from manicm_ms.benchmark.methods import Method
from manicm_ms.benchmark.plan import HIGHEST, Plan
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import ManicmError
from manicm_ms.evaluation.latency import measure_latency
from manicm_ms.evaluation.machine import machine
from manicm_ms.evaluation.statistics import compare_paired, mean_of_highest, mean_rate_interval, wilson_interval
from manicm_ms.paths import write_json
from manicm_ms.progress import working
from manicm_ms.provenance import package_versions

SCHEMA_VERSION = 1


def group_of(env_id: str) -> str:
    """Return the group of a task in the table, or its suite where its entry names none."""
    return ENVS.get(env_id).group or env_id.partition("/")[0]


def measure_decisions(plan: Plan, console: Console, repetitions: int = 30) -> None:
    """Time one decision of every method on each task's first seed, in turn, and keep it; call it on a quiet machine.

    A task that is measured already, is not done, or lacks a checkpoint is left out.
    """
    for env_id in plan.env_ids:
        path = plan.folder(env_id) / "latency.json"
        jobs = [JudgeJob(plan, env_id, plan.seeds[0], method) for method in plan.parsed_methods]
        wanted = {job.method.folder for job in jobs}
        if path.is_file() and set(json.loads(path.read_text(encoding="utf-8"))["methods"]) >= wanted:
            continue
        if not all(job.is_done() for job in jobs):
            continue
        try:
            policies = {
                job.method.folder: job.method.load(plan.checkpoint(env_id, job.seed, job.method), plan.device)
                for job in jobs
            }
        except ManicmError as error:
            console.print(f"{env_id}: decisions not timed: {error}", style="yellow", markup=False, highlight=False)
            continue
        with working(console, f"time the decisions of {env_id}"):
            measured = measure_latency(policies, repetitions=repetitions)
        times = {name: latency._asdict() for name, latency in measured.items()}
        write_json(path, {"machine": machine(), "methods": times})


def compile_table(plan: Plan, command: str) -> dict[str, Any]:
    """Return all that can be said of the jobs that are done, as plain JSON values."""
    cells = [_cell(plan, env_id, method) for env_id in plan.env_ids for method in plan.parsed_methods]
    return {
        "schema_version": SCHEMA_VERSION,
        "command": command,
        "plan": plan.identity | {"data": str(plan.data)},
        "env_ids": list(plan.env_ids),
        "seeds": list(plan.seeds),
        "fresh_seeds": [plan.fresh_seeds.start, plan.fresh_seeds.stop - 1],
        "versions": package_versions(),
        "machine": machine(),
        "cells": cells,
        "rows": [_row(method, [c for c in cells if c["method"] == method.name]) for method in plan.parsed_methods],
        "paired": _paired(plan, cells),
        "demonstrations": [_demonstrations(plan, env_id) for env_id in plan.env_ids],
        "missing": [_missing(job) for job in _judge_jobs(plan) if not job.is_done()],
    }


def _judge_jobs(plan: Plan) -> Iterable[JudgeJob]:
    return (JudgeJob(plan, e, s, m) for e in plan.env_ids for s in plan.seeds for m in plan.parsed_methods)


def _missing(job: JudgeJob) -> dict[str, str]:
    reason = "not done yet"
    for stage in (*_needs(job), job):
        if stage.failure_file.is_file() and not stage.is_done():
            reason = json.loads(stage.failure_file.read_text(encoding="utf-8"))["reason"]
    return {"job": job.name, "reason": reason}


def _needs(job: Any) -> list[Any]:
    return [stage for need in job.needs for stage in (*_needs(need), need)]


def _cell(plan: Plan, env_id: str, method: Method) -> dict[str, Any]:
    """Return the results of one method on one task, over the training seeds that are done."""
    jobs = [job for seed in plan.seeds if (job := JudgeJob(plan, env_id, seed, method)).is_done()]
    results = [job.result() for job in jobs]
    outcomes = {str(job.seed): [e["success"] for e in r["episodes"]] for job, r in zip(jobs, results, strict=True)}
    highest = [_highest(r["evaluations"]) for r in results]
    timed = _timed(plan, env_id, method)
    return {
        "env_id": env_id,
        "group": group_of(env_id),
        "method": method.name,
        "nfe": results[0]["nfe"] if results else None,
        **_rate(outcomes),
        "outcomes": outcomes,
        "mean_of_5_highest": _mean(highest),
        "evaluations": {str(job.seed): r["evaluations"] for job, r in zip(jobs, results, strict=True)},
        "crashed": sum(e["crashed"] is not None for r in results for e in r["episodes"]),
        "mean_steps": float(np.mean([e["steps"] for r in results for e in r["episodes"]])) if results else None,
        "latency_ms": timed,
        "training_seconds": [
            train.result()["training_seconds"]
            for job in jobs
            if method.trains and (train := TrainJob(plan, env_id, job.seed, method)).is_done()
        ],
    }


def _highest(evaluations: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the paper's score of one training, or None where there were too few evaluations."""
    rates = [e["successes"] / e["n"] for e in evaluations]
    return mean_of_highest(rates, HIGHEST) if len(rates) >= HIGHEST else None


def _mean(values: Sequence[float | None]) -> float | None:
    """Return the mean, or None where there is nothing or a value is missing."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known and len(known) == len(values) else None


def _timed(plan: Plan, env_id: str, method: Method) -> dict[str, Any] | None:
    path = plan.folder(env_id) / "latency.json"
    if not path.is_file():
        return None
    found: dict[str, Any] | None = json.loads(path.read_text(encoding="utf-8"))["methods"].get(method.folder)
    return found


def _rate(outcomes: Mapping[str, Sequence[bool]]) -> dict[str, Any]:
    """Return the success rate of all episodes with its Wilson interval, and how it spreads over training seeds."""
    pooled = [won for episodes in outcomes.values() for won in episodes]
    if not pooled:
        return {"n": 0, "successes": 0, "success_rate": None, "ci95": None, "by_seed": {}, "sd_over_seeds": None}
    by_seed = {seed: float(np.mean(episodes)) for seed, episodes in outcomes.items()}
    low, high = wilson_interval(sum(pooled), len(pooled))
    return {
        "n": len(pooled),
        "successes": sum(pooled),
        "success_rate": sum(pooled) / len(pooled),
        "ci95": [low, high],
        "by_seed": by_seed,
        "sd_over_seeds": float(np.std(list(by_seed.values()), ddof=1)) if len(by_seed) > 1 else None,
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
        "average": _of_tasks(done) if done else None,
        "decision_ms": float(np.mean(times)) if times else None,
    }


def _order(cell: Mapping[str, Any]) -> int:
    """Groups stand in the order in which their tasks are registered."""
    names = [group_of(name) for name in ENVS.names()]
    return names.index(cell["group"])


def _of_tasks(cells: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the mean over tasks, each counted once.

    The interval is what the number of episodes leaves open. It does not hold the choice of tasks, nor what another
    training would give, of which `sd_over_seeds` tells.
    """
    seeds = sorted({seed for c in cells for seed in c["by_seed"]})
    complete = [s for s in seeds if all(s in c["by_seed"] for c in cells)]
    by_seed = [float(np.mean([c["by_seed"][s] for c in cells])) for s in complete]
    low, high = mean_rate_interval([(c["successes"], c["n"]) for c in cells])
    highest = [c["mean_of_5_highest"] for c in cells]
    return {
        "tasks": len(cells),
        "n": sum(c["n"] for c in cells),
        "success_rate": float(np.mean([c["success_rate"] for c in cells])),
        "ci95": [low, high],
        "sd_over_seeds": float(np.std(by_seed, ddof=1)) if len(by_seed) > 1 else None,
        "mean_of_5_highest": _mean(highest),
    }


def _paired(plan: Plan, cells: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return every method against the one that it is made from, on the same task, training seed and fresh seeds."""
    by_key = {(c["env_id"], c["method"]): c["outcomes"] for c in cells}
    pairs = []
    for method in plan.parsed_methods:
        source = method.made_from
        if source is None or source.name not in plan.methods:
            continue
        first: list[bool] = []
        second: list[bool] = []
        by_seed: dict[str, list[int]] = {}  # seed -> wins of the second over the first, one by one
        tasks = 0
        for env_id in plan.env_ids:
            ours, theirs = by_key[env_id, method.name], by_key[env_id, source.name]
            both = [seed for seed in ours if seed in theirs]
            tasks += bool(both)
            for seed in both:
                first += theirs[seed]
                second += ours[seed]
                by_seed.setdefault(seed, []).extend(
                    int(b) - int(a) for a, b in zip(theirs[seed], ours[seed], strict=True)
                )
        if first:
            spread = {seed: float(np.mean(differences)) for seed, differences in by_seed.items()}
            named = {"first": source.name, "second": method.name, "tasks": tasks}
            pairs.append({**named, **_pair(first, second), "difference_by_seed": spread})
    return pairs


def _pair(first: Sequence[bool], second: Sequence[bool]) -> dict[str, Any]:
    pair = compare_paired(first, second)
    return {
        **pair.counts._asdict(),
        "difference": pair.difference,
        "difference_ci95": list(pair.difference_ci95),
        "mcnemar_p": pair.mcnemar_p,
    }


def _demonstrations(plan: Plan, env_id: str) -> dict[str, Any]:
    job = CollectJob(plan, env_id)
    return {"env_id": env_id, **(job.result() if job.is_done() else {})}
