"""What happens at Ctrl-C, SIGTERM and SIGHUP: moments at which they wait, children that they pass by, quiet ends.

Python turns Ctrl-C into KeyboardInterrupt between any two instructions, and a terminal sends it to every process that
was started from it. So a program that starts others must say which of them answers, and where it must not be cut off.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any

STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_AGAIN_S = 0.05
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
    resource_tracker.ensure_running()  # Python 3.11 lifts the mask after starting it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_with_parent() -> None:
    """End this process at once when the one that started it has ended, be it killed."""
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
_asked: int | None = None  # the signal that last raised `Stopped`


def quiet_start(programs: tuple[str, ...]) -> None:
    """From here on, end with one word where a signal stops this process while it still imports what it needs.

    Does nothing unless the command that runs is one of `programs`: a library must leave signals alone.
    """
    global _program
    if os.path.basename(sys.argv[0]) in programs and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        _program = True
        for number in _answered():
            signal.signal(number, _end_at_once)


@contextlib.contextmanager
def stoppable() -> Iterator[None]:
    """Raise `Stopped` in the main thread at Ctrl-C, SIGTERM and SIGHUP while the block runs.

    An interrupt that Python drops, because it came while an object was being destroyed, comes again; one that a library
    made an error of its own (an import of compiled code does) is told from others. When the block of a program has
    ended, its work is done or given up: nothing interrupts the rest, which is short.
    """
    global _asked
    _asked = None
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in _answered()}
    hook = sys.unraisablehook
    sys.unraisablehook = _again(hook)
    try:
        for number in before:
            signal.signal(number, _raise)
        yield
    except Exception:
        if _asked is not None:
            raise Stopped(_asked) from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if _program else handler)
        sys.unraisablehook = hook


def settle() -> None:
    """End the child processes of a program that was stopped; elsewhere they are not ours to end."""
    if _program:
        end_processes(multiprocessing.active_children())


def _answered() -> list[int]:
    """Return the signals that stop this process; one that its starter made it ignore (nohup) stays ignored."""
    return [number for number in STOPPING if signal.getsignal(number) not in (signal.SIG_IGN, None)]


def _raise(number: int, frame: FrameType | None) -> None:
    global _asked
    _asked = number
    raise Stopped(number)


def _end_at_once(number: int, frame: FrameType | None) -> None:
    os.write(2, b"stopped\n")
    os._exit(128 + number)


def _again(hook: Any) -> Any:
    def see(dropped: Any) -> None:
        if isinstance(dropped.exc_value, Stopped):
            # A moment later: here, too, it would be dropped.
            later = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), dropped.exc_value.status - 128))
            later.daemon = True
            later.start()
        else:
            hook(dropped)

    return see
