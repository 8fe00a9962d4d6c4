"""Which points are read of a cloud that holds more than the network reads: the choices for acting and for training."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from manicm_ms.registry import Registry


class PointChoice(Protocol):
    """Chooses `count` of the P points of each cloud, at most as many as there are."""

    @property
    def varies(self) -> bool:
        """Whether another draw gives other points."""

    def acting(self, cloud: Tensor, count: int, noise: Tensor) -> Tensor:
        """Return what a policy reads when it acts.

        Args:
            cloud: (B, To, P, C).
            count: points to read.
            noise: (B, Tp, Da), the Gaussian noise that this decision starts from: the only source of chance, so
                that one seed means one action, and two policies that are given the same noise read the same points.

        Returns:
            (B, To, count, C); one row's choice depends on its own noise alone, and its To frames share it.
        """

    def training(self, cloud: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Return (B, To, count, C) of a training batch (B, To, P, C); `generator` is on its device."""


POINT_CHOICES: Registry[PointChoice] = Registry("choice of points")


class Prefix:
    """The first points: in farthest-point order (decision 0006) they are themselves an even sample."""

    varies = False

    def acting(self, cloud: Tensor, count: int, noise: Tensor) -> Tensor:
        """Return the prefix (B, To, count, C)."""
        del noise
        return cloud[:, :, :count]

    def training(self, cloud: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Return the prefix (B, To, count, C)."""
        del generator
        return cloud[:, :, :count]


class RandomPoints:
    """Points drawn without replacement, all subsets equally likely."""

    varies = True

    def acting(self, cloud: Tensor, count: int, noise: Tensor) -> Tensor:
        """Return (B, To, count, C), drawn by a hash of each row's noise; the noise itself is not used up."""
        rows, frames, available, channels = cloud.shape
        chosen = _hashed_order(noise, available)[:, :count].to(cloud.device)  # (B, count)
        return cloud.gather(2, chosen[:, None, :, None].expand(rows, frames, count, channels))

    def training(self, cloud: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Return (B, To, count, C), the same places in each cloud of the batch."""
        chosen = torch.randperm(cloud.shape[2], generator=generator, device=cloud.device)[:count]
        return cloud.index_select(2, chosen)


POINT_CHOICES.add("prefix", Prefix())
POINT_CHOICES.add("random", RandomPoints())

_WORD = 0xFFFFFFFF
_STEP = 0x9E3779B9  # 2^32 / golden ratio: spreads consecutive counters over all words


def _hashed_order(noise: Tensor, size: int) -> Tensor:
    """Return a permutation of range(size) for each row, (B, size) int64: a function of that row's noise (B, ...)."""
    bits = noise.float().flatten(1).contiguous().view(torch.int32).long() & _WORD  # (B, Tp Da)
    key = _mixed(bits + _STEP * torch.arange(bits.shape[1], device=bits.device)).sum(1)  # (B,)
    places = _STEP * torch.arange(size, device=bits.device)
    return _mixed(_mixed(key)[:, None] + places).argsort(dim=1)  # the mixing is one-to-one: no ties


def _mixed(words: Tensor) -> Tensor:
    """Scramble the low 32 bits of each int64 one-to-one (the finaliser of MurmurHash3, A. Appleby)."""
    words = words & _WORD
    words = ((words ^ (words >> 16)) * 0x85EBCA6B) & _WORD
    words = ((words ^ (words >> 13)) * 0xC2B2AE35) & _WORD
    return words ^ (words >> 16)
