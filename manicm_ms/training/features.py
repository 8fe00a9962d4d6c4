"""Demonstrations seen through a frozen encoder: computed once, so that distillation runs the backbone alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from manicm_ms.demos.sequence_dataset import SequenceDataset
from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.spec import ACTION
from manicm_ms.training.stream import subset_generator

CLEAN_ACTION = "x0"
"""(B, Tp, Da) normalised actions."""

_BATCH = 128  # windows encoded at a time


@dataclass(frozen=True)
class FeatureDataset:
    """Features and actions of all windows of demonstrations.

    Attributes:
        features: field of `Features` -> (N, K, ...) float32, those of K draws of each window's observation.
        x0: (N, Tp, Da) float32, normalised actions.
    """

    features: Mapping[str, Tensor]
    x0: Tensor

    def __len__(self) -> int:
        """Return N, the number of windows."""
        return len(self.x0)

    def batch(self, indices: Tensor) -> dict[str, Tensor]:
        """Return the windows with these (B,) indices: each field as (B, K, ...) and `CLEAN_ACTION` (B, Tp, Da)."""
        indices = indices.to(self.x0.device)
        return {name: values[indices] for name, values in self.features.items()} | {CLEAN_ACTION: self.x0[indices]}


def chosen_features(batch: Mapping[str, Tensor], generator: torch.Generator) -> Features:
    """Return one of the K draws of each row of a batch of `FeatureDataset`; `generator` chooses."""
    rows, draws = batch["cond"].shape[:2]
    device = batch["cond"].device
    draw = torch.randint(draws, (rows,), generator=generator, device=device)
    row = torch.arange(rows, device=device)
    return Features(**{name: batch[name][row, draw] for name in Features._fields if name in batch})


@torch.no_grad()
def encode_dataset(policy: ActionPolicy, dataset: SequenceDataset, draws: int, seed: int) -> FeatureDataset:
    """Encode every window in float32, as a policy does when it acts.

    Args:
        policy: its encoder is frozen, its normalizer fitted; on the device of `dataset`.
        dataset: of demonstrations.
        draws: K, draws of each window where its transforms can give different ones: first one as when acting, then
            others as in training. There is one where no other can differ.
        seed: decides the draws, by a stream that no training step shares.
    """
    device, kept = dataset.action.device, {"cond", *policy.head.reads}
    few = dataset.batch(torch.arange(1))
    count = draws if policy.varies(few) else 1
    rows: dict[str, list[Tensor]] = {name: [] for name in Features._fields if name in kept}
    actions = []
    for number, indices in enumerate(torch.arange(len(dataset)).split(_BATCH)):
        batch = dataset.batch(indices)
        generator = subset_generator(seed, number, device)
        drawn = [_as_acting(policy, batch, generator)]
        drawn += [policy.encode_training(batch, generator) for _ in range(count - 1)]
        for name, parts in rows.items():
            parts.append(torch.stack([getattr(features, name) for features in drawn], dim=1))  # (b, K, ...)
        actions.append(policy.normalizer.normalize(ACTION, batch[ACTION]))
    return FeatureDataset({name: torch.cat(parts) for name, parts in rows.items()}, torch.cat(actions))


def _as_acting(policy: ActionPolicy, batch: Mapping[str, Tensor], generator: torch.Generator) -> Features:
    """Return the features of what acting reads, with noise from `generator` where the reading depends on it."""
    noise = None
    if policy.reads_noise:
        noise = torch.randn(batch[ACTION].shape, generator=generator, device=batch[ACTION].device)
    return policy.encode(batch, noise)
