"""Where the numbers of a training run go: JSON lines, TensorBoard, and a progress bar."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import Progress
from torch.utils.tensorboard import SummaryWriter

from manicm_ms.paths import write_text
from manicm_ms.progress import progress_bars


class RunLog:
    """Appends a line of numbers per logged step to `log.jsonl`, and the same to TensorBoard.

    Args:
        path: the JSON lines; TensorBoard's files go to `tensorboard/` beside it.
        step: steps done before; later lines, left by a process that was killed, are cut off.
    """

    def __init__(self, path: Path, step: int) -> None:
        self._keep_until(path, step)
        self._file = path.open("a", encoding="utf-8", buffering=1)
        self._board = SummaryWriter(str(path.with_name("tensorboard")), purge_step=step + 1 if step else None)

    @staticmethod
    def _keep_until(path: Path, step: int) -> None:
        kept = [line for line in read_log(path) if line["step"] <= step]
        write_text(path, "".join(json.dumps(line) + "\n" for line in kept))

    def write(self, step: int, **values: float) -> None:
        """Log `values` for `step` (steps done)."""
        self._file.write(json.dumps({"step": step, **values}) + "\n")
        for name, value in values.items():
            self._board.add_scalar(name, value, step)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        self._board.close()


def read_log(path: Path) -> list[dict[str, float]]:
    """Return the whole lines of a `log.jsonl`; a last line that a kill tore is left out."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]


class LossBar:
    """A progress bar that shows steps, time left and the latest loss."""

    def __init__(self, progress: Progress, title: str, total: int) -> None:
        self._progress = progress
        self._task = progress.add_task(title, total=total, loss="-")

    def update(self, step: int, loss: float | None = None) -> None:
        """Show that `step` steps are done."""
        shown: dict[str, Any] = {} if loss is None else {"loss": f"{loss:.4g}"}
        self._progress.update(self._task, completed=step, **shown)


@contextmanager
def loss_bar(console: Console | None, title: str, total: int) -> Iterator[LossBar]:
    """Yield a progress bar on `console`, or one that shows nothing where that is None."""
    with progress_bars(console, "loss {task.fields[loss]}") as shown:
        yield LossBar(shown, title, total)
