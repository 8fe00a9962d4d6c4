"""Joint tokens: one sequence of frames, times and actions, and self-attention over all of it (arXiv:2608.16153)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.backbones.backbone import BACKBONES, Backbone
from manicm_ms.policies.backbones.unet1d import SinusoidalEmbedding
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.spec import ChunkSpec

_EXPANSION = 4  # width of every hidden layer over that of its input
_POSITION_STD = 0.02  # of learnt positions at the start, as in ViT


@dataclass(frozen=True)
class TokensConfig:
    """Shape of the Transformer; the defaults are UCA-Flow's.

    Attributes:
        width: W, of each token.
        blocks: of attention and MLP.
        heads: of the attention; must divide `width`.
    """

    width: int = 384
    blocks: int = 8
    heads: int = 8

    def __post_init__(self) -> None:
        require_at_least(1, blocks=self.blocks, heads=self.heads)
        if self.width < 4 or self.width % 2:
            raise ConfigError(f"width must be even and at least 4, got {self.width}")
        if self.width % self.heads:
            raise ConfigError(f"heads={self.heads} must divide width={self.width}")


@BACKBONES.register("tokens")
class Tokens(Backbone):
    """Predicts a chunk with the observation in the same sequence as the actions.

    The sequence is [L tokens of the features, one of each time, Tp of the actions], all of width W; features and
    actions have learnt positions. Only the actions' tokens are read in the end.

    Args:
        config: shape.
        chunk: To, Tp, Ta.
        action_dim: Da.
        features: sizes of the observation's features, which must have tokens.
        times: number of times that condition it.

    Raises:
        ConfigError: the encoder has no tokens.
    """

    Config = TokensConfig
    sizes: ClassVar = {
        "quick": {"width": 128, "blocks": 6, "heads": 4},
        "smoke": {"width": 32, "blocks": 2, "heads": 4},
    }
    reads = ("tokens",)

    def __init__(
        self, config: TokensConfig, chunk: ChunkSpec, action_dim: int, features: FeatureShape, times: int = 1
    ) -> None:
        super().__init__(config, chunk, action_dim, features, times)
        if features.tokens is None:
            raise ConfigError("the backbone tokens reads a sequence of features, which this encoder does not give")
        width, (length, channels) = config.width, features.tokens
        self.horizon = chunk.horizon
        self.frames, self.frame_positions = nn.Linear(channels, width), _positions(length, width)
        self.time_embeddings = nn.ModuleList([_time_embedding(width) for _ in range(times)])
        self.actions, self.action_positions = nn.Linear(action_dim, width), _positions(chunk.horizon, width)
        self.blocks = nn.Sequential(*[TokenBlock(width, config.heads) for _ in range(config.blocks)])
        self.norm, self.output = nn.LayerNorm(width), nn.Linear(width, action_dim)

    def forward(self, x: Tensor, times: tuple[Tensor, ...], features: Features) -> Tensor:
        """Return the prediction (B, Tp, Da) for noisy actions x (B, Tp, Da), times, each (B,), and features."""
        frames = self.frames(features.tokens) + self.frame_positions
        embedded = [embed(t)[:, None] for embed, t in zip(self.time_embeddings, times, strict=True)]
        actions = self.actions(x) + self.action_positions
        sequence = self.blocks(torch.cat([frames, *embedded, actions], dim=1))  # (B, L + times + Tp, W)
        return self.output(self.norm(sequence[:, -self.horizon :]))


class TokenBlock(nn.Module):
    """Self-attention, then an MLP with GELU, each after a LayerNorm and added to its input.

    Args:
        width: W.
        heads: of the attention.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.before_attention, self.before_mlp = nn.LayerNorm(width), nn.LayerNorm(width)
        self.queries_keys_values, self.joined = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.Linear(width, _EXPANSION * width), nn.GELU(), nn.Linear(_EXPANSION * width, width))

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, L, W) for tokens x (B, L, W)."""
        x = x + self.attention(self.before_attention(x))
        return x + self.mlp(self.before_mlp(x))

    def attention(self, x: Tensor) -> Tensor:
        """Return softmax(q k^T / sqrt(W / heads)) v of all heads, joined, (B, L, W).

        Written out: torch's fused attention has no forward mode on a CPU, which heads that learn an average velocity
        need.
        """
        q, k, v = (
            self.queries_keys_values(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        )  # (B, H, L, W / H)
        weights = (q @ k.transpose(-2, -1) * q.shape[-1] ** -0.5).softmax(-1)
        return self.joined((weights @ v).transpose(1, 2).flatten(2))


def _positions(length: int, width: int) -> nn.Parameter:
    return nn.Parameter(_POSITION_STD * torch.randn(length, width))


def _time_embedding(width: int) -> nn.Sequential:
    return nn.Sequential(
        SinusoidalEmbedding(width),
        nn.Linear(width, _EXPANSION * width),
        nn.SiLU(),
        nn.Linear(_EXPANSION * width, width),
    )
