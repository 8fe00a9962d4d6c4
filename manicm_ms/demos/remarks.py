"""What a user should know of demonstrations that are sound as files: values far outside, and parts left unused.

A remark is one line that holds the number and the likely cause: a unit, a frame, a stray reading, the horizon.
`inspect`, `convert` and `train` all say what is said here.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping

import numpy as np
from torch import Tensor

from manicm_ms.demos.layout import FIELD_OF_OBS, OPTIONAL_FIELDS, STORE_ARRAYS
from manicm_ms.demos.sequence_dataset import SequenceDataset, sequence_index
from manicm_ms.demos.store import DemoStore
from manicm_ms.demos.zarr_files import array_names, remark_missing
from manicm_ms.spec import ChunkSpec, EnvSpec
from manicm_ms.wording import counted

MOST_METRES = 10.0
"""Farther than this from its frame's origin no workspace, and no camera of one, has a point."""
MOST_DEPTH = 20.0  # m; a simulated room's walls are nearer
COLOR_SLACK = 1e-3  # of rounding, beyond [0, 1]
_LIMITS: Mapping[str, tuple[float, str]] = {
    "m": (MOST_METRES, "millimetres"),
    "rad": (4 * np.pi, "degrees"),
    "m/s": (20.0, "millimetres a second"),
    "rad/s": (50.0, "degrees a second"),
}
"""Unit -> the most that a robot's entry of this unit reaches, and the unit that it likely is in where it is more."""
_OUTER = (0.5, 99.5)  # per cent; what lies outside is rare
_FEWEST = 20  # frames, else one of them is no rarity
_STRETCH = 100.0  # a normalizer whose range is this many times that of 99 % of the values wastes it
_OUTER_POINTS = (0.05, 99.95)  # per cent of the coordinates of points, which are more, and crowd more evenly
_STRETCH_POINTS = 5.0
_FRAMES_LOOKED_AT = 100  # for where the bulk of the points is
_BLOCK_FRAMES = 512
_UNREMARKABLE = ("image", "voxel_grid", "privileged_state")  # any value may stand there: they are not even read
_SMALLEST = 5e-3  # m; no cloud of a scene is smaller


def store_remarks(store: DemoStore, frames: Mapping[str, np.ndarray] | None = None) -> list[str]:
    """Return the remarks about a store: missing files, foreign arrays, and what `field_remarks` finds.

    Args:
        store: open.
        frames: all frames of those fields that have been read already.
    """
    frames = frames or {}
    unread = set(array_names(store.path)) - STORE_ARRAYS
    remarks = [*remark_missing(store.missing_files), *unread_remarks(unread)]
    remarks += length_remarks(store.lengths, store.spec)
    for name in store.fields:
        if name not in _UNREMARKABLE:
            remarks += field_remarks(name, frames[name] if name in frames else store.frames(name), store.spec)
    return remarks


def unread_remarks(names: Collection[str]) -> list[str]:
    """Return the remark about arrays of a store that nothing reads."""
    return [f"not read: {', '.join(sorted(names))}"] if names else []


def length_remarks(lengths: np.ndarray, spec: EnvSpec) -> list[str]:
    """Return the remark about episodes, (E,) control steps, that are longer than their environment allows."""
    longer = lengths > spec.max_episode_steps
    if not longer.any():
        return []
    return [
        f"{counted(longer.sum(), 'episode')} of {len(lengths)} last up to {lengths.max()} steps, {spec.env_id} ends at "
        f"{spec.max_episode_steps}: likely another control rate than its {spec.action.control_hz:g} Hz"
    ]


def field_remarks(name: str, frames: np.ndarray, spec: EnvSpec) -> list[str]:
    """Return the remarks about all frames (F, ...) of a field of `Episode`; values that are not finite are ignored."""
    if name == "point_cloud":
        return list(_cloud(frames))
    if name == "depth":
        return list(_depth(frames))
    if name == "agent_pos":
        return [*_units(name, frames, spec.agent_pos_names), *_stray_entries(name, frames, spec.agent_pos_names)]
    if name == "action":
        return list(_idle(frames))
    return []


def empty_clouds(clouds: np.ndarray) -> np.ndarray:
    """Return which clouds of (F, P, C) hold nothing: all their points are equal, or the only one is 0; (F,) bool."""
    first = clouds[:, :1, :3] if clouds.shape[1] > 1 else 0
    return np.asarray((clouds[..., :3] == first).all(axis=(1, 2)))


def window_remarks(lengths: np.ndarray, chunk: ChunkSpec) -> list[str]:
    """Return the remarks about frames of episodes, (E,) control steps long, that no window of `chunk` reads."""
    remarks = []
    windows = np.array([len(sequence_index(np.array([n]), chunk)) for n in lengths])
    if unused := int((windows == 0).sum()):
        needed = chunk.horizon - (chunk.n_obs_steps - 1) - (chunk.n_action_steps - 1)
        remarks.append(
            f"not learnt from: {counted(unused, 'episode')} of {len(lengths)}, {lengths[windows == 0].sum()} frames"
            f", shorter than the {needed} frames that a horizon of {chunk.horizon} needs here"
        )
    unseen = chunk.horizon - chunk.n_obs_steps - (chunk.n_action_steps - 1)
    if unseen > 0 and unused < len(lengths):
        remarks.append(
            f"no decision is learnt at the last {counted(unseen, 'frame')} of each episode: a horizon of "
            f"{chunk.horizon} with {chunk.n_action_steps} actions executed reaches no later"
        )
    return remarks


def training_remarks(store: DemoStore, windows: SequenceDataset) -> list[str]:
    """Return the remarks about a store that is learnt from: all of `store_remarks`, and what stays unused.

    Args:
        store: open.
        windows: those of the store, on the CPU.
    """
    held = {FIELD_OF_OBS.get(key, key): v for key, v in windows.frames.items()}
    read = {name: values.numpy() for name, values in held.items() if isinstance(values, Tensor)}
    remarks = [*store_remarks(store, read), *window_remarks(store.lengths, windows.chunk)]
    if "point_cloud" in read and (empty := int(empty_clouds(read["point_cloud"]).sum())):
        remarks.append(f"{counted(empty, 'frame')} of {len(windows.action)} with an empty cloud: 'inspect' names them")
    if failed := int((~store.successes).sum()):
        remarks.append(f"{counted(failed, 'episode')} of {len(store)} not solved, and learnt from all the same")
    if idle := [name for name in OPTIONAL_FIELDS if name in store.fields and name not in held]:
        remarks.append(f"stored but not learnt from: {', '.join(idle)}")
    return remarks


def metres_remark(what: str, reach: float, share: float, most: float) -> str:
    """Return the line about lengths of which a `share` lies beyond `most` metres and the farthest reaches `reach`."""
    cause = "millimetres or a camera's units, not metres" if share > 0.01 else "stray readings of a camera"
    return f"{what} reaches {reach:.4g} m, {100 * share:.3g} % of it beyond {most:g} m: likely {cause}"


def _cloud(clouds: np.ndarray) -> Iterator[str]:
    far, points, low, high = 0, 0, np.full(clouds.shape[-1], np.inf), np.full(clouds.shape[-1], -np.inf)
    for block in _finite_blocks(clouds):
        least, greatest = block.min(axis=(0, 1)), block.max(axis=(0, 1))
        if max(-least[:3].min(), greatest[:3].max()) > MOST_METRES:
            far += int((np.abs(block[..., :3]) > MOST_METRES).any(axis=-1).sum())
        points += block[..., 0].size
        low, high = np.minimum(low, least), np.maximum(high, greatest)
    if not points:
        return
    if far:
        yield metres_remark("point_cloud", float(np.maximum(-low, high)[:3].max()), far / points, MOST_METRES)
    else:
        looked_at = np.linspace(0, len(clouds) - 1, min(len(clouds), _FRAMES_LOOKED_AT)).astype(int)
        bulk = next(_finite_blocks(clouds[looked_at, :, :3])).reshape(-1, 3)
        inner = np.percentile(bulk, _OUTER_POINTS, axis=0)
        yield from _stray("point_cloud", ("x (m)", "y (m)", "z (m)"), inner, (low[:3], high[:3]), _STRETCH_POINTS)
    if 0 < (extent := float((high - low)[:3].max())) < _SMALLEST:
        yield f"point_cloud spans {1000 * extent:.2g} mm in all: its unit is likely not the metre"
    if (low[3:] < -COLOR_SLACK).any() or (high[3:] > 1 + COLOR_SLACK).any():
        span = f"{low[3:].min():.3g} to {high[3:].max():.3g}"
        yield f"colours of point_cloud span {span} where [0, 1] is meant: likely bytes, 0 to 255"


def _depth(depth: np.ndarray) -> Iterator[str]:
    read, far, reach = 0, 0, 0.0
    for block in _finite_blocks(depth):
        read, far = read + int((block > 0).sum()), far + int((block > MOST_DEPTH).sum())
        reach = max(reach, float(block.max()))
    if far > read / 2:
        yield metres_remark("depth", reach, far / read, MOST_DEPTH)


def _finite_blocks(frames: np.ndarray) -> Iterator[np.ndarray]:
    """Yield frames (F, ...) block by block, zeros in place of what is not finite."""
    for start in range(0, len(frames), _BLOCK_FRAMES):
        block = frames[start : start + _BLOCK_FRAMES]
        finite = np.isfinite(block)
        yield block if finite.all() else np.where(finite, block, 0)


def _units(field: str, values: np.ndarray, names: tuple[str, ...]) -> Iterator[str]:
    """Yield a line for each unit, as in "x [m]", of which entries (F, D) reach more than a robot can."""
    reach = np.abs(np.where(np.isfinite(values), values, 0)).max(axis=0, initial=0)
    for unit, (most, likely) in _LIMITS.items():
        beyond = [(r, n) for r, n in zip(reach.tolist(), names, strict=True) if _unit(n) == unit and r > most]
        if beyond:
            worst, name = max(beyond)
            others = f" and {len(beyond) - 1} more entr{'y' if len(beyond) == 2 else 'ies'}" if len(beyond) > 1 else ""
            yield f"{name}{others} of {field} reaches {worst:.4g}, over {most:.3g} {unit}: likely {likely}"


def _stray_entries(field: str, values: np.ndarray, names: tuple[str, ...]) -> Iterator[str]:
    """Yield the lines of `_stray` about entries (F, D) of which there are enough to tell what is rare."""
    if len(values) >= _FEWEST:
        kept = np.where(np.isfinite(values), values, np.nan)
        inner = np.nanpercentile(kept, _OUTER, axis=0)
        yield from _stray(field, names, inner, (np.nanmin(kept, axis=0), np.nanmax(kept, axis=0)), _STRETCH)


def _stray(
    field: str, names: tuple[str, ...], inner: Iterable[np.ndarray], span: Iterable[np.ndarray], most: float
) -> Iterator[str]:
    """Yield a line for each channel of which rare values stretch the range that a normalizer maps to [-1, 1].

    Args:
        field: that the channels belong to.
        names: of the channels.
        inner: least and greatest of nearly all values, (C,) each.
        span: least and greatest of all values, (C,) each.
        most: how many times the first range the second one may be.
    """
    for name, low, high, least, greatest in zip(names, *inner, *span, strict=True):
        if high - low > 1e-4 and greatest - least > most * (high - low):
            share = 100 * (high - low) / (greatest - least)
            yield (
                f"{name} of {field} spans {least:.4g} to {greatest:.4g}, nearly all of it {low:.4g} to {high:.4g}: "
                f"likely stray values, which leave the rest {share:.2g} % of a normalizer's range"
            )


def _idle(actions: np.ndarray) -> Iterator[str]:
    if len(actions) > 1 and (actions == actions[0]).all():
        yield f"action never changes in {len(actions)} frames: an idle robot, or lost data"


def _unit(name: str) -> str:
    """Return what stands in brackets at the end of an entry's name, as "m" in "x [m]"."""
    found = re.search(r"[\[(]([^\[\]()]*)[\])]$", name)
    return found[1] if found else ""
