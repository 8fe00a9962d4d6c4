"""From the zarr stores of DP3, ManiCM and diffusion_policy into ours.

Such a store says nothing about itself: not which environment it is of, nor what its numbers mean. What
can be checked is checked; what cannot (frames, units, the meaning of entries) is the user's word.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from manicm_ms.demos.convert.base import IMPORTERS, Tally
from manicm_ms.demos.store import DemoStore, Episode
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import ConfigError, SpecMismatchError, StoreError
from manicm_ms.paths import require_free_space
from manicm_ms.point_cloud import sample_cloud
from manicm_ms.progress import progress_of
from manicm_ms.provenance import package_versions
from manicm_ms.types import ActionSpec, EnvSpec, ObsSpec, require_compatible

_ACTION_SLACK = 1e-5  # of rounding, beyond [-1, 1]
_FRAME, _CONTROL_HZ = "world", 10.0
_PICTURES = {"image": "img", "depth": "depth"}


@dataclass(frozen=True)
class Dp3Options:
    """How a DP3 store is to be read.

    Attributes:
        env: registered environment id that the data is of; None makes a spec from the store's shapes.
        num_points: P, points kept of each cloud; None for what the environment has, or the store.
        colors: keep rgb, where the store has it.
        frame: frame of the clouds, one of `types.FRAMES`, only where `env` is None; "world" if not given.
        control_hz: actions per second, only where `env` is None; 10 if not given.
        command: command line, for the provenance.
    """

    env: str | None = None
    num_points: int | None = None
    colors: bool = False
    frame: str | None = None
    control_hz: float | None = None
    command: str = ""

    def __post_init__(self) -> None:
        if self.num_points is not None and self.num_points < 1:
            raise ConfigError(f"num_points must be at least 1, got {self.num_points}")
        if self.control_hz is not None and self.control_hz <= 0:
            raise ConfigError(f"control_hz must be positive, got {self.control_hz}")
        if self.env is not None and (self.frame is not None or self.control_hz is not None):
            raise ConfigError(f"frame and control_hz are those of {self.env}: leave them out, or leave out env")


@IMPORTERS.register("dp3")
def read_dp3(source: Path, folder: Path, **options: Any) -> Tally:
    """Read the store at `source` into a new one at `folder`; `options` are the fields of `Dp3Options`.

    Clouds are resampled to P points in farthest-point order (docs/decisions/0006); points at exactly (0, 0, 0), which
    DP3's wrappers pad with, are dropped before. Episodes get the seeds -1, -2, ..., as their own are not known, and
    count as solved, as DP3 stores hold nothing else.

    Raises StoreError where `source` is no such store, broken or empty; SpecMismatchError where it does not fit the
    environment; ConfigError, UnknownNameError, NoSpaceError.
    """
    asked = Dp3Options(**options)
    raw = _RawStore.open(source)
    spec = _spec(raw, asked)
    pictures = [name for name in _PICTURES if name in raw.arrays]
    frame_bytes = 4 * (spec.obs.num_points * spec.obs.point_channels + spec.obs.agent_pos_dim + spec.action.dim)
    require_free_space(folder, frame_bytes * raw.num_frames)
    tally = Tally(notes=["seeds and success are not known: seeds count down from -1, all count as solved", *raw.notes])
    with DemoStore.create(folder, spec, _provenance(raw, asked, spec), extras=pictures) as store:
        for number, (start, stop) in enumerate(raw.episodes()):
            episode = _episode(raw, spec, number, start, stop, pictures)
            store.append(episode)
            tally.add(episode)
        store.note(attempts=tally.episodes)
    return tally


@dataclass
class _RawStore:
    """The arrays of a DP3 store, with their shapes checked against each other."""

    path: Path
    arrays: dict[str, zarr.Array]  # by the names of `Episode`
    ends: np.ndarray
    attributes: dict[str, Any]
    notes: list[str] = field(default_factory=list)

    @classmethod
    def open(cls, path: Path) -> _RawStore:
        """Open the store at `path` to read; raise StoreError where it is none or an array is missing or damaged."""
        if not path.is_dir():
            raise StoreError(f"no store at {path}: name a folder that DP3 or ManiCM wrote, by custom something.zarr")
        names = {"point_cloud": "data/point_cloud", "agent_pos": "data/state", "action": "data/action"}
        found = {field: _array(path, name) for field, name in names.items()}
        ends = _array(path, "meta/episode_ends")
        if missing := [n for n, a in ((*found.items(), ("meta/episode_ends", ends))) if a is None]:
            wanted = ", ".join(names.get(n, n) for n in missing)
            raise StoreError(f"{path} is not a store of DP3's layout, or it is damaged: {wanted} cannot be read")
        arrays = {field: array for field, array in found.items() if array is not None}
        assert ends is not None
        raw = cls(path, arrays, _read(path, "meta/episode_ends", ends), _attributes(path))
        raw._check()
        raw._add_pictures()
        return raw

    @property
    def num_frames(self) -> int:
        return int(self.ends[-1])

    def episodes(self) -> Iterator[tuple[int, int]]:
        starts = np.concatenate([[0], self.ends[:-1]])
        yield from progress_of(list(zip(starts.tolist(), self.ends.tolist(), strict=True)), f"convert {self.path.name}")

    def read(self, field: str, start: int, stop: int) -> np.ndarray:
        return _read(self.path, field, self.arrays[field], slice(start, stop))

    def _check(self) -> None:
        if self.ends.ndim != 1 or not len(self.ends):
            raise StoreError(f"{self.path} holds no episodes: nothing to convert")
        if (np.diff(self.ends.astype(np.int64), prepend=0) <= 0).any():
            raise StoreError(f"{self.path} is damaged: meta/episode_ends does not grow")
        for name, array in self.arrays.items():
            axes = 3 if name == "point_cloud" else 2
            if array.ndim != axes or array.dtype.kind not in "fiu":
                raise StoreError(
                    f"{self.path}: {name} is {array.shape} {array.dtype} where {axes} axes of numbers belong"
                )
            if array.shape[0] < self.num_frames:
                raise StoreError(
                    f"{self.path} is damaged: {name} has {array.shape[0]} frames where meta/episode_ends gives "
                    f"{self.num_frames}"
                )
        if (channels := self.arrays["point_cloud"].shape[2]) not in (3, 6):
            raise StoreError(f"{self.path}: points have {channels} channels; 3 (xyz) or 6 (xyz, rgb) can be read")
        for name, array in self.arrays.items():  # zarr reads what is missing as zeros, without a word
            lost = array.nchunks - array.nchunks_initialized
            if lost and array.shape[0] == self.num_frames:  # longer ones may have been allocated ahead
                raise StoreError(f"{self.path} is damaged: {lost} of {array.nchunks} files of {name} are missing")

    def _add_pictures(self) -> None:
        """Take up pictures of a form that our stores have; others are left out with a note."""
        sizes: set[tuple[int, ...]] = set()
        for name, disk in _PICTURES.items():
            array = _array(self.path, f"data/{disk}")
            if array is None:
                continue
            kind, axes = (("u",), 4) if name == "image" else (("f",), 3)
            fits = array.dtype.kind in kind and array.ndim == axes and array.shape[0] >= self.num_frames
            if fits and (name != "image" or array.shape[3] == 3) and (not sizes or array.shape[1:3] in sizes):
                sizes.add(array.shape[1:3])
                self.arrays[name] = array
            else:
                self.notes.append(f"data/{disk} is {array.shape} {array.dtype}, which our stores do not hold: left out")


def _spec(raw: _RawStore, asked: Dp3Options) -> EnvSpec:
    """Return the spec of the new store: the environment's, or one made of shapes; refuse data that does not fit it."""
    channels = raw.arrays["point_cloud"].shape[2]
    if asked.colors and channels == 3:
        raise ConfigError(f"{raw.path} holds no colours: drop --colors")
    spec = _spec_of_shapes(raw, asked) if asked.env is None else ENVS.get(asked.env).spec
    picture = raw.arrays.get("image", raw.arrays.get("depth"))
    obs = replace(
        spec.obs,
        num_points=asked.num_points or spec.obs.num_points,
        point_channels=6 if asked.colors else 3,
        image_size=spec.obs.image_size if picture is None else (picture.shape[1], picture.shape[2]),
    )
    spec = replace(spec, obs=obs)
    for name, dim in (("agent_pos", spec.obs.agent_pos_dim), ("action", spec.action.dim)):
        if (has := raw.arrays[name].shape[1]) != dim:
            raise SpecMismatchError(
                f"{raw.path} is not of {spec.env_id}: its {name} has {has} entries where {spec.env_id} has {dim}; "
                "name the environment that it was collected in, or none"
            )
    if "env_spec" in raw.attributes:  # a store of ours, or of a tool that kept our attributes
        require_compatible(EnvSpec.from_dict(raw.attributes["env_spec"]), spec, str(raw.path), spec.env_id)
    return spec


def _spec_of_shapes(raw: _RawStore, asked: Dp3Options) -> EnvSpec:
    dim, action_dim = raw.arrays["agent_pos"].shape[1], raw.arrays["action"].shape[1]
    return EnvSpec(
        env_id=f"dp3/{raw.path.name.removesuffix('.zarr')}",
        obs=ObsSpec(raw.arrays["point_cloud"].shape[1], 3, dim, asked.frame or _FRAME),
        action=ActionSpec(tuple(f"action_{k}" for k in range(action_dim)), "unknown", asked.control_hz or _CONTROL_HZ),
        max_episode_steps=int(np.diff(raw.ends, prepend=0).max()),
        agent_pos_names=tuple(f"state_{k}" for k in range(dim)),
    )


def _episode(raw: _RawStore, spec: EnvSpec, number: int, start: int, stop: int, pictures: list[str]) -> Episode:
    action = raw.read("action", start, stop).astype(np.float32)
    if (reach := float(np.abs(action).max())) > 1 + _ACTION_SLACK:
        raise SpecMismatchError(
            f"{raw.path} is not of {spec.env_id}: an action of its episode {number} reaches {reach:.3g} where actions "
            "are normalised to [-1, 1]; divide them by the controller's scale first, or name another environment"
        )
    clouds = raw.read("point_cloud", start, stop).astype(np.float32)[..., : 6 if spec.obs.point_channels == 6 else 3]
    if spec.obs.point_channels == 6 and clouds[..., 3:].max() > 1:  # 0 to 255, as the simulators of DP3 give them
        clouds[..., 3:] /= 255
    extras: dict[str, Any] = {name: raw.read(name, start, stop) for name in pictures}
    return Episode(
        point_cloud=np.stack([_resampled(cloud, spec.obs.num_points) for cloud in clouds]),
        agent_pos=raw.read("agent_pos", start, stop).astype(np.float32),
        action=action.clip(-1, 1),
        seed=-1 - number,
        success=True,
        **extras,
    )


def _resampled(cloud: np.ndarray, num_points: int) -> np.ndarray:
    """Return (P, C) of the points (N, C) in farthest-point order, without those that only pad."""
    return sample_cloud(cloud[cloud[:, :3].any(axis=1)], num_points)


def _provenance(raw: _RawStore, asked: Dp3Options, spec: EnvSpec) -> dict[str, Any]:
    points = raw.arrays["point_cloud"].shape[1]
    return {
        "env_id": spec.env_id,
        "expert": "imported",
        "style": "dp3",
        "source": str(raw.path.absolute()),
        "source_attributes": raw.attributes,
        "points": f"{points} points of each frame resampled to {spec.obs.num_points} in farthest-point order",
        "assumed": "frame, units and meaning of entries as in env_spec; every episode solved",
        "command": asked.command,
        "versions": package_versions(),
    }


def _array(path: Path, name: str) -> zarr.Array | None:
    """Return an array of the store, or None where there is none that can be opened."""
    try:
        return zarr.open_array(str(path / name), mode="r", zarr_format=2)
    except Exception:  # zarr and json raise many kinds on what is not there or damaged
        return None


def _read(path: Path, name: str, array: zarr.Array, rows: slice = slice(None)) -> np.ndarray:
    try:
        return np.asarray(array[rows])
    except Exception as error:  # what zarr and the codecs raise on a damaged chunk
        raise StoreError(f"{path} is damaged: {name} cannot be read ({error})") from error


def _attributes(path: Path) -> dict[str, Any]:
    try:
        attributes = json.loads((path / ".zattrs").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return attributes if isinstance(attributes, dict) else {}
