"""What happens at Ctrl-C, SIGTERM and SIGHUP: moments at which they wait, children that they pass by, quiet ends.

Python turns Ctrl-C into KeyboardInterrupt between any two instructions, and a terminal sends it to every process that
was started from it. So a program that starts others must say which of them answers, and where it must not be cut off.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from types import FrameType
from typing import Any

# multiprocessing is imported where it is used: it takes long, and a command should come to `quiet_start` at once.

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_AGAIN_S = 0.3  # between two looks whether an interrupt has arrived
_EXIT_S = 20.0  # how long the exit functions of a stopped program may take
_PATIENCE = 3  # so many signals of the user's are obeyed even in the middle of tidying up
_END_S = 5.0  # how long a child may take to end when asked, before it is killed


class Stopped(KeyboardInterrupt):
    """A signal that asks this program to stop.

    Attributes:
        status: the exit status that tells a shell so, 128 + the signal's number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.status = 128 + number


@contextlib.contextmanager
def held() -> Iterator[None]:
    """Let signals that stop a program wait until the block has ended; without effect outside of the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        waiting.append(number)

    # SIGINT is taken first and given back last: it is what could cut off the lines between.
    before = {int(number): signal.getsignal(number) for number in STOPPING}
    mine = [number for number, handler in before.items() if handler is not None]  # None: another language's
    try:
        for number in mine:
            signal.signal(number, note)
        yield
    finally:
        for number in reversed(mine):
            signal.signal(number, before[number])
        for number in dict.fromkeys(waiting):
            signal.raise_signal(number)


@contextlib.contextmanager
def spared_children() -> Iterator[None]:
    """Start processes in this block that Ctrl-C passes by: their parent ends them.

    They inherit a mask that blocks SIGINT; here it takes effect again, late by a moment, when the block ends.
    """
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # Python 3.11 lifts the mask after starting it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """End this process at once when the one that started it has ended, be it killed."""
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="parent's end", daemon=True).start()


def end_processes(processes: list[Any], patience_s: float = _END_S) -> None:
    """Ask processes to end, kill those that do not, and wait until all are gone."""
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(patience_s)
        if process.is_alive():
            process.kill()
            process.join()


# ---- programs -------------------------------------------------------------------------------------------------------

_program = False  # whether this process runs one of ours, so that signals are ours to answer


def quiet_start(command: str, module: str) -> None:
    """From here on, end with one word where a signal stops this process while it still imports what it needs.

    Does nothing unless the program that runs is `command`, or `python -m module`: a library must leave signals alone.
    Nor does it in a worker process, which imports the same modules under the same name.
    """
    global _program
    if _runs(command, module) and not _is_child():
        _program = True
        for number in _answered():
            signal.signal(number, _end_at_once)


def _runs(command: str, module: str) -> bool:
    if sys.argv[0] == "-m":  # so it stands while Python imports the packages of the module that it shall run
        return ("-m", module) in pairwise(sys.orig_argv)
    return os.path.basename(sys.argv[0]) == command


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Raise `Stopped` in the main thread at Ctrl-C, SIGTERM and SIGHUP while the block runs.

    Libraries lose such an interrupt now and then: they catch everything around an optional import, make an error of
    their own of it, or are destroying an object. So it is raised again until it arrives; but not into the tidying up
    that it has set off, unless the user insists. When the block of a program has ended, its work is done or given up:
    nothing interrupts the rest, which is short.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _answered()}
    hook = sys.unraisablehook
    asked = _Asked()
    sys.unraisablehook = lambda dropped: None if isinstance(dropped.exc_value, Stopped) else hook(dropped)
    try:
        for number in before:
            signal.signal(number, asked.answer)
        yield
    except Exception:
        if asked.number is not None:
            raise Stopped(asked.number) from None
        raise
    finally:
        with asked.over:
            asked.number = None
            for number, handler in before.items():
                signal.signal(number, signal.SIG_IGN if _program else handler)
        sys.unraisablehook = hook


class _Asked:
    """The signals that came in a `stoppable` block.

    Attributes:
        number: the first of them; None where there was none, and when the block is over.
        over: held while the block ends, so that no signal is sent after it.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.over = threading.Lock()
        self._count = 0
        self._mine = False

    def answer(self, number: int, frame: FrameType | None) -> None:
        """Raise `Stopped` where nothing is being tidied up because of it yet, or the user has asked often."""
        self._count += not self._mine
        self._mine = False
        if self.number is None:
            self.number = number
            threading.Thread(target=self._insist, args=(number,), daemon=True).start()
        if self._count >= _PATIENCE or not _tidying_up():
            raise Stopped(number)

    def _insist(self, number: int) -> None:
        """Send the signal again and again until the block is over; other handlers than ours are left in peace."""
        while True:
            time.sleep(_AGAIN_S)
            with self.over:
                if self.number is None:
                    return
                if signal.getsignal(number) == self.answer:
                    self._mine = True
                    os.kill(os.getpid(), number)


def _tidying_up() -> bool:
    """Return whether an interrupt, or an error that followed from one, is being handled in the main thread."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def end_stopped(status: int) -> None:
    """End a program that was stopped, and its child processes; where this process is no program of ours, return.

    Exit functions run, so that semaphores are given back. The interpreter is not taken apart: with the threads of
    simulators and drivers in the state that an interrupt left them in, that may never end.
    """
    if not _program:
        return
    import multiprocessing

    hang = threading.Timer(_EXIT_S, os._exit, (status,))
    hang.daemon = True
    hang.start()
    end_processes(multiprocessing.active_children())
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # a closed pipe
            stream.flush()
    atexit._run_exitfuncs()
    os._exit(status)


def _answered() -> list[int]:
    """Return the signals that stop this process; one that its starter made it ignore (nohup) stays ignored."""
    return [number for number in STOPPING if signal.getsignal(number) not in (signal.SIG_IGN, None)]


def _end_at_once(number: int, frame: FrameType | None) -> None:
    if not _is_child():  # one whose parent ends it, after an error say, has nothing to announce
        os.write(2, b"stopped\n")
    os._exit(128 + number)


def _is_child() -> bool:
    """Return whether this process was started by multiprocessing, or is being started: it has no parent there yet."""
    processes: Any = sys.modules.get("multiprocessing.process")
    if processes is None:
        return False
    return processes.parent_process() is not None or getattr(processes.current_process(), "_inheriting", False)
