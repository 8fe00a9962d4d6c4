"""DemoStore: demonstrations on disk, in the zarr layout that DP3, ManiCM and diffusion_policy read.

::

    store.zarr/                zarr format 2
      .zattrs                  env_spec, provenance, attempts, format, chunks
      data/point_cloud         (F, P, C) float32, metres in `ObsSpec.frame`
      data/state               (F, D) float32, what the package calls agent_pos
      data/action              (F, Da) float32, normalised to [-1, 1]
      data/img                 (F, H, W, 3) uint8, only where asked for
      data/depth               (F, H, W) float32 metres, only where asked for
      data/privileged_state    (F, S) float32, only where asked for
      meta/episode_ends        (E,) int64, one past the last frame of each episode
      meta/{seed,length}       (E,) int64
      meta/success             (E,) bool
      meta/realism             (E, K) float64, what was drawn for each episode, only where something was; the names of
                               the K values are the array's attribute `names`

An episode exists when `episode_ends` says so. `append` first writes the frames and the other meta
arrays, then the new end into a chunk beyond the array's length, and last replaces
`meta/episode_ends/.zarray` by one that is one longer. That rename is the commit: a kill before it leaves
the episodes committed before, a kill after it leaves one more. What lies past the last end is cut
when the store is next opened for appending.

Every chunk has a file, those of zeros too, and the attribute `chunks` says so: one that is missing was lost.
Stores without that attribute were made before, when zarr left out the files of zeros.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numcodecs
import numpy as np
import zarr

from manicm_ms.demos.zarr_files import (
    ALL_WRITTEN,
    EPISODE_ENDS,
    looks_like_dp3,
    missing_chunks,
    open_array,
    refuse_pickles,
    require_folder,
    say_missing,
)
from manicm_ms.errors import ManicmError, NoSpaceError, OutputExistsError, StoreError
from manicm_ms.paths import is_disk_full, require_free_space, sync, take_lock, temporary_folder, write_json
from manicm_ms.spec import EnvSpec

FORMAT = "manicm_ms demos 1"
"""Value of the attribute `format`; another number means another layout."""

FRAME_ARRAYS: Mapping[str, str] = {
    "point_cloud": "point_cloud",
    "agent_pos": "state",
    "action": "action",
    "image": "img",
    "depth": "depth",
    "privileged_state": "privileged_state",
}
"""Field of `Episode` -> name of its array under `data/`."""

OPTIONAL_FIELDS = ("image", "depth", "privileged_state")
EPISODE_ARRAYS = {"seed": np.dtype("<i8"), "success": np.dtype("bool"), "length": np.dtype("<i8")}
"""Arrays under `meta/` beside `episode_ends`, with their types."""

STORE_ARRAYS = frozenset(
    {*(f"data/{name}" for name in FRAME_ARRAYS.values()), *(f"meta/{n}" for n in EPISODE_ARRAYS), "meta/realism"}
    | {EPISODE_ENDS}
)
"""Every array that a store may hold."""

_CHUNK_FRAMES = 100  # about an episode; DP3's stores have the same
_CHUNK_EPISODES = 1024
_SPARE_BYTES = 32 << 20  # kept free beside what an append needs, so that the commit itself finds room
_LOCK = f"{EPISODE_ENDS}/.lock"  # within an array: zarr warns of strange files in groups
_FORMER_LOCK = ".lock"


@dataclass(frozen=True)
class Episode:
    """One demonstration of L control steps; frame k is what the expert saw before action k.

    Attributes:
        point_cloud: (L, P, C) float32, metres in `ObsSpec.frame`, then rgb in [0, 1] where C is 6.
        agent_pos: (L, D) float32.
        action: (L, Da) float32, normalised to [-1, 1].
        seed: seed that the environment was reset with.
        success: whether the task was solved.
        image: (L, H, W, 3) uint8, or None.
        depth: (L, H, W) float32 metres, or None.
        privileged_state: (L, S) float32, or None.
        realism: name -> value of what was drawn for this episode beside the scene; empty where nothing was.
    """

    point_cloud: np.ndarray
    agent_pos: np.ndarray
    action: np.ndarray
    seed: int
    success: bool
    image: np.ndarray | None = None
    depth: np.ndarray | None = None
    privileged_state: np.ndarray | None = None
    realism: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.action)


def store_path(folder: Path, env_id: str) -> Path:
    """Return where the demonstrations of an environment lie by custom: `folder`/suite/task.zarr."""
    return folder / f"{env_id}.zarr"


def frame_shapes(spec: EnvSpec) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return, per field of `Episode`, the shape of one frame and its type."""
    f32, (h, w) = np.dtype("<f4"), spec.obs.image_size
    return {
        "point_cloud": ((spec.obs.num_points, spec.obs.point_channels), f32),
        "agent_pos": ((spec.obs.agent_pos_dim,), f32),
        "action": ((spec.action.dim,), f32),
        "image": ((h, w, 3), np.dtype("u1")),
        "depth": ((h, w), f32),
        "privileged_state": ((spec.state_dim,), f32),
    }


class DemoStore:
    """Reads and, with one writer at a time, grows a store of demonstrations.

    Use `create` or `open`, and `close` it or use it as a context manager: an open writer holds the
    store's lock, which the system releases when its process ends, however it ends.
    """

    def __init__(self, path: Path, mode: Literal["r", "a"], lock: int | None) -> None:
        self.path, self.mode, self._lock = path, mode, lock
        self._attrs = _read_attrs(path)
        self.spec = EnvSpec.from_dict(self._attrs["env_spec"])
        self._group = zarr.open_group(str(path), mode="r" if mode == "r" else "r+", zarr_format=2)
        self._fields = [f for f, name in FRAME_ARRAYS.items() if (path / "data" / name / ".zarray").is_file()]
        self.realism_names = self._read_realism_names()
        self._check_layout()
        self.missing_files = self._missing_files()
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
            _write_empty(fresh, spec, dict(provenance), extras, realism)
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
                _read_attrs(path)  # what is no store of ours stays untouched, by a lock too
                _drop_former_lock(path)
                lock = _take_lock(path)
            return cls(path, mode, lock)
        except ManicmError:
            _release(lock)
            raise
        except Exception as e:  # zarr and json raise many kinds on damaged files
            _release(lock)
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
        _release(self._lock)
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
        return tuple(self._fields)

    @property
    def episode_ends(self) -> np.ndarray:
        """(E,) int64, one past the last frame of each committed episode."""
        return _read_ends(self.path)

    @property
    def num_frames(self) -> int:
        """F, committed frames."""
        ends = self.episode_ends
        return int(ends[-1]) if len(ends) else 0

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
        if field not in self._fields:
            raise StoreError(f"{self.path} holds no {field}: it holds {', '.join(self._fields)}")
        last = self.num_frames
        try:
            return np.asarray(self._frame_array(field)[start : last if stop is None else min(stop, last)])
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
        arrays = {f: self.frames(f, start, stop) for f in self._fields}
        drawn = dict(zip(self.realism_names, self.realism[index].tolist(), strict=True))
        return Episode(**arrays, seed=int(self.seeds[index]), success=bool(self.successes[index]), realism=drawn)

    def append(self, episode: Episode) -> None:
        """Append one episode; when this returns it is committed and on the disk.

        Raises StoreError where the episode does not fit the store or holds a value that is not
        finite, NoSpaceError where the disk is full. In both cases the store is as it was before.
        """
        self._require_writer()
        frames = {f: self._checked(f, episode) for f in self._fields}
        self._checked_realism(episode)
        require_free_space(self.path, 2 * sum(a.nbytes for a in frames.values()) + _SPARE_BYTES)
        self._cut()
        self._dirty = True
        try:
            self._write_frames(frames, episode)
            self._commit(self.num_frames + len(episode))
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

    def _frame_array(self, field: str) -> zarr.Array:
        return self._array(f"data/{FRAME_ARRAYS[field]}")

    def _meta_array(self, name: str) -> zarr.Array:
        return self._array(f"meta/{name}")

    def _array(self, name: str) -> zarr.Array:
        refuse_pickles(self.path, name)
        array: zarr.Array = self._group[name]  # type: ignore[assignment]
        return array.with_config({"write_empty_chunks": True})

    def _meta(self, name: str) -> np.ndarray:
        return np.asarray(self._meta_array(name)[: len(self)])

    def _checked(self, field: str, episode: Episode) -> np.ndarray:
        """Return the episode's array of a field in the type of the store; refuse what does not fit."""
        shape, dtype = frame_shapes(self.spec)[field]
        value = getattr(episode, field)
        if value is None:
            raise StoreError(f"the episode of seed {episode.seed} has no {field}, which {self.path} stores")
        array = np.ascontiguousarray(value, dtype=dtype)
        if len(array) == 0 or array.shape != (len(episode), *shape):
            raise StoreError(
                f"{field} of the episode of seed {episode.seed} has shape {array.shape} where {self.path} "
                f"({self.spec.env_id}) needs {(len(episode) or 'L', *shape)}"
            )
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StoreError(f"{field} of the episode of seed {episode.seed} holds NaN or infinity: not stored")
        return array

    def _checked_realism(self, episode: Episode) -> np.ndarray:
        """Return the episode's drawn values in the order of the store, (K,); refuse other names or no numbers."""
        if set(episode.realism) != set(self.realism_names):
            differing = sorted(set(episode.realism) ^ set(self.realism_names))
            raise StoreError(
                f"the episode of seed {episode.seed} was not drawn from the realism of {self.path}: "
                f"{', '.join(differing[:3])} are in one of the two only"
            )
        drawn = np.array([episode.realism[name] for name in self.realism_names], "<f8")
        if not np.isfinite(drawn).all():
            raise StoreError(f"realism of the episode of seed {episode.seed} holds NaN or infinity: not stored")
        return drawn

    def _meta_names(self) -> tuple[str, ...]:
        return (*EPISODE_ARRAYS, "realism") if self.realism_names else tuple(EPISODE_ARRAYS)

    def _read_realism_names(self) -> tuple[str, ...]:
        if not (self.path / "meta" / "realism" / ".zarray").is_file():
            return ()
        return tuple(self._meta_array("realism").attrs["names"])  # type: ignore[arg-type]

    def _write_frames(self, frames: Mapping[str, np.ndarray], episode: Episode) -> None:
        """Write everything but the end of the episode, and see it onto the disk."""
        start, number = self.num_frames, len(self)
        for field, array in frames.items():
            _extend(self._frame_array(field), start, array)
        values = {"seed": episode.seed, "success": episode.success, "length": len(episode)}
        for name, dtype in EPISODE_ARRAYS.items():
            _extend(self._meta_array(name), number, np.array([values[name]], dtype))
        if self.realism_names:
            _extend(self._meta_array("realism"), number, self._checked_realism(episode)[None])
        for field in frames:
            _sync_rows(self.path / "data" / FRAME_ARRAYS[field], self._frame_array(field), start)
        for name in self._meta_names():
            _sync_rows(self.path / "meta" / name, self._meta_array(name), number)

    def _commit(self, end: int) -> None:
        """Make the episode that ends at frame `end` exist."""
        folder, number = self.path / "meta" / "episode_ends", len(self)
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

    def _cut(self) -> None:
        """Remove what was written past the last commit, by an append that did not come to its end."""
        if not self._dirty:
            return
        for stray in (*self.path.rglob("*.partial"), *self.path.rglob(".*.tmp")):
            stray.unlink(missing_ok=True)
        # Handles are opened anew: the sizes they remember may be those of before the failed append.
        self._group = zarr.open_group(str(self.path), mode="r+", zarr_format=2)
        for field in self._fields:
            _shorten(self._frame_array(field), self.num_frames)
        for name in self._meta_names():
            _shorten(self._meta_array(name), len(self))
        self._dirty = False

    def _check_layout(self) -> None:
        """Raise StoreError unless the arrays fit the spec and hold all committed episodes."""
        missing = {"point_cloud", "agent_pos", "action"} - set(self._fields)
        if missing:
            names = ", ".join(f"data/{FRAME_ARRAYS[f]}" for f in sorted(missing))
            raise StoreError(f"{self.path} lacks {names}: it is not a store of demonstrations, or it is damaged")
        ends = self.episode_ends
        if np.any(np.diff(ends, prepend=0) <= 0):
            raise StoreError(f"{self.path} is damaged: meta/episode_ends does not grow")
        for field in self._fields:
            array, (shape, dtype) = self._frame_array(field), frame_shapes(self.spec)[field]
            if array.shape[1:] != shape or array.dtype != dtype or array.shape[0] < self.num_frames:
                raise StoreError(
                    f"{self.path} is damaged: data/{FRAME_ARRAYS[field]} is {array.shape} {array.dtype} where "
                    f"{self.num_frames} frames of {shape} {dtype} are committed"
                )
        for name in self._meta_names():
            if self._meta_array(name).shape[0] < len(ends):
                raise StoreError(f"{self.path} is damaged: meta/{name} is shorter than meta/episode_ends")

    def _missing_files(self) -> tuple[str, ...]:
        """Return the chunk files that are not there; raise StoreError where that can only mean that they were lost."""
        rows = {f"data/{FRAME_ARRAYS[f]}": self.num_frames for f in self._fields}
        rows |= {f"meta/{name}": len(self) for name in (*self._meta_names(), "episode_ends")}
        missing = [m for name, n in rows.items() for m in missing_chunks(self.path, name, self._array(name), n)]
        if missing and ALL_WRITTEN.items() <= self._attrs.items():
            hit = sorted({name.rpartition("/")[0] for name in missing})
            spare = {f"data/{FRAME_ARRAYS[field]}" for field in OPTIONAL_FIELDS}
            way = "collect into another folder"
            if spare.issuperset(hit):
                way = f"remove {', '.join(hit)}, which a store can do without"
            raise StoreError(f"{self.path} is damaged: {say_missing(missing)}; bring them back, or {way}")
        return tuple(missing)


def _write_empty(
    path: Path, spec: EnvSpec, provenance: dict[str, Any], extras: tuple[str, ...], realism: tuple[str, ...]
) -> None:
    group = zarr.create_group(str(path), zarr_format=2)
    data, meta = group.create_group("data"), group.create_group("meta")
    compressor = numcodecs.Blosc("zstd", clevel=3, shuffle=numcodecs.Blosc.SHUFFLE)
    shapes = frame_shapes(spec)
    chunk_frames = min(_CHUNK_FRAMES, spec.max_episode_steps)
    for field, name in FRAME_ARRAYS.items():
        if field in OPTIONAL_FIELDS and field not in extras:
            continue
        shape, dtype = shapes[field]
        data.create_array(
            name, shape=(0, *shape), chunks=(chunk_frames, *shape), dtype=dtype, compressors=compressor, fill_value=0
        )
    for name, dtype in EPISODE_ARRAYS.items():
        meta.create_array(name, shape=(0,), chunks=(_CHUNK_EPISODES,), dtype=dtype, compressors=None, fill_value=0)
    if realism:
        meta.create_array(
            "realism", shape=(0, len(realism)), chunks=(_CHUNK_EPISODES, len(realism)), dtype="<f8",
            compressors=compressor, fill_value=0, attributes={"names": list(realism)},
        )  # fmt: skip
    # No compressor: the commit writes this array's chunk itself, as plain little-endian numbers.
    meta.create_array(
        "episode_ends", shape=(0,), chunks=(_CHUNK_EPISODES,), dtype="<i8", compressors=None, fill_value=0
    )
    write_json(
        path / ".zattrs",
        {"format": FORMAT, **ALL_WRITTEN, "env_spec": spec.to_dict(), "provenance": provenance, "attempts": 0},
    )


def _read_attrs(path: Path) -> dict[str, Any]:
    """Return the store's attributes; raise StoreError where they are not those of a DemoStore."""
    file = path / ".zattrs"
    attrs = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if "format" not in attrs and looks_like_dp3(path):
        raise StoreError(
            f"{path} is a store of DP3's layout: 'manicm-ms convert {path} --from dp3 --out OURS.zarr' makes it one "
            "of ours"
        )
    if not (path / ".zgroup").is_file() or not file.is_file():
        raise StoreError(f"{path} is not a store of demonstrations, a zarr group of format 2: name another folder")
    if attrs.get("format") != FORMAT:
        raise StoreError(
            f"{path} has the format {attrs.get('format')!r} where this version reads {FORMAT!r}: "
            "collect it again, or use the version that wrote it"
        )
    return attrs


def _read_ends(path: Path) -> np.ndarray:
    """Return the committed episode ends, as they stand on the disk now."""
    # Opened anew each time: a reader sees what a writer in another process commits meanwhile.
    return np.asarray(open_array(path, EPISODE_ENDS)[:])


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


def _take_lock(path: Path, name: str = _LOCK) -> int:
    """Become the one writer of the store; raise StoreError naming the process that already is."""

    def refuse(holder: str) -> StoreError:
        return StoreError(f"{path} is being written by process {holder}: wait for it to end or stop it, then try again")

    try:
        return take_lock(path / name, refuse)
    except OSError as e:
        raise StoreError(f"cannot write to {path} ({e.strerror}): check its permissions") from e


def _drop_former_lock(path: Path) -> None:
    """Remove the lock file of earlier versions; raise StoreError where such a version is writing the store."""
    if (path / _FORMER_LOCK).exists():
        _release(_take_lock(path, _FORMER_LOCK))
        (path / _FORMER_LOCK).unlink(missing_ok=True)


def _release(lock: int | None) -> None:
    if lock is not None:
        os.close(lock)
