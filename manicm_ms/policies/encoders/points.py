"""Which points are read of a cloud that holds more than the network reads: the choices for acting and for training."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.transform import TRANSFORMS, InputTransform, Obs
from manicm_ms.registry import Registry
from manicm_ms.spec import POINT_CLOUD, EnvSpec


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


@dataclass(frozen=True)
class PointSubsetConfig:
    """How many points of a cloud are read, and which.

    Attributes:
        max_points: so many points of a cloud are read, all where None.
        acting: which ones when acting, a name in `POINT_CHOICES`: "prefix" (clouds are stored in farthest-point order,
            so a prefix is a coarser cloud) or "random" (drawn anew for each decision, from its noise).
        training: which ones in each step of training: "random" or "prefix".
    """

    max_points: int | None = None
    acting: str = "prefix"
    training: str = "random"

    def __post_init__(self) -> None:
        POINT_CHOICES.get(self.acting)
        POINT_CHOICES.get(self.training)
        if self.max_points is not None and self.max_points < 1:
            raise ConfigError(f"max_points must be at least 1 or None, got {self.max_points}")


@TRANSFORMS.register("points")
class PointSubset(InputTransform):
    """Reads fewer points than a cloud holds.

    Args:
        config: how many and which.
        spec: the environment.
    """

    Config = PointSubsetConfig
    reads = changes = (POINT_CLOUD,)
    sizes: ClassVar = {"quick": {"max_points": 128}, "smoke": {"max_points": 64}}
    config: PointSubsetConfig

    def __init__(self, config: PointSubsetConfig, spec: EnvSpec) -> None:
        super().__init__(config, spec)

    def read_acting(self, obs: Obs, noise: Tensor) -> Obs:
        """See `InputTransform.read_acting`."""
        return self._subset(obs, lambda cloud, n: POINT_CHOICES.get(self.config.acting).acting(cloud, n, noise))

    def read_training(self, obs: Obs, generator: torch.Generator) -> Obs:
        """See `InputTransform.read_training`."""
        return self._subset(obs, lambda cloud, n: POINT_CHOICES.get(self.config.training).training(cloud, n, generator))

    def varies(self, obs: Obs) -> bool:
        """See `InputTransform.varies`."""
        return self._count(obs) is not None and any(
            POINT_CHOICES.get(choice).varies for choice in (self.config.acting, self.config.training)
        )

    @property
    def acts_on_noise(self) -> bool:
        """See `InputTransform.acts_on_noise`."""
        return POINT_CHOICES.get(self.config.acting).varies

    def act_on(self, choice: str) -> None:
        """Read other points when acting from now on, by a name in `POINT_CHOICES`; a checkpoint saved later says so."""
        self.config = replace(self.config, acting=choice)

    def _count(self, obs: Obs) -> int | None:
        """Return how many points are read of clouds that hold more, or None."""
        count = self.config.max_points
        return count if count is not None and count < obs[POINT_CLOUD].shape[2] else None

    def _subset(self, obs: Obs, choose: Callable[[Tensor, int], Tensor]) -> Obs:
        count = self._count(obs)
        return obs if count is None else {**obs, POINT_CLOUD: choose(obs[POINT_CLOUD], count)}


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
