"""What the parts of the GPU kit share: limits, result lines, time limits, the folder that Python imports from.

The standard library alone is used here, so that the runner works before anything is unpacked.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parents[2]
MIB = 1 << 20
TRAVELS_BYTES = 64 * MIB  # the tree's tracked files and one load, together
TREE_BYTES = 8 * MIB  # what is set aside for the tracked files, which grow
COMMAND_CHARACTERS = 2000
COMMAND_S = 600.0
FILES_BACK = 8
FILE_BACK_BYTES = 16 * MIB

LEFT_BEHIND = ("checkpoints",)  # tracked, large, and read by no part
PACKAGE = {"manicm_ms": ".", "tasks": "tasks", "assets": "assets"}  # folder of the tree -> place in the package
_PATIENCE_S = 5.0  # between asking a process to end and ending it, and after that


class Results:
    """A file of JSON lines, each on the disk as soon as it is known.

    Args:
        path: the file; processes may append to it in turn.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)

    def write(self, part: str, **values: Any) -> None:
        """Append a line and show it."""
        line = json.dumps({"part": part, **values})
        with self.path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")
            file.flush()
            os.fsync(file.fileno())
        print(line, flush=True)

    @staticmethod
    def read(path: Path) -> list[dict[str, Any]]:
        """Return the lines of a file, the last one only where it is whole."""
        found = []
        for line in path.read_text(encoding="utf-8").splitlines():
            with contextlib.suppress(json.JSONDecodeError):
                found.append(json.loads(line))
        return found


def run_limited(command: Sequence[str], limit_s: float, log: Path, env: Mapping[str, str], folder: Path) -> int | None:
    """Run a command in a process group of its own and leave nothing of it behind.

    Args:
        command: program and arguments.
        limit_s: seconds after which the whole group is ended.
        log: file that both of its streams are appended to.
        env: its environment.
        folder: where it runs; not in the tree, whose `manicm_ms` lacks its tasks and would be imported by `-m`.

    Returns:
        Its exit status, None where its time ran out. A process that hangs inside a driver, and that no signal ends,
        is waited for some seconds and then left.
    """
    with log.open("ab") as stream:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env=env,
            cwd=folder,
            start_new_session=True,
        )
    try:
        return process.wait(max(limit_s, 0.1))
    except subprocess.TimeoutExpired:
        _signal_group(process, signal.SIGTERM)
        return None
    finally:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)
        _signal_group(process, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_PATIENCE_S)


def _signal_group(process: subprocess.Popen[bytes], number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)


def last_line(log: Path) -> str:
    """Return the last line of a log that says something and is no result line, for the record of a failure."""
    lines = [line.strip() for line in log.read_text(encoding="utf-8", errors="replace").splitlines()]
    said = [line for line in lines if line and not line.startswith('{"part"')]
    return said[-1][:500] if said else ""


def make_site(site: Path, wheels: Path | None, tree: Path = REPO) -> Path:
    """Make the folder that Python imports the package and the unpacked wheels from, outside the tree.

    In the tree `tasks` and `assets` lie beside `manicm_ms`; installed they are `manicm_ms.tasks` and
    `manicm_ms.assets`. Here they are copied to where an installation would have put them.

    Args:
        site: the folder; what an earlier load left there stays.
        wheels: folder of wheels, which are unpacked over one another; None for none.
        tree: the repository.

    Returns:
        `site`, for PYTHONPATH.
    """
    shutil.rmtree(site / "manicm_ms", ignore_errors=True)
    for folder, place in PACKAGE.items():
        target = site / "manicm_ms" / place
        shutil.copytree(tree / folder, target, ignore=shutil.ignore_patterns("__pycache__"), dirs_exist_ok=True)
    for wheel in sorted(wheels.glob("*.whl")) if wheels is not None and wheels.is_dir() else []:
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(site)
    return site


def tracked_bytes(tree: Path = REPO) -> int:
    """Return the bytes of the tracked files that travel; raise CalledProcessError outside a git checkout."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=tree, capture_output=True, check=True).stdout
    names = [name for name in listed.decode().split("\0") if name]
    travelling = [tree / name for name in names if Path(name).parts[0] not in LEFT_BEHIND]
    return sum(path.stat().st_size for path in travelling if path.is_file())


def folder_bytes(path: Path) -> int:
    """Return the bytes of a file, or of all files of a folder."""
    if path.is_file():
        return path.stat().st_size
    return sum(p.stat().st_size for p in path.rglob("*") if p.is_file())


class Budget:
    """How much time a part has left.

    Args:
        seconds: from now on.
    """

    def __init__(self, seconds: float) -> None:
        self._end = time.monotonic() + seconds

    @property
    def left_s(self) -> float:
        """Seconds left, negative once it is over."""
        return self._end - time.monotonic()


def part_arguments(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add what the runner gives every part."""
    parser.add_argument("--out", type=Path, required=True, help="folder of results.jsonl and of what comes back")
    parser.add_argument("--work", type=Path, required=True, help="folder for what does not come back")
    parser.add_argument("--load", type=Path, required=True, help="folder of what was carried along")
    parser.add_argument("--budget", type=float, required=True, help="seconds")
    parser.add_argument("--smoke", action="store_true", help="tiny networks and few steps: shows that it runs")
    return parser


def results_of(out: Path) -> Results:
    """Return the result lines of a run whose files go to `out`."""
    return Results(out / "results.jsonl")


def last_error(error: BaseException) -> str:
    """Return one line that says what an exception says."""
    text = " ".join(str(error).split())
    return f"{type(error).__name__}: {text}"[:500]
