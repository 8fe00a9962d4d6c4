"""Files: packaged assets, atomic writing, locks, free space, checksums."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

from manicm_ms.errors import ManicmError, NoSpaceError, OutputExistsError

_CHUNK_BYTES = 1 << 20
_TEMPORARY = ".tmp"  # last part of the names of temporaries
_RANDOM = "[a-z0-9_]{8}"  # the part before it
_FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


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


def require_free(out: Path, overwrite: bool) -> None:
    """Raise OutputExistsError unless the file `out` can be written: nothing stands there, or a file to be replaced."""
    if out.is_dir():
        raise OutputExistsError(f"{out} is a folder: name a file for --out, as in {out / f'NAME{out.suffix}'}")
    if out.exists() and not overwrite:
        raise OutputExistsError(f"{out} exists: choose another --out or add --overwrite")
    for parent in out.parents:
        if parent.exists() and not parent.is_dir():
            raise OutputExistsError(f"{parent} is a file, so that {out} cannot lie in it: choose another --out")


def without_temporaries(text: str) -> str:
    """Return `text` with each name of a temporary replaced by that of the file or folder which it was to become."""
    return re.sub(rf"(^|[/\s'\"])\.([^/]+?)\.{_RANDOM}{re.escape(_TEMPORARY)}", r"\1\2", text)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that at every moment either the old or the new one is there, whole; make its folder."""
    handle, fresh = _temporary(path, _new_file)
    try:
        with os.fdopen(handle, "wb") as f:
            f.write(content)
            f.flush()
            os.fsync(handle)
            os.chmod(fresh, 0o644)
            os.replace(fresh, path)  # before the file is closed, which ends its lock
    except BaseException:
        fresh.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write `value` as indented JSON, atomically."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


@contextmanager
def temporary_folder(path: Path) -> Iterator[Path]:
    """Yield a fresh folder beside `path`, to be renamed to it; one that was not is removed when the block ends."""
    handle, fresh = _temporary(path, _new_folder)
    try:
        fresh.chmod(0o755)
        yield fresh
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        os.close(handle)


def set_aside(path: Path) -> Path:
    """Return where `replaced_folder` keeps the old folder of `path` for the instant between its two renames."""
    # A hidden name: <path>.old is one that people give to backups of their own.
    return path.with_name(f".{path.name}.old")


@contextmanager
def replaced_folder(path: Path) -> Iterator[Path]:
    """Yield a fresh folder beside `path` that takes its place when the block ends without an error.

    A kill at any moment leaves either the old folder or the new one, or, in the instant between two
    renames, the old one under `set_aside(path)`, which the next call brings back. The new one is on the
    disk, not in the system's memory alone, before the old one is removed.
    """
    old = set_aside(path)
    if old.exists() and not path.exists():
        os.replace(old, path)
    with temporary_folder(path) as fresh:
        yield fresh
        sync_tree(fresh)
        if path.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.replace(path, old)
        os.replace(fresh, path)
        sync(path.parent)
        shutil.rmtree(old, ignore_errors=True)


def sync(path: Path) -> None:
    """Force a file, or the list of a folder's files, onto the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def is_disk_full(error: BaseException) -> bool:
    """Return whether `error` says that a disk, a quota or the largest size of a file is used up.

    Libraries that write through other languages give the reason as text alone.
    """
    return getattr(error, "errno", None) in _FULL_DISK or "No space left" in str(error)


def take_lock(path: Path, refuse: Callable[[str], ManicmError]) -> int:
    """Become the one holder of the lock file `path`, made if need be; `os.close` the returned handle to let go.

    The lock is the kernel's (flock): it goes with its holder, however that ends, and is never stale. The
    number in the file only serves the message.

    Args:
        path: the lock file.
        refuse: makes the error that is raised where another process has the lock, from its number.
    """
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.pread(handle, 32, 0).decode(errors="replace").strip() or "unknown"
        os.close(handle)
        raise refuse(holder) from None
    os.ftruncate(handle, 0)
    os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
    return handle


@contextmanager
def waiting_lock(path: Path) -> Iterator[None]:
    """Hold the lock file `path` within the block, after waiting for whoever has it; for work of moments."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


@contextmanager
def exclusive_lock(path: Path, refuse: Callable[[str], ManicmError]) -> Iterator[None]:
    """Hold the lock file `path` within the block; see `take_lock`."""
    handle = take_lock(path, refuse)
    try:
        yield
    finally:
        os.close(handle)


def _new_file(**names: Any) -> tuple[int, str]:
    return tempfile.mkstemp(**names)


def _new_folder(**names: Any) -> tuple[int, str]:
    name = tempfile.mkdtemp(**names)
    return os.open(name, os.O_RDONLY), name


def _temporary(path: Path, make: Callable[..., tuple[int, str]]) -> tuple[int, Path]:
    """Return a new temporary beside `path`, with a handle that holds its lock; remove those of killed processes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    parent = os.open(path.parent, os.O_RDONLY)
    try:
        # Makers share the parent's lock and sweepers have it alone, so that nobody sweeps between the making of a
        # temporary and its locking. A parent that is a temporary itself is shared by its maker: nothing to sweep there.
        if _flock(parent, fcntl.LOCK_EX | fcntl.LOCK_NB):
            _sweep(path)
        _flock(parent, fcntl.LOCK_SH)
        handle, name = make(dir=path.parent, prefix=f".{path.name}.", suffix=_TEMPORARY)
        _flock(handle, fcntl.LOCK_SH)
        return handle, Path(name)
    finally:
        os.close(parent)


def _sweep(path: Path) -> None:
    """Remove the temporaries of `path` that no process holds."""
    ours = re.compile(re.escape(f".{path.name}.") + _RANDOM + re.escape(_TEMPORARY))
    for stray in [p for p in path.parent.iterdir() if ours.fullmatch(p.name)]:
        try:
            handle = os.open(stray, os.O_RDONLY | os.O_NOFOLLOW)
        except OSError:  # another's, a link, or gone meanwhile
            continue
        try:
            if not _flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB):
                continue
            if stray.is_dir():
                shutil.rmtree(stray, ignore_errors=True)
            else:
                stray.unlink(missing_ok=True)
        finally:
            os.close(handle)


def _flock(handle: int, operation: int) -> bool:
    """Return whether the lock was had; a file system may have no locks, and then nothing is swept there."""
    try:
        fcntl.flock(handle, operation)
    except OSError:
        return False
    return True


def sync_tree(folder: Path) -> None:
    """Force all files of a folder, and the lists of its folders, onto the disk."""
    for root, _, files in os.walk(folder):
        for name in files:
            sync(Path(root, name))
        sync(Path(root))
