"""The interface of backbones: networks from a chunk of actions, times and features to a chunk."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor, nn

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.registry import TASKS, Registry
from manicm_ms.spec import ChunkSpec


class Backbone(nn.Module, ABC):
    """Maps a noisy chunk, its times and an observation's features to a chunk.

    Subclasses are made with `(config, chunk, action_dim, features, times)`: config is one of their `Config`, times how
    many times (diffusion times, or none) a head passes.

    Attributes:
        Config: dataclass of its fields.
        sizes: name of a size ("smoke", "quick", "paper") -> fields that differ from the published ones.
        reads: the features that it reads, names of fields of `Features`.
        stages: names of the stages whose outputs `tapped` can give, in order; none where there are none to speak of.
        config: the fields that it was made with.
    """

    Config: ClassVar[type[Any]]
    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    reads: ClassVar[tuple[str, ...]] = ("cond",)
    stages: tuple[str, ...] = ()
    config: Any

    def __init__(self, config: Any, chunk: ChunkSpec, action_dim: int, features: FeatureShape, times: int = 1) -> None:
        super().__init__()
        self.config = config
        del chunk, action_dim, features, times

    @abstractmethod
    def forward(self, x: Tensor, times: tuple[Tensor, ...], features: Features) -> Tensor:
        """Return (B, Tp, Da) for a chunk x (B, Tp, Da), times, each (B,), and the features of B rows."""

    def tapped(
        self, x: Tensor, times: tuple[Tensor, ...], features: Features, taps: tuple[str, ...]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return what `forward` does, and the outputs (B, ...) of the stages that `taps` names, for a loss on them.

        Raises ConfigError where the backbone has no such stage.
        """
        if taps:
            raise ConfigError(f"{type(self).__name__} has no stages that can be read, asked for {', '.join(taps)}")
        return self(x, times, features), {}


BACKBONES: Registry[type[Backbone]] = Registry(
    "backbone", package="manicm_ms.policies.backbones", group="manicm_ms.methods", outside=TASKS
)
"""name -> backbone."""
