"""An evaluation's folder: who owns it, and one line per finished episode that survives a kill at any moment."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from manicm_ms.errors import OutputExistsError
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.paths import exclusive_lock, require_free_space, write_json

RUN_FILE = "run.json"
"""What the folder holds: the request whose records lie in it."""
LOCK_FILE = ".lock"
_NEED_BYTES = 50_000_000
"""Records, videos and report of a hundred episodes stay well below this."""


@contextmanager
def claimed_folder(out: Path, request: Mapping[str, Any], kind: str = "evaluation") -> Iterator[Path]:
    """Yield `out`, locked for this process, where it is fresh or holds the records of the same `request`.

    Args:
        out: the folder; made where it does not exist.
        request: plain JSON values that fix the results; compared with those of an earlier call.
        kind: what a request is called in a message.

    Raises:
        OutputExistsError: a folder that holds something else, or that another process writes.
        NoSpaceError: too little room on its disk.
    """
    require_same_request(out, request, kind=kind)
    require_free_space(out, _NEED_BYTES)
    out.mkdir(parents=True, exist_ok=True)

    def refuse(holder: str) -> OutputExistsError:
        return OutputExistsError(f"{out} is being written by process {holder}: wait for it or choose another --out")

    with exclusive_lock(out / LOCK_FILE, refuse):
        require_same_request(out, request, kind=kind)
        write_json(out / RUN_FILE, dict(request))
        yield out


def require_same_request(out: Path, request: Mapping[str, Any], file: str = RUN_FILE, kind: str = "evaluation") -> None:
    """Raise OutputExistsError unless the folder `out` is fresh or its `file` holds the same request.

    Args:
        out: the folder; it need not exist.
        request: plain JSON values.
        file: name of the file in it that holds the request of what is there.
        kind: what a request is called in a message.
    """
    if not out.exists():
        return
    if not out.is_dir():
        raise OutputExistsError(f"{out} is a file: choose a folder for --out")
    run_file = out / file
    # Looked at before the file itself: another process may be writing it at this moment, and others only after it.
    others = [p.name for p in out.iterdir() if p.name != LOCK_FILE and not p.name.startswith(f".{file}.")]
    if not run_file.exists():
        if others:
            raise OutputExistsError(f"{out} holds other files and no {file}: choose another --out")
        return
    try:
        before = json.loads(run_file.read_text(encoding="utf-8"))
    except ValueError:
        raise OutputExistsError(f"{run_file} is not readable JSON: choose another --out") from None
    differing = [key for key in sorted(set(before) | set(request)) if before.get(key) != _plain(request.get(key))]
    if differing:
        key = differing[0]
        raise OutputExistsError(
            f"{out} already holds another {kind} ({', '.join(differing)} differ; {key} there: "
            f"{_short(before.get(key))}, asked: {_short(request.get(key))}): choose another --out or remove the folder"
        )


def _plain(value: Any) -> Any:
    return json.loads(json.dumps(value))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."


class EpisodeLog:
    """Finished episodes of one policy, one JSON line each, appended and synced to disk.

    A kill can leave a last line without its end; it is cut off when the log is opened again, and that
    episode is played again.

    Args:
        path: the JSON Lines file; made where it does not exist.

    Raises OutputExistsError where another line is damaged, which no kill does; the file is left as it is.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._results: dict[int, EpisodeResult] = {}
        text = path.read_bytes() if path.exists() else b""
        whole = text[: text.rfind(b"\n") + 1]
        for number, line in enumerate(whole.splitlines(), start=1):
            result = self._parsed(line, number)
            self._results[result.seed] = result
        self._file = path.open("ab")
        self._file.truncate(len(whole))

    def _parsed(self, line: bytes, number: int) -> EpisodeResult:
        try:
            return EpisodeResult.from_record(json.loads(line))
        except (ValueError, KeyError, TypeError) as error:
            raise OutputExistsError(
                f"line {number} of {self.path} is damaged: delete this line and its episode is played again, "
                "or choose another --out"
            ) from error

    def __getitem__(self, seed: int) -> EpisodeResult:
        return self._results[seed]

    def __contains__(self, seed: int) -> bool:
        return seed in self._results

    def __len__(self) -> int:
        return len(self._results)

    def append(self, result: EpisodeResult) -> None:
        """Add a finished episode; when the call returns it is on disk."""
        line = json.dumps(result.to_record(), allow_nan=False) + "\n"
        self._file.write(line.encode("utf-8"))
        self._file.flush()
        os.fsync(self._file.fileno())
        self._results[result.seed] = result

    def close(self) -> None:
        """Close the file; twice is fine."""
        self._file.close()

    def __enter__(self) -> EpisodeLog:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
