"""What all formats share: the registries, a store's episodes, checked, and an output that is whole or not there."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from manicm_ms.demos.layout import Episode
from manicm_ms.demos.remarks import empty_clouds, store_remarks
from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import ManicmError, NoSpaceError, OutputExistsError, StoreError
from manicm_ms.paths import is_disk_full, require_free_space, sync_tree, temporary_folder
from manicm_ms.progress import progress_of
from manicm_ms.registry import Registry

_PACKAGE = "manicm_ms.demos.convert"
SIDECAR = "manicm_ms.json"
"""Name of the file with env spec, provenance and seeds, in formats that have no place for them."""


@dataclass(frozen=True)
class Converted:
    """What a conversion came to.

    Attributes:
        path: the folder that was written.
        episodes: episodes in it.
        frames: control steps of all of them.
        notes: what a user should know about it, one sentence each.
    """

    path: Path
    episodes: int
    frames: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Export:
    """What a format is to write.

    Attributes:
        store: the demonstrations, at least one.
        folder: where to write: not there yet, in a temporary place beside `out`.
        out: what `folder` becomes once all is written; its name may serve as the data set's.
        task: the task in words.
    """

    store: DemoStore
    folder: Path
    out: Path
    task: str

    def episodes(self) -> Iterator[Episode]:
        """Yield the store's episodes in their order, with a progress bar.

        Raises StoreError where one cannot be read, or holds what only damage leaves.
        """
        numbers = range(len(self.store))
        for k in progress_of(numbers, f"convert {self.store.path.name}"):
            yield _sound(self.store, k)

    def about(self) -> dict[str, Any]:
        """Return JSON values: what the store says about itself."""
        return {
            "env_spec": self.store.spec.to_dict(),
            "provenance": self.store.provenance,
            "task": self.task,
            "seeds": self.store.seeds.tolist(),
            "success": self.store.successes.tolist(),
            "realism": {"names": list(self.store.realism_names), "values": self.store.realism.tolist()},
        }

    def require_space(self) -> None:
        """Raise NoSpaceError where the frames, uncompressed, do not fit on the disk."""
        episode = self.store.episode(0)
        values = [getattr(episode, name) for name in self.store.fields]
        a_frame = sum(value[0].nbytes for value in values)
        require_free_space(self.out, a_frame * self.store.num_frames)


@dataclass
class Tally:
    """What a format counts while it writes.

    Attributes:
        episodes: episodes written.
        frames: control steps written.
        notes: sentences for `Converted.notes`.
    """

    episodes: int = 0
    frames: int = 0
    notes: list[str] = field(default_factory=list)

    def add(self, episode: Episode) -> None:
        """Count an episode."""
        self.episodes += 1
        self.frames += len(episode)


Exporter = Callable[[Export], Tally]
"""Writes `Export.folder`; raises ManicmError where the format cannot hold the store or its library is not there."""

EXPORTERS: Registry[Exporter] = Registry("format to convert to", package=_PACKAGE)


class Importer(Protocol):
    """Reads another format into a store of ours."""

    def __call__(self, source: Path, folder: Path, **options: Any) -> Tally:
        """Write a store at `folder`, which is not there yet; `options` are the format's own."""
        ...


IMPORTERS: Registry[Importer] = Registry("format to convert from", package=_PACKAGE)


def convert(store: Path | str, to: str, out: Path | str, *, task: str | None = None) -> Converted:
    """Write the demonstrations of a store in another format.

    Args:
        store: path of a `DemoStore`.
        to: a name in `EXPORTERS`.
        out: folder to make; by its end all of it is there, or nothing.
        task: the task in words, for formats that carry instructions; by default made of the env id.

    Raises UnknownNameError for the format; StoreError where the store is missing, broken or empty;
    OutputExistsError, NoSpaceError; MissingDependencyError where the format's library is not installed.
    """
    export, out = EXPORTERS.get(to), Path(out)
    with DemoStore.open(store) as reader:
        if not len(reader):
            raise StoreError(
                f"{store} holds no episodes: collect some with 'manicm-ms collect {reader.spec.env_id} --out {store}'"
            )
        words = task or reader.spec.env_id.rpartition("/")[2].replace("-", " ")
        with fresh_folder(out) as folder:
            done = _something(export(Export(reader, folder, out, words)), out)
        remarks = store_remarks(reader)
    return Converted(out, done.episodes, done.frames, (*done.notes, *remarks))


def import_store(source: Path | str, format: str, out: Path | str, **options: Any) -> Converted:
    """Read demonstrations of another format into a new store of ours.

    Args:
        source: what to read.
        format: a name in `IMPORTERS`.
        out: the store to make.
        options: the format's own, see its importer.

    Raises UnknownNameError for the format, StoreError where `source` is missing, broken or empty, SpecMismatchError
    where it belongs to another environment, OutputExistsError, NoSpaceError.
    """
    read, out = IMPORTERS.get(format), Path(out)
    with fresh_folder(out) as folder:
        done = _something(read(Path(source), folder, **options), out)
    return Converted(out, done.episodes, done.frames, tuple(done.notes))


@contextmanager
def fresh_folder(out: Path) -> Iterator[Path]:
    """Yield a path, with nothing there, that becomes `out` when the block ends without an error.

    Raises OutputExistsError where something stands at `out`, before the block or by its end; NoSpaceError where
    the disk is full. Whatever goes wrong, or a kill, leaves `out` as it was.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise _taken(out)
    absent = [parent for parent in out.absolute().parents if not parent.exists()]
    try:
        with temporary_folder(out) as box:
            folder = box / out.absolute().name
            yield folder
            sync_tree(folder)
            _move(folder, out)
    except BaseException as error:  # Ctrl-C too
        for parent in absent:  # innermost first
            with suppress(OSError):
                parent.rmdir()
        if is_disk_full(error) and not isinstance(error, NoSpaceError):
            raise NoSpaceError(
                f"no space left for {out}: nothing was written; free some space and give the same command"
            ) from error
        raise


def _move(folder: Path, out: Path) -> None:
    try:
        os.rename(folder, out)  # refuses to replace anything but an empty folder
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
            raise _taken(out) from error
        raise


class MissingDependencyError(ManicmError):
    """A format whose library is not installed."""

    def __init__(self, format: str, library: str, remedy: str) -> None:
        super().__init__(f"converting to {format!r} needs {library}, which is not installed: {remedy}")


def _something(done: Tally, out: Path) -> Tally:
    """Return what was written; raise ManicmError where that is nothing, before it becomes `out`."""
    if not done.frames:
        raise ManicmError(f"no episode came out of the conversion: {out} was not written")
    return done


def _taken(out: Path) -> OutputExistsError:
    return OutputExistsError(f"{out} exists: choose another --out, or move it away")


def _sound(store: DemoStore, number: int) -> Episode:
    """Return an episode; raise StoreError where its numbers are not finite or a cloud is empty."""
    episode = store.episode(number)
    for name in store.fields:
        values = getattr(episode, name)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise _damaged(store, number, f"{name} holds NaN or infinity")
    if empty_clouds(episode.point_cloud).any():
        raise _damaged(store, number, "point_cloud has empty clouds, as a lost file leaves them")
    return episode


def _damaged(store: DemoStore, number: int, what: str) -> StoreError:
    return StoreError(
        f"{store.path} is damaged: {what} in episode {number}; 'manicm-ms inspect {store.path}' names all problems"
    )
