"""The mixer of Pocket DP3 (arXiv:2601.22018, 2605.01581): MLPs over time and over channels in place of a U-Net."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor, nn

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.backbones.backbone import BACKBONES, Backbone
from manicm_ms.policies.backbones.unet1d import SinusoidalEmbedding
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.spec import ChunkSpec

_EXPANSION = 4  # width of every hidden layer over that of its input


@dataclass(frozen=True)
class MixerConfig:
    """Shape of the mixer.

    Attributes:
        width: H, channels of each action's vector.
        blocks: K.
    """

    width: int = 128
    blocks: int = 6

    def __post_init__(self) -> None:
        require_at_least(1, blocks=self.blocks)
        if self.width < 4 or self.width % 2:
            raise ConfigError(f"width must be even and at least 4, got {self.width}")


@BACKBONES.register("mixer")
class Mixer(Backbone):
    """Predicts the clean action chunk (or its noise) from a noisy one.

    x (B, Tp, Da) -> linear to H -> K blocks -> linear to Da. The condition is the sum of a linear map of the features'
    vector and of the embedded times, one vector (B, H) a row.

    Args:
        config: shape.
        chunk: To, Tp, Ta.
        action_dim: Da.
        features: sizes of the observation's features.
        times: number of times that condition it.
    """

    Config = MixerConfig
    sizes: ClassVar = {"smoke": {"width": 32, "blocks": 2}}

    def __init__(
        self, config: MixerConfig, chunk: ChunkSpec, action_dim: int, features: FeatureShape, times: int = 1
    ) -> None:
        super().__init__(config, chunk, action_dim, features, times)
        width = config.width
        self.input = nn.Linear(action_dim, width)
        self.condition = nn.Linear(features.cond, width)
        self.time_embeddings = nn.ModuleList(
            [nn.Sequential(SinusoidalEmbedding(width), _mlp(width, width)) for _ in range(times)]
        )
        self.blocks = nn.ModuleList([MixerBlock(width, chunk.horizon) for _ in range(config.blocks)])
        self.output = nn.Linear(width, action_dim)

    def forward(self, x: Tensor, times: tuple[Tensor, ...], features: Features) -> Tensor:
        """Return the prediction (B, Tp, Da) for noisy actions x (B, Tp, Da), times, each (B,), and features."""
        cond = self.condition(features.cond)
        for embed, t in zip(self.time_embeddings, times, strict=True):
            cond = cond + embed(t)
        x = self.input(x)
        for block in self.blocks:
            x = block(x, cond)
        return self.output(x)


class MixerBlock(nn.Module):
    """Mixes over time, then over channels, then takes the condition in: x += gamma (x (1 + scale) + shift).

    Args:
        width: H.
        horizon: Tp.
    """

    def __init__(self, width: int, horizon: int) -> None:
        super().__init__()
        self.before_time, self.over_time = nn.LayerNorm(width), _mlp(horizon, horizon)
        self.before_channels, self.over_channels = nn.LayerNorm(width), _mlp(width, width)
        self.modulation = _mlp(width, 3 * width)

    def forward(self, x: Tensor, cond: Tensor) -> Tensor:
        """Return (B, Tp, H) for x (B, Tp, H) and cond (B, H)."""
        x = x + self.over_time(self.before_time(x).transpose(1, 2)).transpose(1, 2)
        x = x + self.over_channels(self.before_channels(x))
        gamma, scale, shift = self.modulation(cond)[:, None].chunk(3, dim=-1)  # (B, 1, H) each
        return x + gamma * (x * (1 + scale) + shift)


def _mlp(fan_in: int, fan_out: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(fan_in, _EXPANSION * fan_in), nn.SiLU(), nn.Linear(_EXPANSION * fan_in, fan_out))
