"""A head's own loss on demonstrations, with and without an average of the weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.heads.head import TrainableHead
from manicm_ms.spec import ACTION
from manicm_ms.training.objectives.objective import OBJECTIVES, PolicyObjective
from manicm_ms.training.optim import DecayRule, averaged


@OBJECTIVES.register("plain")
class HeadObjective(PolicyObjective):
    """The loss of a policy's head on demonstrations; the outcome is the policy with its last weights.

    Args:
        policy: trained in place, its normalizer fitted.
        decay: of averaged weights, for objectives that have them.

    Raises:
        ConfigError: the head does not learn from demonstrations alone.
    """

    def __init__(self, policy: ActionPolicy, decay: DecayRule) -> None:
        super().__init__()
        del decay
        if not isinstance(policy.head, TrainableHead):
            raise ConfigError(f"{policy.name} learns from a teacher: train one, and use manicm-ms distill")
        self.policy = policy

    def forward(self, batch: Mapping[str, Tensor], generator: torch.Generator) -> Tensor:
        """Return the loss of raw windows: each observation and `action`, as `SequenceDataset.batch` gives them."""
        features = self.policy.encode_training(batch, generator)
        action = self.policy.normalizer.normalize(ACTION, batch[ACTION])  # (B, Tp, Da)
        return cast(TrainableHead, self.policy.head).loss(features, action, generator)

    def after_step(self) -> None:
        """Do nothing: no weights are averaged."""

    @property
    def outcome(self) -> ActionPolicy:
        """The policy."""
        return self.policy


@OBJECTIVES.register("averaged")
class AveragedHeadObjective(HeadObjective):
    """The loss of a policy's head on demonstrations; the outcome is the policy with averaged weights.

    Args:
        policy: trained in place, its normalizer fitted.
        decay: of the averaged weights.
    """

    def __init__(self, policy: ActionPolicy, decay: DecayRule) -> None:
        super().__init__(policy, decay)
        self.average = averaged(policy, decay)

    def after_step(self) -> None:
        """Average the weights."""
        self.average.update_parameters(self.policy)

    @property
    def outcome(self) -> ActionPolicy:
        """The policy with averaged weights."""
        return cast(ActionPolicy, self.average.module)
