"""Linear maps of observations and actions to [-1, 1] and back, saved beside the weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from manicm_ms.errors import ConfigError, SpecMismatchError

if TYPE_CHECKING:
    from manicm_ms.policies.policy import ChannelStats

MIN_RANGE = 1e-4
"""A channel whose max - min is below this (in its own unit) counts as constant, as in DP3."""


class Normalizer(nn.Module):
    """Maps each channel of each field from [min, max] to [-1, 1].

    y = scale x + offset with scale = 2 / (max - min); a constant channel is only shifted, so that its
    value becomes 0 (DP3, `LinearNormalizer` in mode "limits"). Values outside the fitted range are not
    clipped. Scale and offset are buffers: they are saved, and no optimizer sees them.

    A field may have a least range: a channel that moves less is mapped about its middle as if it moved that far, so
    that a millimetre of it is not the whole input.

    Args:
        channels: field -> number of channels C (its last axis). Unfitted fields map to themselves.
    """

    def __init__(self, channels: Mapping[str, int]) -> None:
        super().__init__()
        self.fields = tuple(channels)
        for name, count in channels.items():
            self.register_buffer(f"{name}_scale", torch.ones(count))
            self.register_buffer(f"{name}_offset", torch.zeros(count))

    def fit(self, stats: Mapping[str, ChannelStats], least_ranges: Mapping[str, float] | None = None) -> None:
        """Set all fields from their ranges.

        Args:
            stats: field -> object with `min` and `max`, each (C,) in the field's unit.
            least_ranges: field -> least range of its channels in its unit; DP3's rule for a field that is not named.

        Raises:
            SpecMismatchError: a field is missing, has another number of channels or a value that is not finite.
        """
        for name in self.fields:
            if name not in stats:
                raise SpecMismatchError(f"the statistics lack {name!r}, they hold {', '.join(sorted(stats))}")
            scale, offset = self._affine(name)
            low, high = (torch.as_tensor(v).to(torch.float64).cpu() for v in (stats[name].min, stats[name].max))
            if low.shape != scale.shape or high.shape != scale.shape:
                raise SpecMismatchError(
                    f"the statistics of {name!r} have {low.numel()} channels and the policy {scale.numel()}"
                )
            span = high - low
            if not torch.isfinite(span).all() or (span < 0).any():
                raise SpecMismatchError(f"the statistics of {name!r} are not finite ranges: min {low}, max {high}")
            least = (least_ranges or {}).get(name, 0.0)
            gain, shift = _about_the_middle(low, high, least) if least else _from_limits(low, high)
            scale.copy_(gain)
            offset.copy_(shift)

    def normalize(self, field: str, value: Tensor) -> Tensor:
        """Return `value` (..., C), in the field's unit, mapped to [-1, 1]; float32."""
        scale, offset = self._affine(field)
        return value.float() * scale + offset

    def unnormalize(self, field: str, value: Tensor) -> Tensor:
        """Return `value` (..., C), normalised, in the field's unit; the inverse of `normalize`."""
        scale, offset = self._affine(field)
        return (value.float() - offset) / scale

    def _affine(self, field: str) -> tuple[Tensor, Tensor]:
        if field not in self.fields:
            raise ConfigError(f"the normalizer has no field {field!r}: known: {', '.join(self.fields)}")
        return getattr(self, f"{field}_scale"), getattr(self, f"{field}_offset")


def _from_limits(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return scale and offset (C,) of DP3's rule: [low, high] becomes [-1, 1], a constant channel 0."""
    span = high - low
    constant = span < MIN_RANGE
    gain = torch.where(constant, torch.ones_like(span), 2.0 / span.clamp_min(MIN_RANGE))
    return gain, torch.where(constant, -low, -1.0 - gain * low)


def _about_the_middle(low: Tensor, high: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Return scale and offset (C,) that map [low, high] to [-1, 1], or less where it is narrower than `least`."""
    gain = 2.0 / (high - low).clamp_min(least)
    return gain, -gain * (low + high) / 2
