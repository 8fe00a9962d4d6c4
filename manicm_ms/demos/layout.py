"""What a store of demonstrations holds, in the zarr layout that DP3, ManiCM and diffusion_policy read.

::

    store.zarr/                zarr format 2
      .zattrs                  env_spec, provenance, attempts, format, chunks
      data/point_cloud         (F, P, C) float32, metres in `ObsSpec.frame`
      data/state               (F, D) float32, what the package calls agent_pos
      data/action              (F, Da) float32, normalised to [-1, 1]
      data/img                 (F, H, W, 3) uint8, only where asked for
      data/depth               (F, H, W) float32 metres, only where asked for
      data/privileged_state    (F, S) float32, only where asked for
      data/voxel_grid          (F, C, V, V, V) uint8 over the task's crop box, only where asked for
      meta/episode_ends        (E,) int64, one past the last frame of each episode
      meta/{seed,length}       (E,) int64
      meta/success             (E,) bool
      meta/realism             (E, K) float64, what was drawn for each episode, only where something was; the names of
                               the K values are the array's attribute `names`

Every chunk has a file, those of zeros too, and the attribute `chunks` says so: one that is missing was lost.
Stores without that attribute were made before, when zarr left out the files of zeros.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import zarr

from manicm_ms.demos.zarr_files import ALL_WRITTEN, EPISODE_ENDS, looks_like_dp3
from manicm_ms.errors import StoreError
from manicm_ms.paths import write_json
from manicm_ms.spec import ACTION, AGENT_POS, ANY, DEPTH, IMAGE, POINT_CLOUD, STATE, VOXEL_GRID, EnvSpec

FORMAT = "manicm_ms demos 1"
"""Value of the attribute `format`; another number means another layout."""

FRAME_ARRAYS: Mapping[str, str] = {
    "point_cloud": "point_cloud",
    "agent_pos": "state",
    "action": "action",
    "image": "img",
    "depth": "depth",
    "privileged_state": "privileged_state",
    "voxel_grid": "voxel_grid",
}
"""Field of `Episode` -> name of its array under `data/`."""

OBS_OF_FIELD: Mapping[str, str] = {
    "point_cloud": POINT_CLOUD,
    "agent_pos": AGENT_POS,
    "image": IMAGE,
    "depth": DEPTH,
    "privileged_state": STATE,
    "voxel_grid": VOXEL_GRID,
}
"""Field of `Episode` -> observation key that it is recorded from."""
FIELD_OF_OBS: Mapping[str, str] = {key: field for field, key in OBS_OF_FIELD.items()}
"""Observation key -> field of `Episode`."""

OPTIONAL_FIELDS = ("image", "depth", "privileged_state", "voxel_grid")
EPISODE_ARRAYS = {"seed": np.dtype("<i8"), "success": np.dtype("bool"), "length": np.dtype("<i8")}
"""Arrays under `meta/` beside `episode_ends`, with their types."""

STORE_ARRAYS = frozenset(
    {*(f"data/{name}" for name in FRAME_ARRAYS.values()), *(f"meta/{n}" for n in EPISODE_ARRAYS), "meta/realism"}
    | {EPISODE_ENDS}
)
"""Every array that a store may hold."""

_CHUNK_FRAMES = 100  # about an episode; DP3's stores have the same
_CHUNK_BYTES = 4 << 20  # of the optional arrays, whose frames may be large: what is read for one frame
_CHUNK_EPISODES = 1024


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
        voxel_grid: (L, C, V, V, V) uint8, or None.
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
    voxel_grid: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.action)


def store_path(folder: Path, env_id: str) -> Path:
    """Return where the demonstrations of an environment lie by custom: `folder`/suite/task.zarr."""
    return folder / f"{env_id}.zarr"


def frame_shapes(spec: EnvSpec) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return, per field of `Episode`, the shape of one frame and its type."""
    shapes: dict[str, tuple[tuple[int, ...], np.dtype]] = {}
    for field in FRAME_ARRAYS:
        if field == ACTION:
            shapes[field] = (spec.action.dim,), np.dtype("<f4")
            continue
        seen = spec.observation(OBS_OF_FIELD[field])
        shape = tuple(spec.obs.num_points if n == ANY else n for n in seen.shape)
        shapes[field] = shape, np.dtype(seen.dtype).newbyteorder("<")
    return shapes


def checked_frames(field: str, episode: Episode, spec: EnvSpec, path: Path) -> np.ndarray:
    """Return the episode's array of a field in the type of the store at `path`.

    Raises StoreError where there is none, its shape is another or it holds a value that is not finite.
    """
    shape, dtype = frame_shapes(spec)[field]
    value = getattr(episode, field)
    if value is None:
        raise StoreError(f"the episode of seed {episode.seed} has no {field}, which {path} stores")
    array = np.ascontiguousarray(value, dtype=dtype)
    if len(array) == 0 or array.shape != (len(episode), *shape):
        raise StoreError(
            f"{field} of the episode of seed {episode.seed} has shape {array.shape} where {path} "
            f"({spec.env_id}) needs {(len(episode) or 'L', *shape)}"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise StoreError(f"{field} of the episode of seed {episode.seed} holds NaN or infinity: not stored")
    return array


def checked_realism(episode: Episode, names: Sequence[str], path: Path) -> np.ndarray:
    """Return the episode's drawn values (K,) float64 in the order of `names`, those of the store at `path`.

    Raises StoreError where it has other names or a value that is not finite.
    """
    if set(episode.realism) != set(names):
        differing = sorted(set(episode.realism) ^ set(names))
        raise StoreError(
            f"the episode of seed {episode.seed} was not drawn from the realism of {path}: "
            f"{', '.join(differing[:3])} are in one of the two only"
        )
    drawn = np.array([episode.realism[name] for name in names], "<f8")
    if not np.isfinite(drawn).all():
        raise StoreError(f"realism of the episode of seed {episode.seed} holds NaN or infinity: not stored")
    return drawn


def write_empty(
    path: Path, spec: EnvSpec, provenance: dict[str, Any], extras: tuple[str, ...], realism: tuple[str, ...]
) -> None:
    """Write a store without episodes into the empty folder `path`; see `DemoStore.create`."""
    group = zarr.create_group(str(path), zarr_format=2)
    data, meta = group.create_group("data"), group.create_group("meta")
    compressor = numcodecs.Blosc("zstd", clevel=3, shuffle=numcodecs.Blosc.SHUFFLE)
    shapes = frame_shapes(spec)
    chunk_frames = min(_CHUNK_FRAMES, spec.max_episode_steps)
    for field, name in FRAME_ARRAYS.items():
        if field in OPTIONAL_FIELDS and field not in extras:
            continue
        shape, dtype = shapes[field]
        frames = chunk_frames
        if field in OPTIONAL_FIELDS:
            frames = max(1, min(frames, _CHUNK_BYTES // (int(np.prod(shape)) * dtype.itemsize)))
        data.create_array(
            name, shape=(0, *shape), chunks=(frames, *shape), dtype=dtype, compressors=compressor, fill_value=0
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


def read_attrs(path: Path) -> dict[str, Any]:
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
