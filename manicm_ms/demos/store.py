"""DemoStore: demonstrations on disk, read and, with one writer at a time, extended; `layout` says what lies where."""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np

from manicm_ms.demos import store_lock
from manicm_ms.demos.layout import (
    FRAME_ARRAYS,
    OPTIONAL_FIELDS,
    Episode,
    checked_frames,
    checked_realism,
    frame_shapes,
    read_attrs,
    write_empty,
)
from manicm_ms.demos.store_arrays import StoreArrays
from manicm_ms.demos.zarr_files import ALL_WRITTEN, require_folder
from manicm_ms.errors import ManicmError, NoSpaceError, OutputExistsError, StoreError
from manicm_ms.paths import is_disk_full, require_free_space, temporary_folder, write_json
from manicm_ms.spec import EnvSpec

_SPARE_BYTES = 32 << 20  # kept free beside what an append needs, so that the commit itself finds room


class DemoStore:
    """Reads and, with one writer at a time, grows a store of demonstrations.

    Use `create` or `open`, and `close` it or use it as a context manager: an open writer holds the
    store's lock, which the system releases when its process ends, however it ends.
    """

    def __init__(self, path: Path, mode: Literal["r", "a"], lock: int | None) -> None:
        self.path, self.mode, self._lock = path, mode, lock
        self._attrs = read_attrs(path)
        self.spec = EnvSpec.from_dict(self._attrs["env_spec"])
        self._arrays = StoreArrays(path, "r" if mode == "r" else "r+")
        self.realism_names = self._arrays.realism_names
        self._arrays.check_layout(self.spec)
        self.missing_files = self._arrays.missing_files(all_written=ALL_WRITTEN.items() <= self._attrs.items())
        self._dirty = mode == "a"
        self._cut()

    @classmethod
    def create(
        cls,
        path: Path | str,
        spec: EnvSpec,
        provenance: Mapping[str, Any],
        *,
        extras: Iterable[str] = (),
        realism: Iterable[str] = (),
    ) -> DemoStore:
        """Make an empty store and return it open for appending.

        Args:
            path: folder to make; by custom it ends in `.zarr`.
            spec: of the environment that the demonstrations come from.
            provenance: JSON values that say how the data came about (expert, style, versions, command).
            extras: optional fields of `Episode` to store too, from `OPTIONAL_FIELDS`.
            realism: names of the values that every episode's `realism` will hold.

        Raises OutputExistsError where something stands at `path`, NoSpaceError on a full disk.
        """
        path, extras, realism = Path(path), tuple(extras), tuple(realism)
        if unknown := set(extras) - set(OPTIONAL_FIELDS):
            raise StoreError(f"a store has no optional field {sorted(unknown)}: choose from {OPTIONAL_FIELDS}")
        require_free_space(path, _SPARE_BYTES)
        with temporary_folder(path) as fresh:
            write_empty(fresh, spec, dict(provenance), extras, realism)
            try:
                os.rename(fresh, path)  # refuses to replace anything but an empty folder
            except OSError as e:
                if e.errno in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                    raise OutputExistsError(f"{path} exists: open it to append, or choose another path") from e
                raise
        return cls.open(path, "a")

    @classmethod
    def open(cls, path: Path | str, mode: Literal["r", "a"] = "r") -> DemoStore:
        """Open a store to read it ("r") or to append to it too ("a").

        Raises StoreError where there is no store, it is damaged or lacks files, or another process has it open for
        appending.
        """
        path = Path(path)
        require_folder(path, f"make one with 'manicm-ms collect ENV --out {path}'")
        lock = None
        try:
            if mode == "a":
                read_attrs(path)  # what is no store of ours stays untouched, by a lock too
                lock = store_lock.acquire(path)
            return cls(path, mode, lock)
        except ManicmError:
            store_lock.release(lock)
            raise
        except Exception as e:  # zarr and json raise many kinds on damaged files
            store_lock.release(lock)
            raise StoreError(f"{path} is damaged ({e}): 'manicm-ms inspect {path}' names what is wrong") from e

    def __len__(self) -> int:
        return len(self.episode_ends)

    def __enter__(self) -> DemoStore:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Release the writer's lock; closing twice is fine."""
        store_lock.release(self._lock)
        self._lock, self.mode = None, "r"

    @property
    def provenance(self) -> dict[str, Any]:
        """How the data came about, as given to `create`."""
        return dict(self._attrs["provenance"])

    @property
    def attempts(self) -> int:
        """Episodes that were tried to get those that are kept, as far as the collector has noted."""
        return int(self._attrs["attempts"])

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields of `Episode` that this store holds frames of."""
        return self._arrays.fields

    @property
    def episode_ends(self) -> np.ndarray:
        """(E,) int64, one past the last frame of each committed episode."""
        return self._arrays.ends()

    @property
    def num_frames(self) -> int:
        """F, committed frames."""
        return self._arrays.num_frames()

    @property
    def seeds(self) -> np.ndarray:
        """(E,) int64, the seed of each episode."""
        return self._meta("seed")

    @property
    def successes(self) -> np.ndarray:
        """(E,) bool."""
        return self._meta("success")

    @property
    def realism(self) -> np.ndarray:
        """(E, K) float64: the values of `realism_names` that were drawn for each episode; K is 0 where none were."""
        return self._meta("realism") if self.realism_names else np.zeros((len(self), 0))

    @property
    def lengths(self) -> np.ndarray:
        """(E,) int64, control steps of each episode."""
        return np.diff(self.episode_ends, prepend=0)

    @property
    def point_cloud(self) -> np.ndarray:
        """(F, P, C) float32, read into memory at each access."""
        return self.frames("point_cloud")

    @property
    def state(self) -> np.ndarray:
        """(F, D) float32: agent_pos, under the name it has on disk; read into memory at each access."""
        return self.frames("agent_pos")

    @property
    def action(self) -> np.ndarray:
        """(F, Da) float32, read into memory at each access."""
        return self.frames("action")

    def frames(self, field: str, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return the committed frames [start, stop) of a field of `Episode`; all of them by default."""
        last = self.num_frames
        return self._read(field, lambda array: array[start : last if stop is None else min(stop, last)])

    def frames_at(self, field: str, numbers: np.ndarray) -> np.ndarray:
        """Return the committed frames with these numbers, growing (K,) int64; reads the chunks that they lie in."""
        return self._read(field, lambda array: array.oindex[numbers])

    def frame_bytes(self, field: str) -> int:
        """Return the bytes of one frame of a field of `Episode`, in memory."""
        shape, dtype = frame_shapes(self.spec)[field]
        return math.prod(shape) * dtype.itemsize

    def _read(self, field: str, take: Callable[[Any], Any]) -> np.ndarray:
        if field not in self.fields:
            raise StoreError(f"{self.path} holds no {field}: it holds {', '.join(self.fields)}")
        try:
            return np.asarray(take(self._arrays.frames(field)))
        except (OSError, RuntimeError, ValueError) as e:  # what the codecs raise on a damaged chunk
            raise StoreError(
                f"{self.path} is damaged: data/{FRAME_ARRAYS[field]} cannot be read ({e}); "
                f"'manicm-ms inspect {self.path}' names what is wrong"
            ) from e

    def episode(self, index: int) -> Episode:
        """Return the committed episode number `index` (negative counts from the end)."""
        ends = self.episode_ends
        index = range(len(ends))[index]
        start, stop = (int(ends[index - 1]) if index else 0), int(ends[index])
        arrays = {f: self.frames(f, start, stop) for f in self.fields}
        drawn = dict(zip(self.realism_names, self.realism[index].tolist(), strict=True))
        return Episode(**arrays, seed=int(self.seeds[index]), success=bool(self.successes[index]), realism=drawn)

    def append(self, episode: Episode) -> None:
        """Append one episode; when this returns it is committed and on the disk.

        Raises StoreError where the episode does not fit the store or holds a value that is not
        finite, NoSpaceError where the disk is full. In both cases the store is as it was before.
        """
        self._require_writer()
        frames = {f: checked_frames(f, episode, self.spec, self.path) for f in self.fields}
        drawn = checked_realism(episode, self.realism_names, self.path)
        require_free_space(self.path, 2 * sum(a.nbytes for a in frames.values()) + _SPARE_BYTES)
        self._cut()
        self._dirty = True
        try:
            self._arrays.write(frames, episode, drawn)
            self._arrays.commit(self.num_frames + len(episode))
            self._dirty = False
        except OSError as e:
            if not is_disk_full(e):
                raise
            with suppress(OSError):  # else the next append or open does it
                self._cut()
            raise NoSpaceError(
                f"no space left for an episode of seed {episode.seed} in {self.path}; its {len(self)} episodes are "
                "whole: free some space and run the same command again"
            ) from e

    def note(self, attempts: int | None = None, **provenance: Any) -> None:
        """Write down how many episodes were tried so far, kept or not, and change entries of `provenance`."""
        self._require_writer()
        changed = {**self._attrs, "provenance": {**self._attrs["provenance"], **provenance}}
        if attempts is not None:
            changed["attempts"] = int(attempts)
        if changed != self._attrs:
            write_json(self.path / ".zattrs", changed)
            self._attrs = changed

    def _require_writer(self) -> None:
        if self.mode != "a" or self._lock is None:
            raise StoreError(f"{self.path} is open for reading: open it with mode 'a' to append")

    def _cut(self) -> None:
        """Remove what an append left that did not come to its end."""
        if self._dirty:
            self._arrays.cut()
            self._dirty = False

    def _meta(self, name: str) -> np.ndarray:
        return np.asarray(self._arrays.meta(name)[: len(self)])
