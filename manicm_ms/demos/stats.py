"""Ranges and moments of each channel of a demonstration store, from which a policy builds its normalizer."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from manicm_ms.demos.layout import FIELD_OF_OBS
from manicm_ms.errors import StoreError
from manicm_ms.spec import ACTION, AGENT_POS, POINT_CLOUD

if TYPE_CHECKING:
    from manicm_ms.demos.store import DemoStore

_BLOCK_FRAMES = 512  # frames read at a time: 512 clouds of 512 coloured points are 6 MB


@dataclass(frozen=True)
class FieldStats:
    """Statistics of one field, a value per channel (the last axis), in the field's own unit.

    Attributes:
        min: (C,) float32.
        max: (C,) float32.
        mean: (C,) float32.
        std: (C,) float32, of the population (divided by n, not n - 1).
    """

    min: np.ndarray
    max: np.ndarray
    mean: np.ndarray
    std: np.ndarray


def field_stats(array: Any, name: str = "array") -> FieldStats:
    """Return the statistics of each channel over all other axes.

    Reads `array` in blocks of frames, so it may be a zarr array larger than memory. The moments are merged
    block by block in float64 (Chan, Golub and LeVeque 1983), which neither overflows nor cancels.

    Args:
        array: (F, ..., C) NumPy or zarr array with at least one frame.
        name: what an error message calls it.

    Raises:
        StoreError: the array is empty or holds NaN or infinity.
    """
    channels = array.shape[-1]
    low, high = np.full(channels, np.inf), np.full(channels, -np.inf)
    count, mean, squares = 0, np.zeros(channels), np.zeros(channels)
    for begin in range(0, array.shape[0], _BLOCK_FRAMES):
        block = np.asarray(array[begin : begin + _BLOCK_FRAMES], dtype=np.float64).reshape(-1, channels)
        if not np.isfinite(block).all():
            raise StoreError(
                f"{name} holds NaN or infinity between frames {begin} and {begin + _BLOCK_FRAMES}: "
                "collect these demonstrations again ('manicm-ms inspect' names the episode)"
            )
        low, high = np.minimum(low, block.min(axis=0)), np.maximum(high, block.max(axis=0))
        total = count + len(block)
        shift = block.mean(axis=0) - mean
        squares += ((block - block.mean(axis=0)) ** 2).sum(axis=0) + shift**2 * count * len(block) / total
        mean += shift * len(block) / total
        count = total
    if count == 0:
        raise StoreError(f"{name} is empty: collect demonstrations first")
    low, high, mean, std = (a.astype(np.float32) for a in (low, high, mean, np.sqrt(squares / count)))
    return FieldStats(low, high, mean, std)


def store_stats(store: DemoStore, keys: Iterable[str] = (POINT_CLOUD, AGENT_POS)) -> dict[str, FieldStats]:
    """Return the statistics over all committed frames of `store` of its actions and of those `keys` that need them.

    An observation whose values have a fixed meaning, as pictures and grids, needs none (`FieldSpec.by_range`).
    """
    ranged = [key for key in keys if store.spec.observation(key).by_range]
    return {key: field_stats(store.frames(FIELD_OF_OBS.get(key, key)), key) for key in (*ranged, ACTION)}
