"""Shapes, units, frames and conventions as data: the words that all parts of the package share.

Spelled once here, these specs travel with environments, demonstration stores and checkpoints, and are
compared before work starts instead of being trusted.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from manicm_ms.errors import ConfigError, SpecMismatchError, UnknownNameError, require_at_least

POINT_CLOUD = "point_cloud"
"""(P, 3) or (P, 6) float32: xyz in metres in `ObsSpec.frame`, then rgb in [0, 1]."""
AGENT_POS = "agent_pos"
"""(D,) float32: proprioception; `EnvSpec.agent_pos_names` says what each entry is, with its unit."""
IMAGE = "image"
"""(H, W, 3) uint8."""
DEPTH = "depth"
"""(H, W) float32, metres along the optical axis, 0 where nothing was hit."""
VOXEL_GRID = "voxel_grid"
"""(C, V, V, V) uint8: the task's crop box cut into V cells along x, y and z of `ObsSpec.frame`. Channel 0 is 255 where
a cell holds a point and 0 elsewhere; with coloured clouds C is 4, and the mean r, g, b of a cell's points follow."""
STATE = "state"
"""(S,) float32 privileged state, for experts and critics; `EnvSpec.state_layout` names its parts."""
ACTION = "action"
"""(Da,) float32, normalised to [-1, 1]."""

OBS_KEYS = (POINT_CLOUD, AGENT_POS, IMAGE, DEPTH, STATE, VOXEL_GRID)

WORLD_FRAME = "world"
DP3_FRAME = "dp3"
"""That of the public DP3 wrapper's clouds, which is neither the world nor the camera (`envs.mujoco_task.Dp3Frame`)."""
FRAMES = ("robot_base", WORLD_FRAME, DP3_FRAME)


@dataclass(frozen=True)
class ChunkSpec:
    """Which frames a policy reads, predicts and executes.

    For To = 2, Tp = 4, Ta = 3 (time runs right, t is the present frame)::

        frame       t-1   t   t+1  t+2
        observed     x    x
        predicted    x    x    x    x
        executed          x    x    x

    The first predicted action belongs to the oldest observed frame, so at most Tp - To + 1 of them
    lie at or after the present. (The public DP3 code slices past the end and silently plays fewer.)

    Attributes:
        n_obs_steps: To, frames read, the present one last.
        horizon: Tp, actions predicted.
        n_action_steps: Ta, actions executed from the present frame on.
    """

    n_obs_steps: int = 2
    horizon: int = 4
    n_action_steps: int = 3

    def __post_init__(self) -> None:
        require_at_least(1, n_obs_steps=self.n_obs_steps, horizon=self.horizon, n_action_steps=self.n_action_steps)
        most = self.horizon - self.n_obs_steps + 1
        if self.n_action_steps > most:
            raise ConfigError(
                f"n_action_steps={self.n_action_steps} exceeds horizon - n_obs_steps + 1 = {most}: "
                f"execute at most {most} actions or raise horizon (now {self.horizon})"
            )

    @property
    def executed(self) -> slice:
        """Indices of the executed actions within the predicted horizon."""
        return slice(self.n_obs_steps - 1, self.n_obs_steps - 1 + self.n_action_steps)


VOXEL_SIZE = 32
"""Cells along a side of a voxel grid where nothing is said: 64 is the published number, and 8 times the work."""


@dataclass(frozen=True)
class ObsSpec:
    """What one frame of observation holds.

    Attributes:
        num_points: P, points of the cloud.
        point_channels: 3 (xyz, metres) or 6 (xyz and rgb in [0, 1]).
        agent_pos_dim: D.
        frame: frame of the cloud, one of `FRAMES`.
        image_size: (H, W) of `image` and `depth`, pixels.
        voxel_size: V, cells along each side of `voxel_grid`.
    """

    num_points: int
    point_channels: int
    agent_pos_dim: int
    frame: str
    image_size: tuple[int, int] = (84, 84)
    voxel_size: int = VOXEL_SIZE

    def __post_init__(self) -> None:
        if self.frame not in FRAMES:
            raise ConfigError(f"frame {self.frame!r} is not one of {', '.join(FRAMES)}")
        if self.point_channels not in (3, 6):
            raise ConfigError(f"point_channels must be 3 (xyz) or 6 (xyz, rgb), got {self.point_channels}")
        require_at_least(1, voxel_size=self.voxel_size)

    def request(self, keys: Collection[str]) -> dict[str, Any]:
        """Return what `make_vec` is asked for so that the observations `keys` have these forms: name -> value.

        The size of a picture or a grid is left out where none is read: clouds may be rendered at the picture's size,
        and are made as ever.
        """
        asked: dict[str, Any] = {"num_points": self.num_points, "colors": self.point_channels == 6}
        if IMAGE in keys or DEPTH in keys:
            asked["image_size"] = self.image_size
        if VOXEL_GRID in keys:
            asked["voxel_size"] = self.voxel_size
        return asked


@dataclass(frozen=True)
class ActionSpec:
    """What an action means; entries are normalised to [-1, 1].

    Attributes:
        names: name of each entry, unit of its physical value in brackets.
        control_mode: controller that receives it.
        control_hz: actions per second.
    """

    names: tuple[str, ...]
    control_mode: str
    control_hz: float

    @property
    def dim(self) -> int:
        """Da, entries of an action."""
        return len(self.names)


ANY = -1
"""Length of an axis that may differ from one producer to another: the points of a cloud."""


class FieldSpec(NamedTuple):
    """What one frame of an observation is.

    Attributes:
        shape: of a frame; `ANY` for an axis whose length is not fixed.
        unit: of its values.
        frame: frame of reference, one of `FRAMES`, or "" where it has none.
        dtype: of its values.
        by_range: whether a policy maps each channel (the last axis) from its range in the demonstrations to [-1, 1];
            else the values have a fixed meaning, and the encoder that reads them scales them itself.
    """

    shape: tuple[int, ...]
    unit: str
    frame: str = ""
    dtype: str = "float32"
    by_range: bool = True


@dataclass(frozen=True)
class EnvSpec:
    """All that is fixed about an environment id.

    Attributes:
        env_id: for example "ur3e/slide-block".
        obs: what a frame holds.
        action: what an action means.
        max_episode_steps: control steps after which an episode is truncated.
        agent_pos_names: name and unit of each entry of `agent_pos`.
        tcp_indices: where in `agent_pos` the tool centre point's x, y, z (metres, in `obs.frame`)
            stand, or None where it is not known; needed by policies with `cloud_frame="tcp"`.
        state_layout: name -> (start, stop) of each part of the privileged `state`.
        success_rule: "any" (true at some step) or "last" (true at the last step).
    """

    env_id: str
    obs: ObsSpec
    action: ActionSpec
    max_episode_steps: int
    agent_pos_names: tuple[str, ...]
    tcp_indices: tuple[int, int, int] | None = None
    state_layout: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    success_rule: str = "any"

    def __post_init__(self) -> None:
        if len(self.agent_pos_names) != self.obs.agent_pos_dim:
            raise ConfigError(
                f"{self.env_id}: {len(self.agent_pos_names)} agent_pos_names for agent_pos_dim={self.obs.agent_pos_dim}"
            )
        if self.success_rule not in ("any", "last"):
            raise ConfigError(f"{self.env_id}: success_rule {self.success_rule!r} is neither 'any' nor 'last'")

    @property
    def state_dim(self) -> int:
        """S, entries of the privileged state."""
        return max((stop for _, stop in self.state_layout.values()), default=0)

    def observation(self, key: str) -> FieldSpec:
        """Return what one frame of the observation `key` is; raise UnknownNameError where there is no such key."""
        fields = {
            POINT_CLOUD: FieldSpec((ANY, self.obs.point_channels), "m", self.obs.frame),
            AGENT_POS: FieldSpec((self.obs.agent_pos_dim,), "as named"),
            IMAGE: FieldSpec((*self.obs.image_size, 3), "0 to 255", dtype="uint8", by_range=False),
            DEPTH: FieldSpec(self.obs.image_size, "m", by_range=False),
            STATE: FieldSpec((self.state_dim,), "as named"),
            VOXEL_GRID: FieldSpec(
                (4 if self.obs.point_channels == 6 else 1, *(self.obs.voxel_size,) * 3),
                "0 to 255", self.obs.frame, dtype="uint8", by_range=False,
            ),
        }  # fmt: skip
        if key not in fields:
            raise UnknownNameError("observation", key, fields)
        return fields[key]

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values; `from_dict` is its inverse.

        The size of voxel grids came later and is left out where it is the usual one: what was written down before, and
        identifies stores and runs, stays as it was.
        """
        values = asdict(self)
        if self.obs.voxel_size == VOXEL_SIZE:
            del values["obs"]["voxel_size"]
        return values

    @classmethod
    def from_dict(cls, d: Mapping[str, Any]) -> EnvSpec:
        """Build a spec from what `to_dict` returned (possibly after a JSON round trip)."""
        d = dict(d)
        obs = dict(d.pop("obs"))
        obs["image_size"] = tuple(obs["image_size"])
        action = dict(d.pop("action"))
        action["names"] = tuple(action["names"])
        tcp = d.pop("tcp_indices")
        layout = {k: tuple(v) for k, v in d.pop("state_layout").items()}
        return cls(
            obs=ObsSpec(**obs),
            action=ActionSpec(**action),
            tcp_indices=None if tcp is None else tuple(tcp),
            state_layout=layout,
            agent_pos_names=tuple(d.pop("agent_pos_names")),
            **d,
        )


# What a producer (environment, store) and a consumer (policy) must agree on.
_COMPARED = ("obs.point_channels", "obs.agent_pos_dim", "obs.frame", "agent_pos_names", "action.names",
             "action.control_mode", "action.control_hz", "tcp_indices")  # fmt: skip


def _field(spec: EnvSpec, dotted: str) -> Any:
    value: Any = spec
    for part in dotted.split("."):
        value = getattr(value, part)
    return value


def require_compatible(
    producer: EnvSpec, consumer: EnvSpec, producer_name: str, consumer_name: str, keys: Collection[str] = ()
) -> None:
    """Raise SpecMismatchError unless data of `producer` means what `consumer` was made for.

    The env ids may differ (a policy may be tried on a sibling task); shapes, names, frames, the
    control mode and the rate may not. The number of points may differ: encoders pool over points.
    Of pictures and grids only those that are read, `keys`, must have one size.
    """
    for dotted in _COMPARED:
        ours, theirs = _field(producer, dotted), _field(consumer, dotted)
        if ours != theirs:
            raise SpecMismatchError(
                f"{producer_name} and {consumer_name} do not fit: {dotted} is {ours!r} in the first and "
                f"{theirs!r} in the second; use data, checkpoint and environment of one task"
            )
    for key in keys:
        found, wanted = producer.observation(key).shape, consumer.observation(key).shape
        if found != wanted:
            raise SpecMismatchError(
                f"{producer_name} and {consumer_name} do not fit: {key} is {found} in the first and {wanted} in the "
                "second; use data, checkpoint and environment with frames of one size"
            )
