"""The interface of input transforms: what happens to observations before an encoder reads them."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from manicm_ms.policies.policy import ChannelStats
from manicm_ms.registry import TASKS, Registry
from manicm_ms.spec import EnvSpec

Obs = Mapping[str, Tensor]
"""key -> (B, To, ...)."""


class InputTransform(nn.Module, ABC):
    """Changes observations in up to two places: before they are normalised, and after.

    Subclasses are made with `(config, spec)`, config being one of their `Config`.

    Attributes:
        Config: dataclass of its fields.
        sizes: name of a size ("smoke", "quick", "paper") -> fields that differ from the published ones.
        reads: observations that it reads; the policy asks for them beside the encoder's.
        changes: observations that it changes; where the encoder reads none of them it has no part in a policy, which
            then does not ask for what it reads. Empty for one that is never left out.
        config: the fields that it was made with, those resolved that the environment decides.
    """

    Config: ClassVar[type[Any]]
    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    reads: tuple[str, ...] = ()
    changes: tuple[str, ...] = ()
    config: Any

    def __init__(self, config: Any, spec: EnvSpec) -> None:
        super().__init__()
        self.config = config
        del spec

    def read_acting(self, obs: Obs, noise: Tensor) -> Obs:
        """Return raw observations as a policy reads them when it acts; by default as they are.

        Args:
            obs: raw, (B, To, ...).
            noise: (B, Tp, Da), the Gaussian noise that this decision starts from: the only source of chance, so that
                one seed means one action, and two policies that are given the same noise read the same.
        """
        del noise
        return obs

    def read_training(self, obs: Obs, generator: torch.Generator) -> Obs:
        """Return raw observations as one step of training reads them; by default as they are.

        Args:
            obs: raw, (B, To, ...).
            generator: on their device, the only source of chance.
        """
        del generator
        return obs

    def varies(self, obs: Obs) -> bool:
        """Return whether another draw, in training or when acting, could give something else for `obs`."""
        del obs
        return False

    @property
    def acts_on_noise(self) -> bool:
        """Whether `read_acting` reads the noise."""
        return False

    def ranges(self, stats: Mapping[str, ChannelStats]) -> Mapping[str, ChannelStats]:
        """Return the ranges of what is read, given those of the training data: what the normalizer is fitted from."""
        return stats

    def normalized(self, normalized: dict[str, Tensor], raw: Obs) -> dict[str, Tensor]:
        """Return the normalised observations, where this transform has them otherwise than by their ranges.

        Args:
            normalized: each key mapped to [-1, 1] over the training data.
            raw: the same before, in units and frame of the environment.
        """
        del raw
        return normalized


TRANSFORMS: Registry[type[InputTransform]] = Registry(
    "input transform", package="manicm_ms.policies.encoders", group="manicm_ms.methods", outside=TASKS
)
"""name -> transform."""
