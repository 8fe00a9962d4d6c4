"""How long work shows that it goes on: bars on a terminal, and a line every half minute in a file or a pipe."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

PERIOD_S = 30.0
"""Seconds between two lines of work whose output is no terminal."""
_LOOK_S = 0.5  # between two looks at the clock

T = TypeVar("T")


def progress_bars(console: Console | None, *notes: str) -> Progress:
    """Return what shows work on `console`: description, bar, count, notes, time passed and time left.

    Args:
        console: where; None shows nothing.
        notes: formats of rich's `TextColumn`, as in "loss {task.fields[loss]:.4g}", shown behind the count.
    """
    told: list[ProgressColumn] = [_Count(), *map(TextColumn, notes)]
    if console is None:
        return Progress(*told, disable=True)
    if not (console.is_terminal or console.is_jupyter):
        return LineProgress(told, console)
    times = (TimeElapsedColumn(), TimeRemainingColumn(compact=True), TextColumn("left"))
    return Progress(TextColumn("{task.description}"), BarColumn(), *told, *times, console=console)


def progress_of(items: Sequence[T], description: str, console: Console | None = None) -> Iterator[T]:
    """Yield `items`, showing how many are done; by default on standard output."""
    with progress_bars(console or Console()) as shown:
        yield from shown.track(items, description=description, total=len(items))


@contextmanager
def working(console: Console | None, description: str) -> Iterator[None]:
    """Show on `console` that work without a count goes on; nothing is left of it on a terminal, nor of short work.

    Args:
        console: where; None shows nothing.
        description: of the work.
    """
    if console is not None and (console.is_terminal or console.is_jupyter):
        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        shown = Progress(*columns, console=console, transient=True, refresh_per_second=1)
    else:
        shown = progress_bars(console)
    with shown:
        shown.add_task(description, total=None)
        yield


class _Count(MofNCompleteColumn):
    """How many of how many, and where that is unknown, how many."""

    def render(self, task: Task) -> Text:
        return Text(f"{task.completed:.0f}") if task.total is None else super().render(task)


class LineProgress(Progress):
    """Writes where its unfinished tasks are, a line each, once in a period, and what is finished when it ends.

    Args:
        told: columns of a line between the description and the times.
        console: where the lines go.
        clock: tells the time, seconds; also that of the tasks.
        period: seconds between two lines of a task.
    """

    def __init__(
        self,
        told: Iterable[ProgressColumn],
        console: Console,
        clock: Callable[[], float] = time.monotonic,
        period: float = PERIOD_S,
    ) -> None:
        super().__init__(console=console, get_time=clock, disable=True)  # rich draws nothing
        self._told = tuple(told)
        self._period, self._next = period, clock() + period
        self._finished: set[TaskID] = set()
        self._ended = threading.Event()
        self._watch: threading.Thread | None = None

    def start(self) -> None:
        """Begin to watch the clock: work that reports nothing for long is written of all the same."""
        self._ended.clear()
        self._next = self.get_time() + self._period
        self._watch = threading.Thread(target=self._look, name="progress", daemon=True)
        self._watch.start()

    def stop(self) -> None:
        """Write the last state of every counted task that got somewhere, unless it has been told to be finished."""
        if self._watch is None:
            return
        self._ended.set()
        self._watch.join()
        self._watch = None
        self._write(ending=True)

    def tick(self) -> None:
        """Write the lines if it is time to."""
        with self._lock:
            now = self.get_time()
            if now < self._next:
                return
            self._next = now + self._period
            self._write()

    def _look(self) -> None:
        while not self._ended.wait(_LOOK_S):
            self.tick()

    def _write(self, ending: bool = False) -> None:
        for task in self.tasks:
            if not task.visible or task.id in self._finished:
                continue
            if not ending or (task.total is not None and task.completed):
                self.console.print(self._line(task), markup=False, highlight=False, soft_wrap=True)
                if task.finished:
                    self._finished.add(task.id)

    def _line(self, task: Task) -> str:
        told = self._told if task.total is not None or task.completed else ()  # of what is not counted, nothing
        parts = [task.description, *(str(column(task)).strip() for column in told)]
        parts.append(f"{_clock_face(task.elapsed or 0)} passed")
        if not task.finished and task.time_remaining is not None:
            parts.append(f"{_clock_face(task.time_remaining)} left")
        return "  ".join(part for part in parts if part)


def _clock_face(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))
