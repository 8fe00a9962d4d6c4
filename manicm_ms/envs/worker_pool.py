"""Gymnasium's worker processes, started so that a signal at any moment leaves none of them behind."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import time
from collections.abc import Callable, Sequence
from multiprocessing import forkserver
from typing import Any, Final

import gymnasium
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.async_vector_env import _async_worker

from manicm_ms import signals

_START_METHOD: Final = "forkserver"  # fork hangs once a Vulkan or GL context exists in the parent
_CLOSE_S = 10.0  # how long workers may take to free their simulators
_PARENT_GONE = (EOFError, BrokenPipeError, ConnectionResetError)


class WorkerPool(AsyncVectorEnv):
    """One worker process a row, observations through shared memory, rows that never reset by themselves.

    Ctrl-C reaches this process alone; workers end when it asks them to, and by themselves once it has ended, however.

    Args:
        make_row: makes a row's environment in its worker, and one here, whose spaces are read.
        num_envs: rows.
        preload: modules that workers share; a missing one is no error.
    """

    def __init__(self, make_row: Callable[[], gymnasium.Env[Any, Any]], num_envs: int, preload: Sequence[str]) -> None:
        _start_server(preload)
        try:
            # An interrupt between two of these steps would leave semaphores that nobody knows.
            with contextlib.ExitStack() as self._hold:
                self._hold.enter_context(signals.held())
                super().__init__(
                    [make_row] * num_envs,
                    context=_START_METHOD,
                    autoreset_mode=AutoresetMode.DISABLED,
                    copy=False,
                    worker=_serve_row,
                )
        except BaseException:
            if hasattr(self, "error_queue"):
                self.close(terminate=True)
            raise

    def _check_spaces(self) -> None:
        """Wait for the workers, as `__init__` does in the end; all is made by now, and this may be interrupted."""
        self._hold.close()
        super()._check_spaces()

    def close_extras(self, timeout: float | None = None, terminate: bool = False) -> None:
        """Stop the workers; those that do not end in time, or all with `terminate`, are killed."""
        with signals.held():
            if not terminate:
                self._ask_to_close(_CLOSE_S if timeout is None else timeout)
            signals.end_processes([process for process in self.processes if process.is_alive()])
            for pipe in self.parent_pipes:
                if pipe is not None:
                    pipe.close()
            self.error_queue.close()

    def _ask_to_close(self, timeout: float) -> None:
        for pipe in self.parent_pipes:
            if pipe is not None and not pipe.closed:
                with contextlib.suppress(OSError):  # a worker that has ended
                    pipe.send(("close", None))
        until = time.monotonic() + timeout
        for process in self.processes:
            process.join(max(until - time.monotonic(), 0.0))


def _serve_row(*arguments: Any) -> None:
    """What a worker does: Gymnasium's own loop, with nothing to say when the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signals.end_with_parent()
    with contextlib.suppress(*_PARENT_GONE):
        _async_worker(*arguments)


def _start_server(preload: Sequence[str]) -> None:
    """Start the process that workers are forked from, where there is none yet, and wait until it has its imports.

    That takes seconds, in which an interrupt is welcome.
    """
    context = multiprocessing.get_context(_START_METHOD)
    context.set_forkserver_preload(list(preload))
    before = _server_pid()
    with signals.spared_children():
        forkserver.ensure_running()
    if _server_pid() != before:
        # The first child is forked when the imports are done; its start waits for that.
        context.Process(target=_nothing, daemon=True).start()


def _server_pid() -> int | None:
    return getattr(forkserver._forkserver, "_forkserver_pid", None)


def _nothing() -> None:
    """What the first child does."""
