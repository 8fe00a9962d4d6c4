"""The work of `manicm-ms benchmark`: run the grid, then time decisions and write the table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from manicm_ms.benchmark.jobs import Job, all_jobs
from manicm_ms.benchmark.plan import Plan
from manicm_ms.benchmark.pool import run_in_processes, work_off
from manicm_ms.benchmark.report import interval_lines, paired_lines, rich_tables, write_benchmark
from manicm_ms.benchmark.table import compile_table, measure_decisions
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.records import LOCK_FILE, require_same_request
from manicm_ms.paths import waiting_lock, write_json
from manicm_ms.progress import progress_bars

PLAN_FILE = "benchmark.json"


def benchmark(
    plan: Plan, *, processes: int, ray: str | None = None, command: str, console: Console | None = None
) -> dict[str, Any]:
    """Do all jobs of the plan that are not done yet, and write results.json, report.md and report.html.

    The same call goes on where an earlier one was stopped, and several may run at once, on one machine or on several
    that share `plan.out`: each takes jobs that no other is at.

    Args:
        plan: the grid.
        processes: that work at once, where `ray` is None; 0: this process does the work itself.
        ray: address of a Ray cluster that does the work instead.
        command: for the report.
        console: where progress and table are printed.

    Returns:
        What results.json holds; `missing` names the jobs that failed, with reasons.

    Raises:
        OutputExistsError: `plan.out` holds a benchmark with other settings.
        UnknownNameError, ConfigError: a task that does not exist, has no expert, or not what the plan asks for.
        BackendError: no Ray, or no cluster.
    """
    console = console or Console()
    if processes < 0:
        raise ConfigError(f"--processes must be at least 0, got {processes}")
    for env_id in plan.env_ids:
        entry = ENVS.get(env_id)
        entry.require(SimulatorConfig(obs_preset=plan.obs_preset))
        plan.require_seeds_of(entry)
        EXPERTS.get(env_id)
    _claim(plan)
    jobs = all_jobs(plan)
    with progress_bars(console, "{task.fields[last]}") as shown:
        bar = shown.add_task("jobs", total=len(jobs), last="")
        seen: set[str] = set()

        def report(done: Sequence[Job]) -> None:
            fresh = [job.name for job in done if job.name not in seen]
            seen.update(fresh)
            shown.update(bar, completed=len(done))
            if fresh:
                shown.update(bar, last=fresh[-1])

        if not all(job.is_done() for job in jobs):
            if ray is not None:
                from manicm_ms.benchmark.ray_cluster import run_on_ray

                run_on_ray(plan, ray, report)
            elif not processes:
                work_off(plan, shown.console)
            else:
                for trouble in run_in_processes(plan, processes, report):
                    shown.console.print(trouble, style="red", markup=False, highlight=False)
        report([job for job in jobs if job.is_done()])
    with waiting_lock(plan.out / LOCK_FILE):  # of several commands that end together, one measures while the rest waits
        measure_decisions(plan, console)
        results = compile_table(plan, command)
    write_benchmark(results, plan.out)
    _show(results, plan.out, console)
    return results


def _claim(plan: Plan) -> None:
    """Write down what results in `out` depend on, or raise OutputExistsError where they depend on something else."""
    require_same_request(plan.out, plan.identity, PLAN_FILE, "benchmark")
    plan.out.mkdir(parents=True, exist_ok=True)
    with waiting_lock(plan.out / LOCK_FILE):  # another command may begin at the same moment
        require_same_request(plan.out, plan.identity, PLAN_FILE, "benchmark")
        write_json(plan.out / PLAN_FILE, plan.identity)


def _show(results: dict[str, Any], out: Path, console: Console) -> None:
    for table in rich_tables(results):
        console.print(table)
    for sentence in (*paired_lines(results), *interval_lines(results)):
        console.print(sentence, highlight=False, markup=False)
    for entry in results["missing"]:
        console.print(f"missing: {entry['job']}: {entry['reason']}", style="red", highlight=False, markup=False)
    console.print(f"report: {out / 'report.html'}", soft_wrap=True, highlight=False)
