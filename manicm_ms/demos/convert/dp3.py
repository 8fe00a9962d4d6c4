"""From the zarr stores of DP3, ManiCM and diffusion_policy into ours.

Such a store says nothing about itself: not which environment it is of, nor what its numbers mean. What
can be checked is checked; what cannot (frames, units, the meaning of entries) is the user's word.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from manicm_ms.demos.convert.base import IMPORTERS, Tally
from manicm_ms.demos.convert.raw_store import OPTIONAL, RawStore
from manicm_ms.demos.convert.scales import Scales, decide
from manicm_ms.demos.layout import Episode
from manicm_ms.demos.remarks import store_remarks
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.paths import require_free_space
from manicm_ms.provenance import package_versions
from manicm_ms.sensing.depth_cloud import CLOUD_SIZE
from manicm_ms.sensing.point_cloud import sample_cloud
from manicm_ms.spec import ActionSpec, EnvSpec, ObsSpec, require_compatible

_FRAME, _CONTROL_HZ = "world", 10.0


@dataclass(frozen=True)
class Dp3Options:
    """How a DP3 store is to be read.

    Attributes:
        env: registered environment id that the data is of; None makes a spec from the store's shapes.
        num_points: P, points kept of each cloud; None for what the environment has, or the store.
        colors: keep rgb, where the store has it.
        frame: frame of the clouds, one of `types.FRAMES`, only where `env` is None; "world" if not given.
        control_hz: actions per second, only where `env` is None; 10 if not given.
        cloud_scale: metres of a unit of the clouds; None: metres, and clouds that cannot be are refused.
        depth_scale: metres of a unit of the depth images; None: metres, and images that cannot be are left out.
        action_scale: what actions are divided by, one number or one an entry; empty: they are in [-1, 1].
        command: command line, for the provenance.
    """

    env: str | None = None
    num_points: int | None = None
    colors: bool = False
    frame: str | None = None
    control_hz: float | None = None
    cloud_scale: float | None = None
    depth_scale: float | None = None
    action_scale: tuple[float, ...] = ()
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
    reading = Reading.of(source, asked)
    raw, spec = reading.raw, reading.spec
    frame_bytes = 4 * (spec.obs.num_points * spec.obs.point_channels + spec.obs.agent_pos_dim + spec.action.dim)
    require_free_space(folder, frame_bytes * raw.num_frames)
    tally = Tally(notes=["seeds and success are not known: seeds count down from -1, all count as solved", *raw.notes])
    with DemoStore.create(folder, spec, _provenance(raw, asked, spec), extras=reading.pictures) as store:
        for episode in reading.episodes():
            store.append(episode)
            tally.add(episode)
        store.note(attempts=tally.episodes)
        tally.notes += [*store_remarks(store), *(_frame_remarks(store, asked.env) if asked.env else [])]
    return tally


@dataclass(frozen=True)
class Reading:
    """A store of DP3's layout and all that is decided about how it is read.

    Attributes:
        raw: the store; its notes say what was decided.
        spec: of the store to be made.
        scales: of its numbers.
    """

    raw: RawStore
    spec: EnvSpec
    scales: Scales

    @classmethod
    def of(cls, source: Path, asked: Dp3Options) -> Reading:
        """Open the store at `source` and decide; raises as `read_dp3`."""
        raw = RawStore.open(source)
        spec = _spec(raw, asked)
        scales = decide(
            raw, colors=asked.colors, cloud_scale=asked.cloud_scale, depth_scale=asked.depth_scale,
            action_scale=asked.action_scale,
        )  # fmt: skip
        return cls(raw, _with_pictures(spec, raw), scales)

    @property
    def pictures(self) -> tuple[str, ...]:
        """The optional fields of `Episode` that are kept."""
        return tuple(name for name in OPTIONAL if name in self.raw.arrays)

    def episodes(self) -> Iterator[Episode]:
        """Yield the episodes in their order, with a progress bar; raise StoreError where one cannot be decoded."""
        for number, (start, stop) in enumerate(self.raw.episodes()):
            yield self._episode(number, start, stop)

    def _episode(self, number: int, start: int, stop: int) -> Episode:
        raw, obs = self.raw, self.spec.obs
        extras: dict[str, Any] = {name: raw.read(name, start, stop) for name in self.pictures}
        if "image" in extras:
            extras["image"] = extras["image"].astype(np.uint8)  # whole numbers from 0 to 255, of whatever type
        if "depth" in extras:
            extras["depth"] = self.scales.depth(extras["depth"])
        clouds = self.scales.cloud(raw.read("point_cloud", start, stop), obs.point_channels)
        return Episode(
            point_cloud=np.stack([_resampled(cloud, obs.num_points) for cloud in clouds]),
            agent_pos=raw.read("agent_pos", start, stop).astype(np.float32),
            action=self.scales.actions(raw.read("action", start, stop)),
            seed=-1 - number,
            success=True,
            **extras,
        )


def _spec(raw: RawStore, asked: Dp3Options) -> EnvSpec:
    """Return the spec of the new store: the environment's, or one made of shapes; refuse data that does not fit it."""
    _, points, channels = raw.arrays["point_cloud"].shape
    if asked.colors and channels == 3:
        raise ConfigError(f"{raw.path} holds no colours: drop --colors")
    most = max(points, math.prod(CLOUD_SIZE))
    if asked.num_points is not None and asked.num_points > most:
        raise ConfigError(
            f"--num-points {asked.num_points} exceeds {most}: the clouds of {raw.path} have {points} points, "
            f"of which a smaller number is kept, and a larger one made by repetition"
        )
    spec = _spec_of_shapes(raw, asked) if asked.env is None else ENVS.get(asked.env).spec
    obs = replace(
        spec.obs,
        num_points=asked.num_points or spec.obs.num_points,
        point_channels=6 if asked.colors else 3,
    )
    spec = replace(spec, obs=obs)
    for name, dim in (("agent_pos", spec.obs.agent_pos_dim), ("action", spec.action.dim)):
        if (has := raw.arrays[name].shape[1]) != dim:
            raise SpecMismatchError(
                f"{raw.path} is not of {spec.env_id}: its {name} has {has} entries where {spec.env_id} has {dim}; "
                "name the environment that it was collected in, or none"
            )
    if (kept := _kept_spec(raw)) is not None:
        require_compatible(kept, spec, str(raw.path), spec.env_id)
    return spec


def _kept_spec(raw: RawStore) -> EnvSpec | None:
    """Return the spec that a tool took over from a store of ours with its attributes, or None."""
    try:
        return EnvSpec.from_dict(raw.attributes["env_spec"])
    except (KeyError, TypeError, ValueError, AttributeError, ConfigError):  # none, or something else of that name
        return None


def _with_pictures(spec: EnvSpec, raw: RawStore) -> EnvSpec:
    """Return the spec with the size of the pictures that are kept."""
    picture = raw.arrays.get("image", raw.arrays.get("depth"))
    if picture is None:
        return spec
    return replace(spec, obs=replace(spec.obs, image_size=(picture.shape[1], picture.shape[2])))


def _spec_of_shapes(raw: RawStore, asked: Dp3Options) -> EnvSpec:
    dim, action_dim = raw.arrays["agent_pos"].shape[1], raw.arrays["action"].shape[1]
    return EnvSpec(
        env_id=f"dp3/{raw.path.name.removesuffix('.zarr')}",
        obs=ObsSpec(raw.arrays["point_cloud"].shape[1], 3, dim, asked.frame or _FRAME),
        action=ActionSpec(tuple(f"action_{k}" for k in range(action_dim)), "unknown", asked.control_hz or _CONTROL_HZ),
        max_episode_steps=int(np.diff(raw.ends, prepend=0).max()),
        agent_pos_names=tuple(f"state_{k}" for k in range(dim)),
    )


def _resampled(cloud: np.ndarray, num_points: int) -> np.ndarray:
    """Return (P, C) of the points (N, C) in farthest-point order, without those that only pad."""
    return sample_cloud(cloud[cloud[:, :3].any(axis=1)], num_points)


def _provenance(raw: RawStore, asked: Dp3Options, spec: EnvSpec) -> dict[str, Any]:
    points = raw.arrays["point_cloud"].shape[1]
    return {
        "env_id": spec.env_id,
        "expert": "imported",
        "style": "dp3",
        "source": str(raw.path.absolute()),
        "source_attributes": raw.attributes,
        "points": f"{points} points of each frame resampled to {spec.obs.num_points} in farthest-point order",
        "assumed": "frame, units and meaning of entries as in env_spec; every episode solved",
        "scales": {"cloud": asked.cloud_scale, "depth": asked.depth_scale, "action": list(asked.action_scale)},
        "notes": raw.notes,
        "command": asked.command,
        "versions": package_versions(),
    }


def _frame_remarks(store: DemoStore, env_id: str) -> list[str]:
    """Return the remark about clouds that lie mostly outside of their environment's workspace, where it has one."""
    from manicm_ms.envs.maniskill import workspace_of  # a simulator: seconds to import

    try:
        box = workspace_of(env_id)
    except ConfigError:  # the other suites' clouds are not cropped by one box
        return []
    inside, points = 0, 0
    for number in range(len(store)):
        xyz = store.episode(number).point_cloud[..., :3]
        inside += int(((xyz > np.array(box.low)) & (xyz < np.array(box.high))).all(axis=-1).sum())
        points += xyz[..., 0].size
    if inside > points / 2:
        return []
    return [
        f"{100 * inside / points:.2g} % of the points lie in the workspace of {env_id}, {box.low} to {box.high} m: "
        "likely another frame, or clouds that are not cropped"
    ]
