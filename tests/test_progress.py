"""Work that is written to a file says every half minute where it is; on a terminal it shows bars."""

import ast
import io
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console
from rich.progress import Progress, TextColumn

from manicm_ms.progress import PERIOD_S, LineProgress, progress_bars, progress_of, working


@pytest.fixture
def written():
    """A progress display for a file, its clock, which stands until it is set, and what was written."""
    file, clock = io.StringIO(), SimpleNamespace(now=100.0)
    columns = [TextColumn("{task.completed}/{task.total}"), TextColumn("loss {task.fields[loss]:.2f}")]
    shown = LineProgress(columns, Console(file=file), clock=lambda: clock.now)
    return SimpleNamespace(shown=shown, clock=clock, lines=lambda: file.getvalue().splitlines())


def test_a_line_is_written_once_in_half_a_minute(written):
    with written.shown as shown:
        bar = shown.add_task("train teacher", total=400, loss=1.0)
        for second in range(95):
            written.clock.now = 100.0 + second
            shown.update(bar, completed=2 * second, loss=0.5)
            shown.tick()
            shown.tick()
        assert PERIOD_S == 30
        assert [line.split("  ")[:4] for line in written.lines()] == [
            ["train teacher", f"{2 * seconds}/400", "loss 0.50", f"0:00:{seconds}" + " passed"]
            if seconds < 60
            else ["train teacher", f"{2 * seconds}/400", "loss 0.50", f"0:01:{seconds - 60:02d} passed"]
            for seconds in (30, 60, 90)
        ]
        assert written.lines()[2].endswith("  0:01:50 left")  # 220 steps at two a second


def test_work_that_reports_nothing_is_written_of_too(written):
    with written.shown as shown:
        shown.add_task("jobs", total=3, loss=0.0)
        written.clock.now += 31
        shown.tick()  # as the watch does
        assert written.lines() == ["jobs  0/3  loss 0.00  0:00:31 passed"]


def test_short_work_writes_one_line_a_task_when_it_ends(written):
    with written.shown as shown:
        for name in ("teacher", "student"):
            bar = shown.add_task(name, total=2, loss=0.0)
            shown.advance(bar, 2)
            shown.tick()
        assert written.lines() == []
    assert [line.split("  ")[:2] for line in written.lines()] == [["teacher", "2/2"], ["student", "2/2"]]


def test_a_finished_task_is_told_once(written):
    with written.shown as shown:
        shown.update(shown.add_task("teacher", total=2, loss=0.0), completed=2)
        shown.add_task("student", total=2, loss=0.0)
        for _ in range(2):
            written.clock.now += 30
            shown.tick()
    names = [line.split("  ")[0] for line in written.lines()]
    assert names == ["teacher", "student", "student"], "one that got nowhere is not told at the end"


def test_the_watch_writes_by_itself():
    """With the real clock and a short period: who calls nothing for long is written of."""
    file = io.StringIO()
    with LineProgress([], Console(file=file), period=0.0) as shown:
        shown.add_task("collect", total=5)
        until = time.monotonic() + 20
        while not file.getvalue() and time.monotonic() < until:
            time.sleep(0.01)
        assert file.getvalue().startswith("collect  0:00:")


def test_terminals_get_bars_and_none_shows_nothing():
    terminal, file = Console(file=io.StringIO(), force_terminal=True), io.StringIO()
    assert type(progress_bars(terminal)) is Progress
    assert isinstance(progress_bars(Console(file=file)), LineProgress)
    with progress_bars(None) as shown:
        shown.add_task("quiet", total=1)


def test_work_without_a_count_is_told_while_it_lasts():
    file, clock = io.StringIO(), SimpleNamespace(now=0.0)
    with LineProgress([TextColumn("never")], Console(file=file), clock=lambda: clock.now) as shown:
        shown.add_task("time the decisions", total=None)
        clock.now = 30.0
        shown.tick()
    assert file.getvalue() == "time the decisions  0:00:30 passed\n"
    with working(Console(file=file), "short work"), working(None, "quiet work"):
        pass
    assert "work" not in file.getvalue()
    screen = Console(file=io.StringIO(), force_terminal=True, width=80)
    with working(screen, "time the decisions"):
        pass
    assert "time the decisions" in screen.file.getvalue()


def test_items_pass_through_and_are_counted():
    file = io.StringIO()
    assert list(progress_of("abc", "convert reach.zarr", Console(file=file))) == ["a", "b", "c"]
    assert file.getvalue().startswith("convert reach.zarr  3/3  0:00:0")


def test_no_module_shows_progress_in_a_way_of_its_own():
    """A bar of rich's own, or its spinner, would be silent in a file."""
    package = Path(__file__).resolve().parents[1] / "manicm_ms"
    for path in set(package.rglob("*.py")) - {package / "progress.py"}:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "rich.progress":
                assert [name.name for name in node.names] == ["Progress"], f"{path}: for type hints alone"
        assert " Progress(" not in path.read_text(), path
        assert "console.status(" not in path.read_text(), path
