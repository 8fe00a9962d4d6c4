"""The arrays of a store of DP3, ManiCM or diffusion_policy, in either format of zarr, checked against each other."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from manicm_ms.demos.layout import FORMAT
from manicm_ms.demos.zarr_files import (
    EPISODE_ENDS,
    array_names,
    describe,
    missing_chunks,
    one_line,
    open_array,
    remark_missing,
    require_folder,
    say_missing,
)
from manicm_ms.errors import StoreError
from manicm_ms.progress import progress_of

POINT_CLOUD = "data/point_cloud"
REQUIRED = {"point_cloud": POINT_CLOUD, "agent_pos": "data/state", "action": "data/action"}
OPTIONAL = {"image": "data/img", "depth": "data/depth"}
"""Field of `Episode` -> array of a DP3 store."""
_BLOCK_FRAMES = 256


@dataclass
class RawStore:
    """A store that another tool wrote.

    Attributes:
        path: where it lies.
        arrays: field of `Episode` -> its array, opened: the required ones, and of the others those to be kept.
        ends: (E,) int64, one past the last frame of each episode.
        attributes: the store's own.
        missing: chunk files that are not there.
        notes: what a user should know of how it is read, one sentence each.
    """

    path: Path
    arrays: dict[str, zarr.Array]
    ends: np.ndarray
    attributes: dict[str, Any]
    missing: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @classmethod
    def open(cls, path: Path) -> RawStore:
        """Open the store at `path`; raise StoreError where it is none or one of ours, or lacks an array or frames."""
        require_folder(path, "name a folder that DP3 or ManiCM wrote, by custom something.zarr")
        attributes = _attributes(path)
        if attributes.get("format") == FORMAT:
            raise StoreError(
                f"{path} is one of our own stores already: 'manicm-ms train' and 'manicm-ms inspect' take it as it is"
            )
        names = array_names(path)
        _require_layout(path, names)
        arrays = {name: open_array(path, disk) for name, disk in REQUIRED.items()}
        raw = cls(path, arrays, _ends(path), attributes)
        raw._check()
        raw._add_pictures(names)
        raw._note_files(names)
        return raw

    @property
    def num_frames(self) -> int:
        """F, frames of all episodes."""
        return int(self.ends[-1])

    def episodes(self) -> Iterator[tuple[int, int]]:
        """Yield first frame and one past the last of each episode, with a progress bar."""
        starts = np.concatenate([[0], self.ends[:-1]])
        yield from progress_of(list(zip(starts.tolist(), self.ends.tolist(), strict=True)), f"convert {self.path.name}")

    def read(self, field: str, start: int, stop: int) -> np.ndarray:
        """Return frames [start, stop) of a field; raise StoreError where they cannot be decoded."""
        return _read(self.path, {**REQUIRED, **OPTIONAL}[field], self.arrays[field], slice(start, stop))

    def blocks(self, field: str) -> Iterator[tuple[int, np.ndarray]]:
        """Yield (first frame, frames) until all frames of a field have been read once."""
        for start in range(0, self.num_frames, _BLOCK_FRAMES):
            yield start, self.read(field, start, min(start + _BLOCK_FRAMES, self.num_frames))

    def place(self, frame: int) -> str:
        """Return where a frame is, in words: "frame 3 of episode 0"."""
        number = int(np.searchsorted(self.ends, frame, side="right"))
        return f"frame {frame - (int(self.ends[number - 1]) if number else 0)} of episode {number}"

    def leave_out(self, field: str, why: str) -> None:
        """Drop an optional array, and say so."""
        self.arrays.pop(field, None)
        self.notes.append(f"left out: {OPTIONAL[field]}, {why}")

    def say_missing(self) -> str:
        """Return ", 3 chunk files are missing: ...", or nothing where none are: likely what an error comes from."""
        return f"; {say_missing(self.missing)}" if self.missing else ""

    def _check(self) -> None:
        for name, array in self.arrays.items():
            disk, axes = REQUIRED[name], 3 if name == "point_cloud" else 2
            if array.ndim != axes or array.dtype.kind not in "fiu" or 0 in array.shape[1:]:
                raise StoreError(
                    f"{self.path}: {disk} is {array.shape} {array.dtype} where {axes} axes of numbers belong, "
                    "one row a frame"
                )
            if array.shape[0] < self.num_frames:
                raise StoreError(
                    f"{self.path} is damaged: {disk} has {array.shape[0]} frames where {EPISODE_ENDS} gives "
                    f"{self.num_frames}"
                )
        if (channels := self.arrays["point_cloud"].shape[2]) not in (3, 6):
            raise StoreError(f"{self.path}: points have {channels} channels; 3 (xyz) or 6 (xyz, rgb) can be read")
        behind = max(array.shape[0] for array in self.arrays.values()) - self.num_frames
        if behind:
            self.notes.append(f"left out: {behind} frames behind the last episode, which {EPISODE_ENDS} does not give")

    def _add_pictures(self, names: tuple[str, ...]) -> None:
        """Take up pictures and depth of a shape that our stores have; leave out others."""
        size: tuple[int, ...] = ()
        for name, disk in OPTIONAL.items():
            if disk not in names:
                continue
            try:
                array = open_array(self.path, disk)
            except StoreError as error:
                why = f"which cannot be opened ({one_line(error.__cause__)})" if error.__cause__ else "which is pickled"
                self.leave_out(name, why)
                continue
            wanted = "(F, H, W, 3)" if name == "image" else "(F, H, W)"
            fits = array.ndim == (4 if name == "image" else 3) and (name != "image" or array.shape[3] == 3)
            if not fits or array.shape[0] < self.num_frames or array.dtype.kind not in "fiu" or 0 in array.shape:
                self.leave_out(name, f"which is {array.shape} {array.dtype} where {wanted} numbers are read")
            elif size and array.shape[1:3] != size:
                self.leave_out(name, f"of another size, {array.shape[1:3]}, than the pictures")
            else:
                size, self.arrays[name] = array.shape[1:3], array

    def _note_files(self, names: tuple[str, ...]) -> None:
        """Note the arrays that are not taken over and the chunk files that are missing."""
        known = {*REQUIRED.values(), *OPTIONAL.values(), EPISODE_ENDS}
        if others := [describe(name, self.path) for name in names if name not in known]:
            self.notes.append(f"left out, as our stores have no place for them: {', '.join(others)}")
        for name, array in self.arrays.items():
            self.missing += missing_chunks(self.path, {**REQUIRED, **OPTIONAL}[name], array, self.num_frames)
        self.notes += remark_missing(self.missing)


def _require_layout(path: Path, names: tuple[str, ...]) -> None:
    wanted = [*REQUIRED.values(), EPISODE_ENDS]
    if not (lacking := [name for name in wanted if name not in names]):
        return
    holds = f"it holds {', '.join(names[:8])}{' and more' * (len(names) > 8)}" if names else "it holds no zarr arrays"
    inner = sorted(p.name for p in path.glob("*.zarr"))[:1]
    hint = f"; try {path / inner[0]}" if inner else ""
    raise StoreError(f"{path} is not a store of DP3's layout: it lacks {', '.join(lacking)}; {holds}{hint}")


def _ends(path: Path) -> np.ndarray:
    """Return the ends of the episodes, (E,) int64; raise StoreError where they are not growing whole numbers."""
    ends = _read(path, EPISODE_ENDS, open_array(path, EPISODE_ENDS))
    if ends.ndim != 1 or not np.isfinite(ends).all() or (ends != np.floor(ends)).any():
        raise StoreError(f"{path}: {EPISODE_ENDS} is {ends.shape} {ends.dtype} where whole numbers on one axis belong")
    if not len(ends):
        raise StoreError(f"{path} holds no episodes: nothing to convert")
    ends = ends.astype(np.int64)
    if (np.diff(ends, prepend=0) <= 0).any():
        lost = missing_chunks(path, EPISODE_ENDS, open_array(path, EPISODE_ENDS), len(ends))
        why = f"; {say_missing(lost)}" if lost else ""
        raise StoreError(f"{path} is damaged: {EPISODE_ENDS} does not grow{why}")
    return ends


def _read(path: Path, name: str, array: zarr.Array, rows: slice = slice(None)) -> np.ndarray:
    if array.dtype.kind not in "fiu":
        raise StoreError(f"{path}: {name} is {array.dtype} where numbers belong")
    try:
        return np.asarray(array[rows])
    except Exception as error:  # what zarr and the codecs raise on a damaged chunk
        raise StoreError(f"{path} is damaged: {name} cannot be read ({one_line(error)})") from error


def _attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of the store's root, of either format; empty where there are none."""
    for name in (".zattrs", "zarr.json"):
        try:
            found = json.loads((path / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        attributes = found.get("attributes") if name == "zarr.json" and isinstance(found, dict) else found
        if isinstance(attributes, dict) and attributes:
            return attributes
    return {}
