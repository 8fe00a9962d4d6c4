"""Windows seen through a frozen encoder: features are computed once, so that distillation runs only the U-Net."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from manicm_ms.demos.windows import Windows
from manicm_ms.policies.denoiser import ConditionedDenoiser
from manicm_ms.policies.points import POINT_CHOICES
from manicm_ms.spec import ACTION, POINT_CLOUD
from manicm_ms.training.stream import subset_generator

COND = "cond"
"""(B, K, F) features of K point subsets of each window's observation."""
CLEAN_ACTION = "x0"
"""(B, Tp, Da) normalised actions."""

_BATCH = 128  # windows encoded at a time


@dataclass(frozen=True)
class FeatureWindows:
    """Features and actions of all windows of a demonstration store.

    Attributes:
        cond: (N, K, F) float32, features of K point subsets of each window.
        x0: (N, Tp, Da) float32, normalised actions.
    """

    cond: Tensor
    x0: Tensor

    def __len__(self) -> int:
        """Return N, the number of windows."""
        return len(self.x0)

    def batch(self, indices: Tensor) -> dict[str, Tensor]:
        """Return the windows with these (B,) indices: `COND` (B, K, F) and `CLEAN_ACTION` (B, Tp, Da)."""
        indices = indices.to(self.x0.device)
        return {COND: self.cond[indices], CLEAN_ACTION: self.x0[indices]}


def draw_points(
    batch: Mapping[str, Tensor], points: int | None, generator: torch.Generator, choice: str = "random"
) -> dict[str, Tensor]:
    """Return the batch with `points` of its points, the same places in each cloud.

    Args:
        batch: `point_cloud` (B, To, P, C) and others, which stay.
        points: how many; None, or as many as there are, leaves the clouds as they are.
        generator: on the device of the batch.
        choice: a name in `POINT_CHOICES`.
    """
    cloud = batch[POINT_CLOUD]
    if points is None or points >= cloud.shape[2]:
        return dict(batch)
    return {**batch, POINT_CLOUD: POINT_CHOICES.get(choice).training(cloud, points, generator)}


@torch.no_grad()
def encode_windows(network: ConditionedDenoiser, windows: Windows, draws: int, seed: int) -> FeatureWindows:
    """Encode every window in float32, as a policy does when it acts.

    Args:
        network: its encoder is frozen, its normaliser fitted; on the device of `windows`.
        windows: of demonstrations.
        draws: K, point subsets for each window where the network reads fewer points than are stored: first one
            by its `acting_points`, then others by its `training_points`. There is one where no other can differ.
        seed: decides the subsets, by draws that no training step shares.
    """
    points, device = network.config.max_points, windows.action.device
    choices = [network.config.acting_points, *[network.config.training_points] * (draws - 1)]
    all_read = points is None or points >= windows.point_cloud.shape[1]
    if all_read or not any(POINT_CHOICES.get(choice).varies for choice in choices):
        choices = choices[:1]
    rows, actions = [], []
    for number, indices in enumerate(torch.arange(len(windows)).split(_BATCH)):
        batch = windows.batch(indices)
        generator = subset_generator(seed, number, device)
        subsets = [draw_points(batch, points, generator, choice) for choice in choices]
        rows.append(torch.stack([network.encode(subset) for subset in subsets], dim=1))  # (b, K, F)
        actions.append(network.normalizer.normalize(ACTION, batch[ACTION]))
    return FeatureWindows(torch.cat(rows), torch.cat(actions))
