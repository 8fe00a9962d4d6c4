"""How the numbers of a foreign store become ours: one decision for the whole store, never one an episode."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from manicm_ms.demos.convert.raw_store import POINT_CLOUD, RawStore
from manicm_ms.demos.remarks import COLOR_SLACK, MOST_DEPTH, MOST_METRES, empty_clouds, metres_remark
from manicm_ms.errors import ConfigError, SpecMismatchError, StoreError

_ACTION_SLACK = 1e-5  # of rounding, beyond [-1, 1]
_BYTE = 255.0
_RARE = 1e-3  # share of colours above 1 that are strays among colours in [0, 1]; of bytes most are above 1


@dataclass(frozen=True)
class Scales:
    """What the numbers of a store are multiplied by or divided by.

    Attributes:
        metres: of a unit of the clouds.
        color: what rgb is divided by, 1 or 255.
        action: (Da,) what actions are divided by.
        depth_metres: of a unit of the depth images.
    """

    metres: float
    color: float
    action: np.ndarray
    depth_metres: float

    def cloud(self, points: np.ndarray, channels: int) -> np.ndarray:
        """Return points (..., 3 or 6) of the store as (..., `channels`) float32: metres, then rgb in [0, 1]."""
        xyz = points[..., :3] if self.metres == 1 else points[..., :3] * self.metres
        if channels == 3:
            return xyz.astype(np.float32)
        rgb = points[..., 3:6] if self.color == 1 else points[..., 3:6] / self.color
        return np.concatenate([xyz, rgb.clip(0, 1)], axis=-1).astype(np.float32)

    def actions(self, actions: np.ndarray) -> np.ndarray:
        """Return actions (..., Da) of the store in [-1, 1], float32."""
        scaled = actions if (self.action == 1).all() else actions / self.action
        return scaled.astype(np.float32).clip(-1, 1)

    def depth(self, depth: np.ndarray) -> np.ndarray:
        """Return depth images of the store in metres, float32."""
        return (depth if self.depth_metres == 1 else depth * self.depth_metres).astype(np.float32)


def decide(
    raw: RawStore,
    *,
    colors: bool,
    cloud_scale: float | None = None,
    depth_scale: float | None = None,
    action_scale: Sequence[float] = (),
) -> Scales:
    """Look at every number of a store and decide how all of it is read; what is decided goes into `raw.notes`.

    Args:
        raw: the store; pictures and depth that cannot be kept to the bit are left out of it.
        colors: whether rgb is wanted.
        cloud_scale: metres of a unit of the clouds, None: metres, and what cannot be metres is refused.
        depth_scale: metres of a unit of the depth, None: metres, and what cannot be metres is left out.
        action_scale: what actions are divided by, one number or one an entry; empty: they are normalised.

    Raises:
        SpecMismatchError: numbers that are not what our stores hold and that no scale was given for.
        StoreError: a value that is not finite, or a cloud without a point.
        ConfigError: a scale that is not positive, or not one an entry.
    """
    for name, scale in (("cloud", cloud_scale), ("depth", depth_scale), *(("action", s) for s in action_scale)):
        if scale is not None and not 0 < scale < np.inf:
            raise ConfigError(f"--{name}-scale must be positive, got {scale}")
    _look_at_state(raw)
    action = _action_scale(raw, action_scale)
    facts = _look_at_clouds(raw, channels=6 if colors else 3)
    metres = _metres(raw, facts, cloud_scale)
    _keep_pictures(raw)
    return Scales(metres, _color_scale(raw, facts) if colors else _no_colors(raw), action, _depth(raw, depth_scale))


@dataclass
class _CloudFacts:
    """What all points of a store come to."""

    points: int = 0
    padding: int = 0  # points at the origin
    far: int = 0  # points that are nowhere in a scene, were they metres
    reach: float = 0.0
    rgb_low: float = np.inf
    rgb_high: float = -np.inf
    rgb_above: int = 0  # values above 1
    rgb_values: int = 0
    rgb_whole: bool = True

    def add(self, xyz: np.ndarray, rgb: np.ndarray) -> np.ndarray:
        """Count clouds (F, P, 3) and colours (F, P, 3 or 0); return which frames are empty clouds, (F,) bool."""
        size, at_origin = np.abs(xyz.astype(np.float64)).max(axis=-1), (xyz == 0).all(axis=-1)
        self.points += size.size
        self.padding += int(at_origin.sum())
        self.far += int((size > MOST_METRES).sum())
        self.reach = max(self.reach, float(size.max()))
        self.rgb_values += rgb.size
        if rgb.size:
            self.rgb_low, self.rgb_high = min(self.rgb_low, float(rgb.min())), max(self.rgb_high, float(rgb.max()))
        self.rgb_above += int((rgb > 1 + COLOR_SLACK).sum())
        self.rgb_whole = self.rgb_whole and bool((rgb == np.floor(rgb)).all())
        return empty_clouds(xyz)


def _look_at_clouds(raw: RawStore, channels: int) -> _CloudFacts:
    facts = _CloudFacts()
    empty: list[int] = []
    for start, block in raw.blocks("point_cloud"):
        block = block[..., :channels]
        _require_finite(raw, POINT_CLOUD, start, block)
        empty += (start + np.flatnonzero(facts.add(block[..., :3], block[..., 3:]))).tolist()
    if empty:
        raise StoreError(
            f"{raw.path}: {POINT_CLOUD} holds an empty cloud, all points equal, in {len(empty)} of {raw.num_frames} "
            f"frames, the first is {raw.place(empty[0])}{raw.say_missing()}"
        )
    if facts.padding:
        raw.notes.append(f"{facts.padding} of {facts.points} points are at exactly (0, 0, 0), as padding is: dropped")
    return facts


def _look_at_state(raw: RawStore) -> None:
    for start, block in raw.blocks("agent_pos"):
        _require_finite(raw, "data/state", start, block)


def _metres(raw: RawStore, facts: _CloudFacts, given: float | None) -> float:
    if given is not None:
        return given
    share = facts.far / facts.points
    if share > 0.01:
        remark = metres_remark(POINT_CLOUD, facts.reach, share, MOST_METRES)
        raise SpecMismatchError(f"{raw.path}: {remark}; --cloud-scale 0.001 reads millimetres, --cloud-scale 1 metres")
    return 1.0


def _color_scale(raw: RawStore, facts: _CloudFacts) -> float:
    span = f"colours of {facts.rgb_low:.4g} to {facts.rgb_high:.4g}"
    if facts.rgb_low < -COLOR_SLACK or facts.rgb_high > _BYTE:
        raise SpecMismatchError(f"{raw.path}: {span}, where 0 to 1 and 0 to 255 can be read: leave out --colors")
    if facts.rgb_high > 1 + COLOR_SLACK and (facts.rgb_whole or facts.rgb_above > _RARE * facts.rgb_values):
        raw.notes.append(f"{span} are read as 0 to 255: divided by 255")
        return _BYTE
    over = f", what is above 1, up to {facts.rgb_high:.7g}, cut to 1" if facts.rgb_high > 1 else ""
    raw.notes.append(f"{span} are read as 0 to 1{over}")
    return 1.0


def _no_colors(raw: RawStore) -> float:
    if raw.arrays["point_cloud"].shape[2] == 6:
        raw.notes.append("left out: rgb of the points; --colors keeps it")
    return 1.0


def _action_scale(raw: RawStore, given: Sequence[float]) -> np.ndarray:
    dim = raw.arrays["action"].shape[1]
    if given and len(given) not in (1, dim):
        raise ConfigError(f"--action-scale has {len(given)} numbers where actions have {dim} entries: give 1 or {dim}")
    scale = np.broadcast_to(np.array(given or (1.0,), np.float64), (dim,))
    reach = np.zeros(dim)
    for start, block in raw.blocks("action"):
        _require_finite(raw, "data/action", start, block)
        reach = np.maximum(reach, np.abs(block.astype(np.float64)).max(axis=0))
    if (worst := float((reach / scale).max())) > 1 + _ACTION_SLACK:
        most = float(f"{1.005 * reach.max():.3g}")  # rounded up
        scaled = "divided by --action-scale, an action still" if given else "an action"
        raise SpecMismatchError(
            f"{raw.path}: {scaled} reaches {worst:.3g} where actions are normalised to [-1, 1]: give "
            f"--action-scale {most:g}, or {dim} numbers, to divide them; with --env, the scales of its controller"
        )
    if given:
        divisors = ", ".join(f"{s:g}" for s in given)
        raw.notes.append(f"actions are divided by {divisors}: multiply those of a policy that learns from them")
    return scale


def _keep_pictures(raw: RawStore) -> None:
    """Keep pictures whose values are bytes, whatever their type; leave out others."""
    if "image" not in raw.arrays or (kind := raw.arrays["image"].dtype) == np.uint8:
        return
    low, high, whole = np.inf, -np.inf, True
    for _, block in raw.blocks("image"):
        if not np.isfinite(block).all():
            raw.leave_out("image", "which holds NaN or infinity")
            return
        low, high = min(low, float(block.min())), max(high, float(block.max()))
        whole = whole and bool((block == np.floor(block)).all())
    if whole and low >= 0 and high <= _BYTE:
        raw.notes.append(f"data/img is {kind} of whole numbers {low:g} to {high:g}: kept as uint8")
    else:
        raw.leave_out(
            "image", f"{kind} of {low:g} to {high:g} where pictures of 8 bits, whole numbers 0 to 255, are kept"
        )


def _depth(raw: RawStore, given: float | None) -> float:
    """Return the metres of a unit of depth; leave out depth that cannot be metres."""
    if "depth" not in raw.arrays:
        if given is not None:
            raise ConfigError(f"{raw.path} holds no depth that can be kept: drop --depth-scale")
        return 1.0
    kind, keep = raw.arrays["depth"].dtype, "--depth-scale 0.001 keeps it as millimetres"
    if kind.kind != "f" and given is None:
        raw.leave_out("depth", f"{kind}, a camera's units: {keep}")
        return 1.0
    read, far, reach = 0, 0, 0.0
    for _, block in raw.blocks("depth"):
        if not np.isfinite(block).all() or (block < 0).any():
            raw.leave_out("depth", "which holds NaN, infinity or negative values")
            return 1.0
        read, far = read + int((block > 0).sum()), far + int((block > MOST_DEPTH).sum())
        reach = max(reach, float(block.max()))
    if given is None and far > read / 2:
        raw.leave_out("depth", f"{metres_remark('which', reach, far / read, MOST_DEPTH)}: {keep}")
    return 1.0 if given is None else given


def _require_finite(raw: RawStore, name: str, start: int, block: np.ndarray) -> None:
    """Raise StoreError where a value is not finite, or not as the float32 that it becomes."""
    with np.errstate(over="ignore"):
        finite = np.isfinite(block.astype(np.float32)).all(axis=tuple(range(1, block.ndim)))
    if not finite.all():
        first = start + int(np.flatnonzero(~finite)[0])
        raise StoreError(
            f"{raw.path}: {name} holds NaN or infinity, first in {raw.place(first)}: mend or leave out that "
            f"episode{raw.say_missing()}"
        )
