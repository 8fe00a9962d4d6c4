"""The arrays of a store: read, lengthened by an episode in one transaction, cut after one that did not come to its end.

An episode exists when `episode_ends` says so. `append` first writes the frames and the other meta
arrays, then the new end into a chunk beyond the array's length, and last replaces
`meta/episode_ends/.zarray` by one that is one longer. That rename is the commit: a kill before it leaves
the episodes committed before, a kill after it leaves one more. What lies past the last end is cut
when the store is next opened for appending.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import zarr

from manicm_ms.demos.layout import EPISODE_ARRAYS, FRAME_ARRAYS, OPTIONAL_FIELDS, Episode, frame_shapes
from manicm_ms.demos.zarr_files import EPISODE_ENDS, missing_chunks, open_array, refuse_pickles, say_missing
from manicm_ms.errors import StoreError
from manicm_ms.paths import sync, write_json
from manicm_ms.spec import EnvSpec


class StoreArrays:
    """The arrays of one store, opened together.

    Args:
        path: the store.
        mode: "r" to read them, "r+" to write too.

    Attributes:
        fields: the fields of `Episode` that there are frames of.
        realism_names: names of the values drawn for each episode; empty where none were.
    """

    def __init__(self, path: Path, mode: Literal["r", "r+"]) -> None:
        self.path = path
        self._group = zarr.open_group(str(path), mode=mode, zarr_format=2)
        self.fields = tuple(f for f, name in FRAME_ARRAYS.items() if (path / "data" / name / ".zarray").is_file())
        self.realism_names = self._read_realism_names()

    def frames(self, field: str) -> zarr.Array:
        """Return the array of a field of `Episode`, which may be longer than what is committed."""
        return self._array(f"data/{FRAME_ARRAYS[field]}")

    def meta(self, name: str) -> zarr.Array:
        """Return an array of values that an episode has one of, which may be longer than what is committed."""
        return self._array(f"meta/{name}")

    def ends(self) -> np.ndarray:
        """Return the committed episode ends (E,) int64, as they stand on the disk now."""
        # Opened anew each time: a reader sees what a writer in another process commits meanwhile.
        return np.asarray(open_array(self.path, EPISODE_ENDS)[:])

    def num_frames(self) -> int:
        """Return how many frames are committed."""
        ends = self.ends()
        return int(ends[-1]) if len(ends) else 0

    def write(self, frames: Mapping[str, np.ndarray], episode: Episode, drawn: np.ndarray) -> None:
        """Write everything but the end of the episode, and see it onto the disk.

        Args:
            frames: field of `Episode` -> its array in the type of the store, for each of `fields`.
            episode: whose they are.
            drawn: (K,) float64, values of `realism_names`.
        """
        start, number = self.num_frames(), len(self.ends())
        for field, array in frames.items():
            _extend(self.frames(field), start, array)
        values = {"seed": episode.seed, "success": episode.success, "length": len(episode)}
        for name, dtype in EPISODE_ARRAYS.items():
            _extend(self.meta(name), number, np.array([values[name]], dtype))
        if self.realism_names:
            _extend(self.meta("realism"), number, drawn[None])
        for field in frames:
            _sync_rows(self.path / "data" / FRAME_ARRAYS[field], self.frames(field), start)
        for name in self._meta_names():
            _sync_rows(self.path / "meta" / name, self.meta(name), number)

    def commit(self, end: int) -> None:
        """Make the episode that ends at frame `end` exist."""
        folder, number = self.path / "meta" / "episode_ends", len(self.ends())
        header = json.loads((folder / ".zarray").read_text())
        rows = header["chunks"][0]
        chunk_file, place = folder / str(number // rows), number % rows
        chunk = np.frombuffer(chunk_file.read_bytes(), "<i8").copy() if place else np.zeros(rows, "<i8")
        chunk[place:] = 0
        chunk[place] = end
        _write_bytes(chunk_file, chunk.tobytes())
        header["shape"] = [number + 1]
        write_json(folder / ".zarray", header)
        sync(folder)

    def cut(self) -> None:
        """Remove what was written past the last commit, by an append that did not come to its end."""
        for stray in (*self.path.rglob("*.partial"), *self.path.rglob(".*.tmp")):
            stray.unlink(missing_ok=True)
        # Handles are opened anew: the sizes they remember may be those of before the failed append.
        self._group = zarr.open_group(str(self.path), mode="r+", zarr_format=2)
        for field in self.fields:
            _shorten(self.frames(field), self.num_frames())
        for name in self._meta_names():
            _shorten(self.meta(name), len(self.ends()))

    def check_layout(self, spec: EnvSpec) -> None:
        """Raise StoreError unless the arrays fit the spec and hold all committed episodes."""
        missing = {"point_cloud", "agent_pos", "action"} - set(self.fields)
        if missing:
            names = ", ".join(f"data/{FRAME_ARRAYS[f]}" for f in sorted(missing))
            raise StoreError(f"{self.path} lacks {names}: it is not a store of demonstrations, or it is damaged")
        ends = self.ends()
        if np.any(np.diff(ends, prepend=0) <= 0):
            raise StoreError(f"{self.path} is damaged: meta/episode_ends does not grow")
        for field in self.fields:
            array, (shape, dtype) = self.frames(field), frame_shapes(spec)[field]
            if array.shape[1:] != shape or array.dtype != dtype or array.shape[0] < self.num_frames():
                raise StoreError(
                    f"{self.path} is damaged: data/{FRAME_ARRAYS[field]} is {array.shape} {array.dtype} where "
                    f"{self.num_frames()} frames of {shape} {dtype} are committed"
                )
        for name in self._meta_names():
            if self.meta(name).shape[0] < len(ends):
                raise StoreError(f"{self.path} is damaged: meta/{name} is shorter than meta/episode_ends")

    def missing_files(self, all_written: bool) -> tuple[str, ...]:
        """Return the chunk files that are not there; raise StoreError where that can only mean that they were lost."""
        rows = {f"data/{FRAME_ARRAYS[f]}": self.num_frames() for f in self.fields}
        rows |= {f"meta/{name}": len(self.ends()) for name in (*self._meta_names(), "episode_ends")}
        missing = [m for name, n in rows.items() for m in missing_chunks(self.path, name, self._array(name), n)]
        if missing and all_written:
            hit = sorted({name.rpartition("/")[0] for name in missing})
            spare = {f"data/{FRAME_ARRAYS[field]}" for field in OPTIONAL_FIELDS}
            way = "collect into another folder"
            if spare.issuperset(hit):
                way = f"remove {', '.join(hit)}, which a store can do without"
            raise StoreError(f"{self.path} is damaged: {say_missing(missing)}; bring them back, or {way}")
        return tuple(missing)

    def _array(self, name: str) -> zarr.Array:
        refuse_pickles(self.path, name)
        array: zarr.Array = self._group[name]  # type: ignore[assignment]
        return array.with_config({"write_empty_chunks": True})

    def _read_realism_names(self) -> tuple[str, ...]:
        if not (self.path / "meta" / "realism" / ".zarray").is_file():
            return ()
        return tuple(self.meta("realism").attrs["names"])  # type: ignore[arg-type]

    def _meta_names(self) -> tuple[str, ...]:
        return (*EPISODE_ARRAYS, "realism") if self.realism_names else tuple(EPISODE_ARRAYS)


def _extend(array: zarr.Array, start: int, rows: np.ndarray) -> None:
    """Make `array` end with `rows`, which begin at row `start`."""
    stop, chunk = start + len(rows), array.chunks[0]
    array.resize((stop, *array.shape[1:]))
    # One chunk at a time: where a write fails, none is under way in zarr's other threads.
    for low in range(start - start % chunk, stop, chunk):
        first, last = max(low, start), min(low + chunk, stop)
        array[first:last] = rows[first - start : last - start]


def _shorten(array: zarr.Array, length: int) -> None:
    """Cut `array` to `length` rows, leaving no remains in the chunk that the cut goes through."""
    if array.shape[0] <= length:
        return
    chunk = array.chunks[0]
    chunk_end = min(-(-length // chunk) * chunk, array.shape[0])
    if chunk_end > length:
        array[length:chunk_end] = 0
    array.resize((length, *array.shape[1:]))


def _sync_rows(folder: Path, array: zarr.Array, start: int) -> None:
    """Force the chunks of the rows from `start` on, and the array's header, onto the disk."""
    zeros = ".0" * (array.ndim - 1)
    numbers = range(start // array.chunks[0], -(-array.shape[0] // array.chunks[0]))
    for name in (".zarray", *(f"{n}{zeros}" for n in numbers)):
        if (folder / name).exists():  # zarr writes no file for a chunk of zeros
            sync(folder / name)
    sync(folder)


def _write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that at every moment either the old or the new one is there, whole."""
    temporary = path.with_name(f".{path.name}.tmp")
    with temporary.open("wb") as f:
        f.write(content)
        f.flush()
        os.fsync(f.fileno())
    os.replace(temporary, path)
