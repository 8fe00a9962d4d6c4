"""The interface of observation encoders: observations in, features out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from torch import Tensor, nn

from manicm_ms.registry import TASKS, Registry
from manicm_ms.spec import ChunkSpec, EnvSpec


class Features(NamedTuple):
    """What an encoder says of observations.

    Attributes:
        cond: (B, F), one vector a row.
        tokens: (B, L, G), a sequence of vectors a row, as a rule one a frame; None where the encoder has none.
    """

    cond: Tensor
    tokens: Tensor | None = None

    def changed(self, change: Callable[[Tensor], Tensor]) -> Features:
        """Return the features with `change` applied to each part that there is."""
        return Features(change(self.cond), None if self.tokens is None else change(self.tokens))


@dataclass(frozen=True)
class FeatureShape:
    """Sizes of `Features`.

    Attributes:
        cond: F.
        tokens: L and G, or None where there are none.
    """

    cond: int
    tokens: tuple[int, int] | None = None


class ObsEncoder(nn.Module, ABC):
    """Maps normalised observations to features.

    Subclasses are made with `(config, spec, chunk)`, config being one of their `Config`.

    Attributes:
        Config: dataclass of its fields.
        sizes: name of a size ("smoke", "quick", "paper") -> fields that differ from the published ones.
        keys: observations that it reads. Those of a `FieldSpec` with `by_range` come normalised to [-1, 1]; the others
            as they are, which the encoder scales itself.
        config: the fields that it was made with.
        shape: sizes of its features.
    """

    Config: ClassVar[type[Any]]
    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    keys: ClassVar[tuple[str, ...]]
    config: Any
    shape: FeatureShape

    def __init__(self, config: Any, spec: EnvSpec, chunk: ChunkSpec) -> None:
        super().__init__()
        self.config = config
        del spec, chunk

    @abstractmethod
    def forward(self, obs: Mapping[str, Tensor]) -> Features:
        """Return the features of observations, normalised as `keys` says: each of `keys` as (B, To, ...)."""


ENCODERS: Registry[type[ObsEncoder]] = Registry(
    "encoder", package="manicm_ms.policies.encoders", group="manicm_ms.methods", outside=TASKS
)
"""name -> encoder."""
