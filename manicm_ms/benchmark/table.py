"""The paper's main table from the results of a benchmark: success by group, average, NFE and time of a decision."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console

from manicm_ms.benchmark.jobs import CollectJob, EvaluateJob, TrainJob
from manicm_ms.benchmark.methods import Method
from manicm_ms.benchmark.plan import HIGHEST, Plan
from manicm_ms.benchmark.summary import INTERVALS, SCHEMA_VERSION, cell_rates, group_of, mean_known, summarise
from manicm_ms.errors import ManicmError
from manicm_ms.evaluation.latency import measure_latency
from manicm_ms.evaluation.machine import machine
from manicm_ms.evaluation.statistics import mean_of_highest
from manicm_ms.paths import write_json
from manicm_ms.progress import working
from manicm_ms.provenance import package_versions


def measure_decisions(plan: Plan, console: Console, repetitions: int = 30) -> None:
    """Time one decision of every method on each task's first seed, in turn, and keep it; call it on a quiet machine.

    A task that is measured already, is not done, or lacks a checkpoint is left out.
    """
    for env_id in plan.env_ids:
        path = plan.folder(env_id) / "latency.json"
        jobs = [EvaluateJob(plan, env_id, plan.seeds[0], method) for method in plan.parsed_methods]
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
        **summarise(cells, plan.env_ids, plan.parsed_methods),
        "intervals": INTERVALS,
        "demonstrations": [_demonstrations(plan, env_id) for env_id in plan.env_ids],
        "missing": [_missing(job) for job in _evaluate_jobs(plan) if not _is_measured(job)],
    }


def _evaluate_jobs(plan: Plan) -> Iterable[EvaluateJob]:
    return (EvaluateJob(plan, e, s, m) for e in plan.env_ids for s in plan.seeds for m in plan.parsed_methods)


def _is_measured(job: EvaluateJob) -> bool:
    """Return whether it is done and any of its episodes was played to an end: crashes alone are no rate."""
    return job.is_done() and any(episode["crashed"] is None for episode in job.result()["episodes"])


def _missing(job: EvaluateJob) -> dict[str, str]:
    reason = "not done yet"
    if job.is_done():
        first = job.result()["episodes"][0]
        reason = (
            f"every episode crashed, seed {first['seed']} with: {first['crashed']}; "
            f"delete {job.stem.parent / 'episodes'} and {job.result_file} to play them again"
        )
    for stage in (*_needs(job), job):
        if stage.failure_file.is_file() and not stage.is_done():
            reason = json.loads(stage.failure_file.read_text(encoding="utf-8"))["reason"]
    return {"job": job.name, "reason": reason}


def _needs(job: Any) -> list[Any]:
    return [stage for need in job.needs for stage in (*_needs(need), need)]


def _cell(plan: Plan, env_id: str, method: Method) -> dict[str, Any]:
    """Return the results of one method on one task, over the training seeds that are done."""
    jobs = [job for seed in plan.seeds if _is_measured(job := EvaluateJob(plan, env_id, seed, method))]
    results = [job.result() for job in jobs]
    seeds = [str(job.seed) for job in jobs]
    outcomes, once, at_end = (_outcomes(results, seeds, key) for key in ("success", "success_once", "success_at_end"))
    highest = [_highest(r["evaluations"]) for r in results]
    timed = _timed(plan, env_id, method)
    return {
        "env_id": env_id,
        "group": group_of(env_id),
        "method": method.name,
        "nfe": results[0]["nfe"] if results else None,
        **cell_rates(outcomes or {}),
        "outcomes": outcomes or {},
        "success_once": once,
        "success_at_end": at_end,
        "mean_of_5_highest": mean_known(highest),
        "evaluations": {seed: r["evaluations"] for seed, r in zip(seeds, results, strict=True)},
        "crashed": sum(e["crashed"] is not None for r in results for e in r["episodes"]),
        "mean_steps": float(np.mean([e["steps"] for r in results for e in r["episodes"]])) if results else None,
        "latency_ms": timed,
        "training_seconds": [
            train.result()["training_seconds"]
            for job in jobs
            if method.trains and (train := TrainJob(plan, env_id, job.seed, method)).is_done()
        ],
    }


def _outcomes(results: Sequence[Mapping[str, Any]], seeds: Sequence[str], key: str) -> dict[str, list[bool]] | None:
    """Return training seed -> what the episodes say under `key`, or None where it is not known of all of them."""
    found = {
        seed: [episode.get(key) for episode in result["episodes"]] for seed, result in zip(seeds, results, strict=True)
    }
    return None if any(value is None for outcomes in found.values() for value in outcomes) else found


def _highest(evaluations: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the paper's score of one training, or None where there were too few evaluations."""
    rates = [e["successes"] / e["n"] for e in evaluations]
    return mean_of_highest(rates, HIGHEST) if len(rates) >= HIGHEST else None


def _timed(plan: Plan, env_id: str, method: Method) -> dict[str, Any] | None:
    path = plan.folder(env_id) / "latency.json"
    if not path.is_file():
        return None
    found: dict[str, Any] | None = json.loads(path.read_text(encoding="utf-8"))["methods"].get(method.folder)
    return found


def _demonstrations(plan: Plan, env_id: str) -> dict[str, Any]:
    job = CollectJob(plan, env_id)
    return {"env_id": env_id, **(job.result() if job.is_done() else {})}
