"""Files: packaged assets, atomic writing, free space, checksums, run folders."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

from manicm_ms.errors import ManicmError, NoSpaceError

_CHUNK_BYTES = 1 << 20


def asset(*parts: str) -> Path:
    """Return the path of a packaged asset, for example `asset("robots", "ur3e_ag95", "ur3e_ag95.urdf")`.

    Raises ManicmError naming the file where the installation lacks it.
    """
    path = Path(str(resources.files("manicm_ms.assets").joinpath(*parts)))
    if not path.exists():
        raise ManicmError(f"the installed package lacks the asset {'/'.join(parts)}: run 'make setup' again")
    return path


def require_free_space(folder: Path, need_bytes: int) -> None:
    """Raise NoSpaceError where the file system of `folder` has less than `need_bytes` bytes free."""
    probe = folder.absolute()
    while not probe.exists():
        probe = probe.parent
    free = shutil.disk_usage(probe).free
    if free < need_bytes:
        raise NoSpaceError(
            f"{folder} needs {need_bytes / 1e6:.0f} MB and its disk has {free / 1e6:.0f} MB free: "
            "free some space or choose a folder on another disk"
        )


def sha256(path: Path) -> str:
    """Return the hexadecimal SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as f:
        while block := f.read(_CHUNK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def write_text(path: Path, text: str) -> None:
    """Write a text file so that at every moment either the old or the new one is there, whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as f:
            f.write(text)
            f.flush()
            os.fsync(f.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


@contextmanager
def replaced_folder(path: Path) -> Iterator[Path]:
    """Yield a fresh folder beside `path` that takes its place when the block ends without an error.

    A kill at any moment leaves either the old folder or the new one, or, in the instant between two
    renames, the old one under `<path>.old`, which the next call brings back.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    old = path.with_name(path.name + ".old")
    if old.exists() and not path.exists():
        os.replace(old, path)
    fresh = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        yield fresh
        os.chmod(fresh, 0o755)
        if path.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.replace(path, old)
        os.replace(fresh, path)
        shutil.rmtree(old, ignore_errors=True)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
