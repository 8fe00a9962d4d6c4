"""Slices of episodes that a policy learns from: what it reads and what it should predict, in memory or on the disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor

from manicm_ms.demos.layout import FIELD_OF_OBS
from manicm_ms.errors import ConfigError
from manicm_ms.spec import ACTION, AGENT_POS, POINT_CLOUD, ChunkSpec

if TYPE_CHECKING:
    from manicm_ms.demos.store import DemoStore


def sequence_index(episode_ends: np.ndarray, chunk: ChunkSpec) -> np.ndarray:
    """Return which frames each window holds.

    A window spans Tp consecutive frames and may begin up to To - 1 frames before its episode or end up to
    Ta - 1 frames after it; the missing frames repeat the episode's first or last one. For To = 2, Tp = 4,
    Ta = 3 and an episode of frames 0..4::

        first window      0  0  1  2
        last window       3  4  4  4

    This is `SequenceSampler` of diffusion_policy and DP3 with pad_before = To - 1 and pad_after = Ta - 1.

    Args:
        episode_ends: (E,) number of frames up to and including each episode, strictly growing.
        chunk: To, Tp, Ta.

    Returns:
        (N, Tp) int64 frame numbers, windows in order of episode and time.
    """
    before, after = chunk.n_obs_steps - 1, chunk.n_action_steps - 1
    steps = np.arange(chunk.horizon)
    rows = []
    begin = 0
    for end in np.asarray(episode_ends, dtype=np.int64):
        starts = np.arange(begin - before, end - chunk.horizon + after + 1)
        rows.append(np.clip(starts[:, None] + steps, begin, end - 1))  # (windows of this episode, Tp)
        begin = end
    return np.concatenate(rows) if rows else np.empty((0, chunk.horizon), dtype=np.int64)


CLOUD_KEYS = (POINT_CLOUD, AGENT_POS)
"""What every store holds, and most policies read."""
MOST_HELD_BYTES = 2 << 30
"""Pictures or grids that are held in memory: of more, batches are read from the disk."""


class Frames(Protocol):
    """All frames of one observation, of which some can be taken."""

    def __len__(self) -> int:
        """Return F."""

    def __getitem__(self, frames: Tensor) -> Tensor:
        """Return the frames (...) int64 as (..., *frame)."""

    def to(self, device: torch.device | str) -> Any:
        """Return the same, giving its frames on `device`."""


class StoredFrames:
    """Frames that stay on the disk until a batch asks for them.

    Args:
        read: returns the frames of these numbers, growing (K,) int64, as (K, ...).
        count: F.
        device: where what is taken goes.
    """

    def __init__(
        self, read: Callable[[np.ndarray], np.ndarray], count: int, device: torch.device | str = "cpu"
    ) -> None:
        self._read, self._count, self._device = read, count, device

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, frames: Tensor) -> Tensor:
        wanted, place = torch.unique(frames.cpu(), return_inverse=True)
        read = torch.from_numpy(np.ascontiguousarray(self._read(wanted.numpy())))
        return read.to(self._device)[place.to(self._device)]

    def to(self, device: torch.device | str) -> StoredFrames:
        """Return the same frames, taken onto `device`."""
        return StoredFrames(self._read, self._count, device)


class JoinedFrames:
    """Frames of several stores, those of the first before those of the second.

    Args:
        parts: at least one of them on the disk; the others may be held in memory.
    """

    def __init__(self, parts: Sequence[Frames]) -> None:
        self._parts = tuple(parts)
        self._starts = np.cumsum([0, *map(len, parts)]).tolist()

    def __len__(self) -> int:
        return self._starts[-1]

    def __getitem__(self, frames: Tensor) -> Tensor:
        flat, taken = frames.flatten(), None
        for part, start, stop in zip(self._parts, self._starts, self._starts[1:], strict=False):
            here = (flat >= start) & (flat < stop)
            if here.any():
                found = part[flat[here] - start]
                if taken is None:
                    taken = found.new_empty((len(flat), *found.shape[1:]))
                taken[here.to(found.device)] = found
        assert taken is not None, "no frame was asked for"
        return taken.unflatten(0, frames.shape)

    def to(self, device: torch.device | str) -> JoinedFrames:
        """Return the same frames, taken onto `device`."""
        return JoinedFrames([part.to(device) for part in self._parts])


def frames_of(store: DemoStore, key: str, most_bytes: int | None = None) -> Tensor | StoredFrames:
    """Return the committed frames of an observation, or of the actions, in the type that they are stored in.

    Pictures and grids of more than `most_bytes` (None: `MOST_HELD_BYTES`) stay on the disk; what is scaled by its range
    is held in memory.
    """
    field, count = FIELD_OF_OBS.get(key, key), store.num_frames
    most = MOST_HELD_BYTES if most_bytes is None else most_bytes
    if key == ACTION or store.spec.observation(key).by_range or store.frame_bytes(field) * count <= most:
        return torch.from_numpy(store.frames(field, 0, count))
    return StoredFrames(partial(store.frames_at, field), count)


@dataclass(frozen=True)
class SequenceDataset:
    """All windows of a demonstration store, on one device.

    Attributes:
        frames: observation key, and `action` -> its frames of all episodes one after another, (F, ...) in the type and
            unit of the store: tensors, or what reads them from the disk.
        index: (N, Tp) int64, frames of each window; see `sequence_index`.
        chunk: To, Tp, Ta.
    """

    frames: Mapping[str, Tensor | StoredFrames | JoinedFrames]
    index: Tensor
    chunk: ChunkSpec

    def __post_init__(self) -> None:
        lengths = {len(values) for values in self.frames.values()}
        if len(lengths) != 1:
            names = list(self.frames)
            raise ConfigError(f"{', '.join(names[:-1])} and {names[-1]} differ in length: {sorted(lengths)} frames")
        if len(self.index) == 0:
            raise ConfigError(
                f"no window of horizon {self.chunk.horizon} fits into these {max(lengths)} frames of demonstrations: "
                "collect more episodes or lower the horizon"
            )

    @classmethod
    def from_arrays(
        cls,
        point_cloud: np.ndarray,
        agent_pos: np.ndarray,
        action: np.ndarray,
        episode_ends: np.ndarray,
        chunk: ChunkSpec,
    ) -> SequenceDataset:
        """Copy arrays of F frames into tensors and index their windows.

        Args:
            point_cloud: (F, P, C), metres (and colours).
            agent_pos: (F, D).
            action: (F, Da), normalised to [-1, 1].
            episode_ends: (E,), one past the last frame of each episode.
            chunk: To, Tp, Ta.
        """
        arrays = {POINT_CLOUD: point_cloud, AGENT_POS: agent_pos, ACTION: action}
        frames = {key: torch.tensor(np.asarray(array), dtype=torch.float32) for key, array in arrays.items()}
        return cls(frames, torch.from_numpy(sequence_index(episode_ends, chunk)), chunk)

    @classmethod
    def from_store(
        cls,
        store: DemoStore,
        chunk: ChunkSpec,
        keys: Sequence[str] = CLOUD_KEYS,
        most_bytes: int | None = None,
    ) -> SequenceDataset:
        """Index the windows of `store` and read every committed frame of the observations `keys` and of the actions.

        A large observation stays on the disk; see `frames_of`.

        Raises:
            StoreError: the store does not hold one of the observations.
        """
        frames = {key: frames_of(store, key, most_bytes) for key in (*keys, ACTION)}
        return cls(frames, torch.from_numpy(sequence_index(store.episode_ends, chunk)), chunk)

    @classmethod
    def joined(cls, parts: Sequence[SequenceDataset]) -> SequenceDataset:
        """Return the windows of several stores as those of one: frames one after another, no window across stores."""
        starts = np.cumsum([0, *(len(part.action) for part in parts)]).tolist()
        frames = {key: _joined([part.frames[key] for part in parts]) for key in parts[0].frames}
        index = torch.cat([part.index + start for part, start in zip(parts, starts, strict=False)])
        return cls(frames, index, parts[0].chunk)

    @property
    def action(self) -> Tensor:
        """(F, Da) float32, normalised to [-1, 1]."""
        return self.frames[ACTION]  # type: ignore[return-value]  # never on the disk: it is small

    @property
    def point_cloud(self) -> Tensor:
        """(F, P, C) float32, metres (and colours); of a data set that holds clouds in memory."""
        return self.frames[POINT_CLOUD]  # type: ignore[return-value]

    @property
    def agent_pos(self) -> Tensor:
        """(F, D) float32; of a data set that holds it."""
        return self.frames[AGENT_POS]  # type: ignore[return-value]

    def __len__(self) -> int:
        """Return N, the number of windows."""
        return len(self.index)

    def to(self, device: torch.device | str) -> SequenceDataset:
        """Return the same windows on `device`; what stays on the disk is moved there batch by batch."""
        frames = {key: values.to(device) for key, values in self.frames.items()}
        return replace(self, frames=frames, index=self.index.to(device))

    def batch(self, indices: Tensor) -> dict[str, Tensor]:
        """Return the windows with these numbers.

        Args:
            indices: (B,) int64, each in [0, N).

        Returns:
            Each observation as (B, To, ...) in its own type, "action" (B, Tp, Da) float32.
        """
        frames = self.index[indices.to(self.index.device)]  # (B, Tp)
        observed = frames[:, : self.chunk.n_obs_steps]  # (B, To)
        return {key: values[frames if key == ACTION else observed] for key, values in self.frames.items()}


def _joined(parts: Sequence[Tensor | StoredFrames | JoinedFrames]) -> Tensor | JoinedFrames:
    held = [part for part in parts if isinstance(part, Tensor)]
    return torch.cat(held) if len(held) == len(parts) else JoinedFrames(parts)
