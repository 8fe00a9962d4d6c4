"""Runs the jobs of a plan on a Ray cluster (extra `ray`): the same jobs, each a task that waits for those it needs.

Every node needs this package installed and the plan's folders at the same path, on a shared file system.
"""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from rich.console import Console

from manicm_ms.benchmark.jobs import Job, all_jobs
from manicm_ms.benchmark.plan import Plan
from manicm_ms.benchmark.pool import BLOCKED, BUSY, DONE, FAILED, attempt
from manicm_ms.errors import BackendError
from manicm_ms.paths import write_json

_RETRIES = 3  # of a job whose node went away
_POLL_S = 1.0
_ANSWER_S = 5.0


def run_on_ray(plan: Plan, address: str, report: Callable[[Sequence[Job]], None]) -> dict[str, str]:
    """Work the plan off on the cluster at `address`; "auto" is the one that this machine belongs to.

    Args:
        plan: the grid.
        address: as `ray.init` takes it; "local" starts one on this machine.
        report: called every second with the jobs that are done.

    Returns:
        job -> "done", "failed" or "blocked".

    Raises BackendError where Ray is missing or no cluster answers.
    """
    ray = _ray()
    if not ray.is_initialized():
        _require_answer(address)
        try:
            ray.init(address=address, log_to_driver=False, include_dashboard=False if address == "local" else None)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise _no_cluster(address, str(error).splitlines()[0]) from error
    jobs, text, started = all_jobs(plan), plan.to_json(), time.time()
    remote = ray.remote(num_cpus=1, max_retries=_RETRIES)(_job_on_a_node)
    running: dict[str, Any] = {}
    for job in jobs:  # in an order in which needs come first
        running[job.name] = remote.remote(text, job.name, started, *(running[need.name] for need in job.needs))
    waiting = list(running.values())
    try:
        while waiting:
            _, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=_POLL_S, fetch_local=False)
            report([job for job in jobs if job.is_done()])
        return {job.name: _fate(ray, job, running[job.name]) for job in jobs}
    except KeyboardInterrupt:
        for reference in waiting:
            ray.cancel(reference)
        raise


def _require_answer(address: str) -> None:
    """Raise BackendError where nobody listens at HOST:PORT, which Ray would wait minutes for."""
    host, _, port = address.partition(":")
    if not port.isdecimal():
        return
    try:
        socket.create_connection((host, int(port)), _ANSWER_S).close()
    except OSError as error:
        raise _no_cluster(address, str(error)) from error


def _no_cluster(address: str, reason: str) -> BackendError:
    return BackendError(
        f"no Ray cluster answers at {address!r} ({reason}): start one with 'ray start --head', or use --ray local"
    )


def _fate(ray: Any, job: Job, reference: Any) -> str:
    """Return what became of a job, and write down why where Ray itself could not have it done."""
    try:
        return str(ray.get(reference))
    except ray.exceptions.RayError as error:  # its node went away too often, or could not start it at all
        lines = str(error).strip().splitlines() or [type(error).__name__]
        write_json(job.failure_file, {"job": job.name, "reason": f"on Ray: {lines[-1].strip()}"})
        return FAILED


def _job_on_a_node(plan_json: str, name: str, started: float, *fates_of_needs: str) -> str:
    """What a Ray task does."""
    plan = Plan.from_json(plan_json)
    job = next(job for job in all_jobs(plan) if job.name == name)
    if job.is_done():
        return DONE
    if any(fate != DONE for fate in fates_of_needs):
        return BLOCKED
    node = f"Ray node {_ray().get_runtime_context().get_node_id()}"
    while (fate := attempt(job, Console(file=sys.stderr, width=120), node, started)) == BUSY:
        time.sleep(_POLL_S)  # another command is at it: what it does counts here too
    return fate


def _ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise BackendError("--ray needs Ray: pip install 'manicm_ms[ray]', or leave it out") from error
    return ray
