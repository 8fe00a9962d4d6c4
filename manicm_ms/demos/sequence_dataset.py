"""Slices of episodes that a policy learns from: what it reads and what it should predict, held in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

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


@dataclass(frozen=True)
class SequenceDataset:
    """All windows of a demonstration store, as tensors on one device.

    Attributes:
        point_cloud: (F, P, C) float32, metres (and colours), frames of all episodes one after another.
        agent_pos: (F, D) float32.
        action: (F, Da) float32, normalised to [-1, 1].
        index: (N, Tp) int64, frames of each window; see `sequence_index`.
        chunk: To, Tp, Ta.
    """

    point_cloud: Tensor
    agent_pos: Tensor
    action: Tensor
    index: Tensor
    chunk: ChunkSpec

    def __post_init__(self) -> None:
        frames = {len(self.point_cloud), len(self.agent_pos), len(self.action)}
        if len(frames) != 1:
            raise ConfigError(f"point_cloud, agent_pos and action differ in length: {sorted(frames)} frames")
        if len(self.index) == 0:
            raise ConfigError(
                f"no window of horizon {self.chunk.horizon} fits into these {max(frames)} frames of demonstrations: "
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
        """Copy arrays of F frames (shapes as the attributes') into tensors and index their windows."""
        return cls(
            point_cloud=torch.tensor(np.asarray(point_cloud), dtype=torch.float32),
            agent_pos=torch.tensor(np.asarray(agent_pos), dtype=torch.float32),
            action=torch.tensor(np.asarray(action), dtype=torch.float32),
            index=torch.from_numpy(sequence_index(episode_ends, chunk)),
            chunk=chunk,
        )

    @classmethod
    def from_store(cls, store: DemoStore, chunk: ChunkSpec) -> SequenceDataset:
        """Read every committed frame of `store` and index its windows."""
        ends = np.asarray(store.episode_ends)
        frames = int(ends[-1]) if len(ends) else 0
        return cls.from_arrays(store.point_cloud[:frames], store.state[:frames], store.action[:frames], ends, chunk)

    @classmethod
    def joined(cls, parts: Sequence[SequenceDataset]) -> SequenceDataset:
        """Return the windows of several stores as those of one: frames one after another, no window across stores."""
        starts = np.cumsum([0, *(len(part.action) for part in parts)]).tolist()
        fields = {name: torch.cat([getattr(part, name) for part in parts]) for name in (POINT_CLOUD, AGENT_POS, ACTION)}
        index = torch.cat([part.index + start for part, start in zip(parts, starts, strict=False)])
        return cls(**fields, index=index, chunk=parts[0].chunk)

    def __len__(self) -> int:
        """Return N, the number of windows."""
        return len(self.index)

    def to(self, device: torch.device | str) -> SequenceDataset:
        """Return the same windows with all tensors on `device`."""
        moved = {name: getattr(self, name).to(device) for name in ("point_cloud", "agent_pos", "action", "index")}
        return replace(self, **moved)

    def batch(self, indices: Tensor) -> dict[str, Tensor]:
        """Return the windows with these numbers.

        Args:
            indices: (B,) int64, each in [0, N).

        Returns:
            "point_cloud" (B, To, P, C), "agent_pos" (B, To, D), "action" (B, Tp, Da), float32.
        """
        frames = self.index[indices.to(self.index.device)]  # (B, Tp)
        observed = frames[:, : self.chunk.n_obs_steps]  # (B, To)
        return {
            POINT_CLOUD: self.point_cloud[observed],
            AGENT_POS: self.agent_pos[observed],
            ACTION: self.action[frames],
        }
