"""Randomness as a function of (seed, step), so that a resumed run draws what an uninterrupted one would have drawn."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_INDICES, _NOISE, _SUBSETS = 0, 1, 2  # branches of the seed, so that the streams are independent


class IndexStream:
    """Which samples each step sees: shuffled epochs laid end to end and cut into batches.

    Every sample appears exactly once an epoch, and a batch may span two epochs, so the size need not be a
    multiple of the batch.

    Args:
        size: number of samples.
        batch_size: B, samples of a batch over all ranks.
        seed: decides the order.
    """

    def __init__(self, size: int, batch_size: int, seed: int) -> None:
        self._size, self._batch_size, self._seed = size, batch_size, seed
        self._orders: dict[int, np.ndarray] = {}

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> Tensor:
        """Return the indices of `step` (counted from 0) that belong to `rank`: (B / world_size,) int64."""
        places = np.arange(step * self._batch_size, (step + 1) * self._batch_size)
        epochs, offsets = np.divmod(places, self._size)
        indices = np.empty(len(places), dtype=np.int64)
        for epoch in np.unique(epochs):
            here = epochs == epoch
            indices[here] = self._order(int(epoch))[offsets[here]]
        return torch.from_numpy(indices[rank::world_size])

    def _order(self, epoch: int) -> np.ndarray:
        if epoch not in self._orders:
            self._orders = {e: order for e, order in self._orders.items() if e == epoch - 1}
            self._orders[epoch] = np.random.default_rng([_INDICES, self._seed, epoch]).permutation(self._size)
        return self._orders[epoch]


def step_generator(seed: int, step: int, rank: int, device: torch.device | str) -> torch.Generator:
    """Return the generator, on `device`, of all noise that `rank` draws in `step`."""
    return _generator(device, _NOISE, seed, step, rank)


def subset_generator(seed: int, block: int, device: torch.device | str) -> torch.Generator:
    """Return the generator, on `device`, of the point subsets that are encoded before training, block by block."""
    return _generator(device, _SUBSETS, seed, block)


def _generator(device: torch.device | str, *key: int) -> torch.Generator:
    (state,) = np.random.SeedSequence(key).generate_state(1, np.uint64)
    return torch.Generator(device).manual_seed(int(state) >> 1)  # manual_seed takes 63 bits without wrapping
