"""The summary of a store: what it holds and what is wrong with it, however broken it is.

Reads the zarr arrays one by one instead of through `DemoStore`, which refuses a damaged store as a whole.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from manicm_ms.demos.layout import FORMAT, FRAME_ARRAYS, STORE_ARRAYS, frame_shapes
from manicm_ms.demos.remarks import empty_clouds, field_remarks, length_remarks, unread_remarks
from manicm_ms.demos.zarr_files import (
    ALL_WRITTEN,
    HEADERS,
    array_names,
    looks_like_dp3,
    missing_chunks,
    one_line,
    open_array,
    remark_missing,
    require_folder,
    say_missing,
)
from manicm_ms.errors import ConfigError, StoreError
from manicm_ms.spec import EnvSpec

_REQUIRED = ("point_cloud", "agent_pos", "action")
_RANGED = ("point_cloud", "agent_pos", "action", "privileged_state")
_MOST_NAMED = 5  # problems of one kind that are spelled out


@dataclass
class Summary:
    """What a store holds; its fields are the keys of `manicm-ms inspect --json`.

    Attributes:
        path: the store.
        env_id: environment of the demonstrations, or None where the store does not say.
        episodes: E.
        frames: control steps of all episodes together.
        attempts: episodes tried for those that are kept.
        seeds: (E,) seed of each episode.
        lengths: (E,) control steps of each episode.
        success: (E,) whether each was solved.
        expert: who demonstrated.
        style: in which style.
        fields: field -> shape and type of a frame, as in "84 x 84 x 3 uint8", of what is stored.
        ranges: field -> channel -> [least, greatest] over all frames.
        provenance: how the data came about.
        env_spec: what is fixed about the environment.
        bytes_on_disk: size of all files.
        problems: what is wrong, one sentence each; empty for a sound store.
        remarks: what a user should know of a sound one, one sentence each: see `demos.remarks`.
    """

    path: str
    env_id: str | None = None
    episodes: int = 0
    frames: int = 0
    attempts: int = 0
    seeds: list[int] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    success: list[bool] = field(default_factory=list)
    expert: str | None = None
    style: str | None = None
    fields: dict[str, str] = field(default_factory=dict)
    ranges: dict[str, dict[str, list[float]]] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    env_spec: dict[str, Any] = field(default_factory=dict)
    bytes_on_disk: int = 0
    problems: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return asdict(self)


class _Summarizer:
    """Fills a `Summary` step by step; every step goes on as far as the damage lets it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.result = Summary(str(path))
        self.spec: EnvSpec | None = None
        self.ends = np.zeros(0, np.int64)
        self.all_written = False
        self.missing: list[str] = []

    def run(self) -> Summary:
        """Look at everything and return what was found."""
        self.result.bytes_on_disk = sum(f.stat().st_size for f in self.path.rglob("*") if f.is_file())
        self._attributes()
        self._episodes()
        for name in FRAME_ARRAYS:
            self._frames(name)
        self._files()
        return self.result

    def _problem(self, text: str) -> None:
        self.result.problems.append(text)

    def _attributes(self) -> None:
        try:
            attrs = json.loads((self.path / ".zattrs").read_text(encoding="utf-8"))
        except (OSError, ValueError) as e:
            self._problem(f"the attributes (.zattrs) cannot be read: {one_line(e)}")
            return
        if not isinstance(attrs, dict) or attrs.get("format") != FORMAT:
            self._problem(f"the attribute format is not {FORMAT!r}: the store was not written by 'manicm-ms collect'")
            return
        self.all_written = ALL_WRITTEN.items() <= attrs.items()
        try:
            self.spec = EnvSpec.from_dict(attrs["env_spec"])
            provenance = dict(attrs["provenance"])
            self.result.attempts = int(attrs["attempts"])
        except (KeyError, TypeError, ValueError, AttributeError, ConfigError) as e:
            self._problem(f"the attributes (.zattrs) are damaged: {one_line(e)}")
            return
        self.result.env_id, self.result.env_spec = self.spec.env_id, json.loads(json.dumps(self.spec.to_dict()))
        self.result.provenance = provenance
        self.result.expert, self.result.style = provenance.get("expert"), provenance.get("style")

    def _episodes(self) -> None:
        ends = self._read("meta/episode_ends")
        if ends is None:
            return
        if ends.dtype.kind not in "iu":
            self._problem(f"meta/episode_ends is {ends.dtype} where whole numbers belong")
            return
        lengths = np.diff(ends, prepend=0)
        for k in np.flatnonzero(lengths <= 0)[:_MOST_NAMED]:
            before = ends[k - 1] if k else 0
            self._problem(f"meta/episode_ends does not grow: episode {k} ends at frame {ends[k]} after {before}")
        self.ends = ends
        self.result.episodes, self.result.frames = len(ends), int(ends[-1]) if len(ends) else 0
        self.result.lengths = [int(n) for n in lengths]
        if not len(ends):
            self._problem("it holds no episode")
        columns = {name: self._column(name) for name in ("seed", "success", "length")}
        self.result.seeds = [int(s) for s in columns["seed"]]
        self.result.success = [bool(s) for s in columns["success"]]
        for seed, times in Counter(self.result.seeds).items():
            if times > 1:
                self._problem(f"seed {seed} occurs {times} times")
        if len(columns["length"]) == len(lengths) and np.any(columns["length"] != lengths):
            self._problem("meta/length differs from the lengths that meta/episode_ends gives")

    def _column(self, name: str) -> np.ndarray:
        values = self._read(f"meta/{name}", len(self.ends))
        if values is None:
            return np.zeros(0)
        if len(values) != len(self.ends):
            self._problem(self._mismatch(f"meta/{name}", len(values), len(self.ends), "episodes"))
        return values[: len(self.ends)]

    def _mismatch(self, name: str, has: int, committed: int, unit: str) -> str:
        remedy = ": the last append was cut short, the next 'collect' into it removes the rest" * (has > committed)
        return f"{name} has {has} {unit} where meta/episode_ends gives {committed}{remedy}"

    def _frames(self, name: str) -> None:
        disk = f"data/{FRAME_ARRAYS[name]}"
        if name not in _REQUIRED and not (self.path / disk).exists():
            return
        values = self._read(disk, self.result.frames)
        if values is None:
            return
        self.result.fields[name] = f"{' x '.join(map(str, values.shape[1:]))} {values.dtype.name}"
        if self.spec is not None:
            shape, dtype = frame_shapes(self.spec)[name]
            if values.shape[1:] != shape or values.dtype != dtype:
                found, wanted = f"{values.shape[1:]} {values.dtype}", f"{shape} {dtype}"
                self._problem(f"{disk} has frames of {found} where the env spec says {wanted}")
        if len(values) != self.result.frames:
            self._problem(self._mismatch(disk, len(values), self.result.frames, "frames"))
        values = values[: max(self.result.frames, 0)]
        if values.dtype.kind != "f" or values.ndim < 2 or not values.size:
            return
        self._not_finite(disk, values)
        if name == "point_cloud" and values.ndim == 3:
            self._empty_clouds(values)
        if name == "action" and (reach := np.abs(values[np.isfinite(values)]).max(initial=0)) > 1:
            self._problem(f"{disk} leaves [-1, 1]: it reaches {reach:.3g}")
        if self.spec is not None and values.shape[1:] == frame_shapes(self.spec)[name][0]:
            self.result.remarks += field_remarks(name, values, self.spec)
        if name in _RANGED:
            self.result.ranges[name] = self._ranges(name, values)

    def _not_finite(self, disk: str, values: np.ndarray) -> None:
        bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
        self._name_frames(f"NaN or infinity in {disk}", bad)

    def _empty_clouds(self, clouds: np.ndarray) -> None:
        empty = np.flatnonzero(empty_clouds(clouds))
        self._name_frames("empty cloud (all points equal) in data/point_cloud", empty)

    def _name_frames(self, what: str, frames: np.ndarray) -> None:
        """Name a problem per episode, with its first frame."""
        numbers = np.searchsorted(self.ends, frames, side="right")
        episodes, first, count = np.unique(numbers, return_index=True, return_counts=True)
        for k, at, n in list(zip(episodes, first, count, strict=True))[:_MOST_NAMED]:
            start = self.ends[k - 1] if k else 0
            seed = f" (seed {self.result.seeds[k]})" if k < len(self.result.seeds) else ""
            self._problem(f"{what}: episode {k}{seed}, {n} frame(s), the first is its frame {frames[at] - start}")
        if len(episodes) > _MOST_NAMED:
            self._problem(f"{what}: in {len(episodes) - _MOST_NAMED} further episodes")

    def _ranges(self, name: str, values: np.ndarray) -> dict[str, list[float]]:
        flat = values.reshape(-1, values.shape[-1])
        flat = np.where(np.isfinite(flat), flat, np.nan)
        names = self._channel_names(name, flat.shape[1])
        kept = [k for k in range(flat.shape[1]) if np.isfinite(flat[:, k]).any()]
        return {names[k]: [float(np.nanmin(flat[:, k])), float(np.nanmax(flat[:, k]))] for k in kept}

    def _channel_names(self, name: str, channels: int) -> list[str]:
        names: tuple[str, ...] = ()
        if name == "point_cloud":
            names = ("x (m)", "y (m)", "z (m)", "r", "g", "b")[:channels]
        elif self.spec is not None and name == "agent_pos":
            names = self.spec.agent_pos_names
        elif self.spec is not None and name == "action":
            names = self.spec.action.names
        return list(names) if len(set(names)) == channels else [str(k) for k in range(channels)]

    def _files(self) -> None:
        """Name the chunk files that are missing and the arrays that nothing reads."""
        if self.missing and self.all_written:
            self._problem(f"{say_missing(self.missing)}: lost, as every chunk was written")
        else:
            self.result.remarks += remark_missing(self.missing)
        self.result.remarks += unread_remarks(set(array_names(self.path)) - STORE_ARRAYS)
        if self.spec is not None and self.result.lengths:
            self.result.remarks += length_remarks(np.array(self.result.lengths), self.spec)

    def _read(self, name: str, rows: int | None = None) -> np.ndarray | None:
        """Return an array of which `rows` count, by default all, or None where it cannot be read."""
        if not (self.path / name / HEADERS[2]).is_file():
            self._problem(f"{name} is missing")
            return None
        try:
            array = open_array(self.path, name)
            values = _read_bytes(array) if array.dtype == np.uint8 else np.asarray(array[:])
        except Exception as e:  # a damaged array may raise anything in zarr, numcodecs or json
            self._problem(f"{name} cannot be read: {one_line(e.__cause__ or e)}")
            return None
        if values.ndim == 0 or (name.startswith("meta/") and values.ndim != 1):
            self._problem(f"{name} has the shape {values.shape}")
            return None
        self.missing += missing_chunks(self.path, name, array, len(values) if rows is None else rows)
        return values


def _read_bytes(array: Any) -> np.ndarray:
    """Read pictures or grids chunk by chunk, which shows whether they can be, and return zeros of their shape instead.

    Nobody looks at their values, and all together may exceed the memory; the zeros take none.
    """
    for start in range(0, array.shape[0], array.chunks[0]):
        array[start : start + array.chunks[0]]
    return np.broadcast_to(np.zeros((), array.dtype), array.shape)


def summarize(path: Path) -> Summary:
    """Return what the store at `path` holds, with its problems named.

    Raises StoreError only where no zarr group stands at `path`; any other damage is a problem of the summary.
    """
    require_folder(path, f"make one with 'manicm-ms collect ENV --out {path}'")
    if not (path / ".zattrs").is_file() and looks_like_dp3(path):
        raise StoreError(
            f"{path} is a store of DP3's layout: 'manicm-ms convert {path} --from dp3 --out OURS.zarr' makes it one of "
            "ours, which can be inspected"
        )
    if not (path / ".zgroup").is_file() and not (path / "meta").is_dir():
        raise StoreError(f"{path} is not a store of demonstrations, a zarr group of format 2: name another folder")
    return _Summarizer(path).run()
