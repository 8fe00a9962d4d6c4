"""The interface of action heads: how actions are chosen from features, and what is minimised in training."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

from manicm_ms.errors import ConfigError
from manicm_ms.policies.backbones.backbone import Backbone
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.registry import TASKS, Registry
from manicm_ms.spec import ChunkSpec

State = dict[str, Tensor]
"""What a head remembers from one decision to the next: name -> (B, ...)."""


H = TypeVar("H", bound="ActionHead")


class ActionHead(nn.Module, ABC):
    """Chooses normalised action chunks from features.

    Subclasses are made with `(config, backbone, chunk, action_dim, features)`: config is one of their `Config`,
    backbone None where they need none.

    Attributes:
        Config: dataclass of its fields.
        sizes: name of a size ("smoke", "quick", "paper") -> fields that differ from the published ones.
        times: numbers that it passes to its backbone with each chunk: 1 for a diffusion time.
        needs_backbone: whether it runs one.
        role: "teacher" for a head that can be distilled (a `DiffusionHead`), "student" for one that was, else None.
        nfe_field: field of `Config` that is the number of network evaluations of a decision; None where it is fixed.
        reads: the features that it reads, where it has no backbone.
        config: the fields that it was made with.
        backbone: its network, or None.
        shape: chunk, action_dim and features that it was made with.
    """

    Config: ClassVar[type[Any]]
    sizes: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    times: ClassVar[int] = 1
    needs_backbone: ClassVar[bool] = False
    role: ClassVar[str | None] = None
    nfe_field: ClassVar[str | None] = None
    reads: tuple[str, ...] = ("cond",)
    config: Any
    backbone: Backbone | None
    shape: tuple[ChunkSpec, int, FeatureShape]

    def __init__(
        self, config: Any, backbone: Backbone | None, chunk: ChunkSpec, action_dim: int, features: FeatureShape
    ) -> None:
        super().__init__()
        self.config, self.backbone, self.shape = config, backbone, (chunk, action_dim, features)
        if backbone is not None:
            self.reads = backbone.reads

    @property
    @abstractmethod
    def nfe(self) -> int:
        """Network evaluations of one decision."""

    @property
    def noise_draws(self) -> int:
        """Independent Gaussian arrays (B, Tp, Da) that one decision consumes; 0 for a deterministic head."""
        return 1

    @abstractmethod
    def act(self, features: Features, noise: tuple[Tensor, ...], state: State | None) -> tuple[Tensor, State | None]:
        """Choose chunks.

        Args:
            features: of B rows.
            noise: `noise_draws` arrays (B, Tp, Da).
            state: what the last decision returned; None at the first.

        Returns:
            (B, Tp, Da) normalised, and the state after the decision; None for a head without memory.
        """

    def initial_state(self, n: int) -> State | None:
        """Return the state of n rows that have just been restarted; None without memory."""
        del n
        return None

    def with_nfe(self, nfe: int) -> ActionHead:
        """Return a head that shares this one's network and evaluates it `nfe` times a decision.

        Raises ConfigError where it cannot.
        """
        if self.nfe_field is None:
            if nfe == self.nfe:
                return self
            raise ConfigError(f"a {type(self).__name__} takes nfe={self.nfe} in a decision and no other, got {nfe}")
        return self._of_same_network(type(self), replace(self.config, **{self.nfe_field: nfe}))

    def one_step(self) -> ActionHead | None:
        """Return a head of the same weights that is evaluated once: the control of a distillation; None without one."""
        return None

    def _of_same_network(self, kind: type[H], config: Any) -> H:
        """Return a head of a kind that is made as this one, on the same device, with the same backbone."""
        return kind(config, self.backbone, *self.shape).to(next(self.parameters()).device)


class TrainableHead(ActionHead):
    """A head that learns from demonstrations alone; a student's learns from its teacher."""

    @abstractmethod
    def loss(self, features: Features, action: Tensor, generator: torch.Generator) -> Tensor:
        """Return the loss, a scalar, of demonstrated chunks (B, Tp, Da), normalised; all chance from `generator`."""


HEADS: Registry[type[ActionHead]] = Registry(
    "head", package="manicm_ms.policies.heads", group="manicm_ms.methods", outside=TASKS
)
"""name -> head."""
