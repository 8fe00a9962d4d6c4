"""The lock of a store's one writer, which the system releases when the writer's process ends, however it ends."""

from __future__ import annotations

import os
from pathlib import Path

from manicm_ms.demos.zarr_files import EPISODE_ENDS
from manicm_ms.errors import StoreError
from manicm_ms.paths import take_lock

_LOCK = f"{EPISODE_ENDS}/.lock"  # within an array: zarr warns of strange files in groups
_FORMER_LOCK = ".lock"


def acquire(path: Path) -> int:
    """Become the one writer of the store at `path`; return what `release` takes.

    The lock file of earlier versions is heeded too, and removed. Raises StoreError naming the process that already is.
    """
    if (path / _FORMER_LOCK).exists():
        release(_take(path, _FORMER_LOCK))
        (path / _FORMER_LOCK).unlink(missing_ok=True)
    return _take(path, _LOCK)


def release(lock: int | None) -> None:
    """Let others write; None is no lock."""
    if lock is not None:
        os.close(lock)


def _take(path: Path, name: str) -> int:
    def refuse(holder: str) -> StoreError:
        return StoreError(f"{path} is being written by process {holder}: wait for it to end or stop it, then try again")

    try:
        return take_lock(path / name, refuse)
    except OSError as e:
        raise StoreError(f"cannot write to {path} ({e.strerror}): check its permissions") from e
