"""Runs the jobs of a plan in processes of this machine; others, started by the same command, may take part at any time.

A job is claimed by a lock that the kernel releases however its holder ends, so a killed process blocks nothing: what it
had finished is on disk and another one goes on from there.
"""

from __future__ import annotations

import contextlib
import json
import logging
import multiprocessing
import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rich.console import Console

from manicm_ms import signals
from manicm_ms.benchmark.jobs import Job, all_jobs
from manicm_ms.benchmark.plan import Plan
from manicm_ms.errors import ManicmError
from manicm_ms.paths import exclusive_lock, write_json

DONE, FAILED, BLOCKED, BUSY = "done", "failed", "blocked", "busy"
_POLL_S = 1.0
_MOST_TRIES = 3  # of a job whose process is killed or crashes
_STOP_S = 30.0  # a training needs some seconds to finish its step and save


class _TakenError(ManicmError):
    """Another process works on the job."""


def attempt(job: Job, console: Console, place: str | None = None, started: float = 0.0) -> str:
    """Do a job whose needs are done, unless another process is at it.

    Args:
        job: the job.
        console: where progress goes.
        place: who does it, for the record; by default this machine and process.
        started: time since which processes that died at the job are counted; a crash would take one after the other.

    Returns:
        `DONE`, `FAILED` (its failure file says why) or `BUSY`.
    """
    job.stem.parent.mkdir(parents=True, exist_ok=True)
    try:
        with exclusive_lock(job.lock_file, lambda holder: _TakenError(holder)):
            return _attempt_alone(job, console, place or f"{socket.gethostname()}, process {os.getpid()}", started)
    except _TakenError:
        return BUSY


def _attempt_alone(job: Job, console: Console, place: str, started: float) -> str:
    """Do a job that nobody else can be at."""
    if job.is_done():
        return DONE
    tries = 1 + _deaths(job, started)
    if tries > _MOST_TRIES:
        job.begun_file.unlink()  # the next run tries again
        return _fail(job, console, f"{tries - 1} processes in a row died at it")
    write_json(job.begun_file, {"tries": tries, "place": place})
    console.print(f"{job.name}: begun", highlight=False)
    try:
        job.complete(console, place)
    except Exception as error:  # one job's trouble, of whatever kind, must not cost the others
        if not isinstance(error, ManicmError):
            console.print_exception()
        fate = _fail(job, console, str(error) if isinstance(error, ManicmError) else f"{type(error).__name__}: {error}")
    else:
        fate = DONE
    finally:
        job.begun_file.unlink(missing_ok=True)
    return fate


def _deaths(job: Job, started: float) -> int:
    """Return how many processes have died at a job, one after the other, since a time."""
    try:
        if job.begun_file.stat().st_mtime < started:
            return 0
        return int(json.loads(job.begun_file.read_text(encoding="utf-8"))["tries"])
    except FileNotFoundError:
        return 0


def _fail(job: Job, console: Console, reason: str) -> str:
    console.print(f"{job.name}: {reason}", style="red", markup=False, highlight=False)
    write_json(job.failure_file, {"job": job.name, "reason": reason, "pid": os.getpid()})
    return FAILED


def work_off(plan: Plan, console: Console) -> dict[str, str]:
    """Do jobs of the plan until each is done, failed or blocked by one that failed, here or in another process.

    Returns:
        job -> `DONE`, `FAILED` or `BLOCKED`.
    """
    started = time.time()
    jobs = all_jobs(plan)
    fates: dict[str, str] = {}
    while len(fates) < len(jobs):
        progressed = False
        for job in jobs:
            if job.name in fates:
                continue
            fate = _fate(job, fates, started)
            if fate is not None:
                fates[job.name], progressed = fate, True
            elif (
                all(fates.get(need.name) == DONE for need in job.needs)
                and (tried := attempt(job, console, started=started)) != BUSY
            ):
                fates[job.name], progressed = tried, True
                break  # from the beginning: others may have got something done meanwhile
        if not progressed:
            time.sleep(_POLL_S)
    return fates


def _fate(job: Job, fates: dict[str, str], started: float) -> str | None:
    """Return what has become of a job without working on it, or None where it is still open."""
    if job.is_done():
        return DONE
    if any(fates.get(need.name) in (FAILED, BLOCKED) for need in job.needs):
        return BLOCKED
    # A failure of before this run is tried again; one since then, by whatever process, is not.
    with contextlib.suppress(FileNotFoundError):
        if job.failure_file.stat().st_mtime >= started:
            return FAILED
    return None


def run_in_processes(plan: Plan, processes: int, report: Callable[[Sequence[Job]], None]) -> list[str]:
    """Work the plan off in `processes` processes, each with a log in out/logs; return when all of them have ended.

    Args:
        plan: the grid.
        processes: how many.
        report: called every second with the jobs that are done.

    Returns:
        a line for each process that ended before its work was done.

    Raises KeyboardInterrupt after the processes were told to save and stop.
    """
    context = multiprocessing.get_context("spawn")
    logs = plan.out / "logs"
    logs.mkdir(parents=True, exist_ok=True)
    files = [logs / f"{os.getpid()}-{k}.log" for k in range(processes)]
    workers = [context.Process(target=_worker, args=(plan.to_json(), str(file)), daemon=False) for file in files]
    jobs = all_jobs(plan)
    try:
        with signals.spared_children():  # Ctrl-C reaches this process alone, which passes it on once
            for worker in workers:
                worker.start()
        while any(worker.is_alive() for worker in workers):
            report([job for job in jobs if job.is_done()])
            workers[0].join(_POLL_S)
            if not workers[0].is_alive():
                time.sleep(_POLL_S / 10)
        report([job for job in jobs if job.is_done()])
    except KeyboardInterrupt:
        _stop(workers)
        raise
    return [
        f"a process ended with exit code {worker.exitcode}, see {file}"
        for worker, file in zip(workers, files, strict=True)
        if worker.exitcode
    ]


def _stop(workers: Sequence[multiprocessing.process.BaseProcess]) -> None:
    """Ask the workers to save and end, and insist after a while."""
    started = [worker for worker in workers if worker.pid]
    for worker in started:
        if worker.is_alive() and worker.pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.pid, signal.SIGINT)
    until = time.monotonic() + _STOP_S
    for worker in started:
        worker.join(max(until - time.monotonic(), 0.1))
        if worker.is_alive():
            worker.kill()


def _worker(plan_json: str, log: str) -> None:
    """What a process does."""
    # A session of its own: a training saves at the first interrupt and would be cut off by a second from the terminal.
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    _end_with_parent()
    with contextlib.suppress(KeyboardInterrupt), signals.stoppable():
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # its start was spared; what came since, comes now
        with _console(Path(log)) as console:
            work_off(Plan.from_json(plan_json), console)


@contextlib.contextmanager
def _console(log: Path) -> Iterator[Console]:
    """Yield a console that writes to a file, and send what libraries print there too."""
    logging.basicConfig(filename=log, level=logging.WARNING, force=True)
    with (
        log.open("a", encoding="utf-8", buffering=1) as file,
        contextlib.redirect_stdout(file),
        contextlib.redirect_stderr(file),
    ):
        yield Console(file=file, width=120)


def _end_with_parent() -> None:
    """Interrupt this process when the one that started it ends, be it killed: nobody would stop it then.

    One that does not end in time is ended as it is: what it had finished is on disk.
    """
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(_STOP_S)
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
