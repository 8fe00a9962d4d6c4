"""The denoising network over an action chunk: a 1-D U-Net whose blocks are modulated by time and observation."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.backbones.backbone import BACKBONES, Backbone
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.spec import ChunkSpec


class SinusoidalEmbedding(nn.Module):
    """Embeds a diffusion time t as sines and cosines of geometrically spaced frequencies (Vaswani et al. 2017).

    Args:
        dim: of the embedding, even.
    """

    rates: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        half = dim // 2
        rates = torch.exp(torch.arange(half, dtype=torch.float32) * (-math.log(10_000.0) / (half - 1)))
        self.register_buffer("rates", rates, persistent=False)

    def forward(self, t: Tensor) -> Tensor:
        """Return (B, dim) for times (B,)."""
        angles = t.to(torch.promote_types(self.rates.dtype, torch.float32))[:, None] * self.rates
        return torch.cat([angles.sin(), angles.cos()], dim=-1)


class ConvBlock(nn.Sequential):
    """Convolution over time that keeps the length, group normalisation, Mish.

    Args:
        fan_in: input channels.
        fan_out: output channels.
        kernel_size: taps, odd.
        n_groups: of the normalisation; must divide `fan_out`.
    """

    def __init__(self, fan_in: int, fan_out: int, kernel_size: int, n_groups: int) -> None:
        super().__init__(
            nn.Conv1d(fan_in, fan_out, kernel_size, padding=kernel_size // 2),
            nn.GroupNorm(n_groups, fan_out),
            nn.Mish(),
        )


class FiLMBlock(nn.Module):
    """Residual block; between its two convolutions each channel is scaled and shifted by the condition.

    h = scale(cond) * conv1(x) + bias(cond), y = conv2(h) + skip(x): feature-wise linear modulation
    (Perez et al. 2018), as in Diffusion Policy (Chi et al. 2023).

    Args:
        fan_in: input channels.
        fan_out: output channels.
        cond_dim: of the condition.
        kernel_size: taps of both convolutions.
        n_groups: of the group normalisations.
    """

    def __init__(self, fan_in: int, fan_out: int, cond_dim: int, kernel_size: int, n_groups: int) -> None:
        super().__init__()
        self.first = ConvBlock(fan_in, fan_out, kernel_size, n_groups)
        self.modulation = nn.Sequential(nn.Mish(), nn.Linear(cond_dim, 2 * fan_out))
        self.second = ConvBlock(fan_out, fan_out, kernel_size, n_groups)
        self.skip = nn.Conv1d(fan_in, fan_out, 1) if fan_in != fan_out else nn.Identity()

    def forward(self, x: Tensor, cond: Tensor) -> Tensor:
        """Return (B, fan_out, T) for x (B, fan_in, T) and cond (B, cond_dim)."""
        scale, bias = self.modulation(cond)[:, :, None].chunk(2, dim=1)  # (B, fan_out, 1) each
        return self.second(scale * self.first(x) + bias) + self.skip(x)


class FiLMStack(nn.ModuleList):
    """Residual blocks one after another, the first of which changes the number of channels."""

    def __init__(self, count: int, fan_in: int, fan_out: int, cond_dim: int, kernel_size: int, n_groups: int) -> None:
        ins = (fan_in, *[fan_out] * (count - 1))
        super().__init__([FiLMBlock(i, fan_out, cond_dim, kernel_size, n_groups) for i in ins])

    def forward(self, x: Tensor, cond: Tensor) -> Tensor:
        """Return (B, fan_out, T) for x (B, fan_in, T) and cond (B, cond_dim)."""
        for block in self:
            x = block(x, cond)
        return x


@dataclass(frozen=True)
class UNet1DConfig:
    """Shape of the U-Net; the defaults are DP3's.

    Attributes:
        down_dims: channels of each stage.
        resnets_per_stage: residual blocks of each stage; 2 in DP3, 1 in Simple DP3.
        mid_blocks: residual blocks between the way down and the way up; 2 in DP3, 1 in Simple DP3.
        kernel_size: taps of the convolutions, odd.
        n_groups: of the group normalisations; divides every width.
        step_embed_dim: of each time's embedding, even.
    """

    down_dims: tuple[int, ...] = (512, 1024, 2048)
    resnets_per_stage: int = 2
    mid_blocks: int = 2
    kernel_size: int = 5
    n_groups: int = 8
    step_embed_dim: int = 128

    def __post_init__(self) -> None:
        if self.kernel_size % 2 == 0:
            raise ConfigError(f"kernel_size must be odd, got {self.kernel_size}")
        if self.step_embed_dim % 2 or self.step_embed_dim < 4:
            raise ConfigError(f"step_embed_dim must be even and at least 4, got {self.step_embed_dim}")
        if min(len(self.down_dims), self.resnets_per_stage, self.mid_blocks) < 1:
            raise ConfigError("down_dims needs a stage, and resnets_per_stage and mid_blocks must be at least 1")
        require_at_least(1, n_groups=self.n_groups, kernel_size=self.kernel_size, down_dims=min(self.down_dims))
        if bad := [width for width in self.down_dims if width % self.n_groups]:
            raise ConfigError(f"n_groups={self.n_groups} must divide every width of down_dims, not so for {bad}")


@BACKBONES.register("unet1d")
class UNet1D(Backbone):
    """Predicts the clean action chunk (or its noise) from a noisy one.

    Each stage but the last halves the time axis, and the way up doubles it again; skip connections join
    equal lengths. The first stage's output is not joined, as in the public code. For three stages of
    widths a, b, c and Tp = 4::

        down   Da -> a, 4     a -> b, 2     b -> c, 1
        middle                              c -> c, 1
        up      2b -> a, 2 -> 4   <-   2c -> b, 1 -> 2        then a -> Da, 4

    The condition of its blocks is the features' vector beside the sum of the embedded times.

    Args:
        config: shape.
        chunk: To, Tp, Ta; Tp must be a multiple of 2 for each stage but the first.
        action_dim: Da.
        features: sizes of the observation's features.
        times: number of times that condition it.

    Attributes:
        stages: "down0", "down1", ...: each stage on the way down, before its length is halved.
    """

    Config = UNet1DConfig
    sizes: ClassVar = {"quick": {"down_dims": (64, 128, 256)}, "smoke": {"down_dims": (32, 64)}}

    def __init__(
        self, config: UNet1DConfig, chunk: ChunkSpec, action_dim: int, features: FeatureShape, times: int = 1
    ) -> None:
        super().__init__(config, chunk, action_dim, features, times)
        down_dims, embedded = config.down_dims, config.step_embed_dim
        _check_horizon(chunk.horizon, len(down_dims))
        self.time_embeddings = nn.ModuleList([_time_embedding(embedded) for _ in range(times)])
        shape = ((embedded if times else 0) + features.cond, config.kernel_size, config.n_groups)
        pairs = list(itertools.pairwise((action_dim, *down_dims)))
        each = config.resnets_per_stage
        self.down = nn.ModuleList([FiLMStack(each, i, o, *shape) for i, o in pairs])
        self.downsample = nn.ModuleList([nn.Conv1d(o, o, 3, stride=2, padding=1) for _, o in pairs[:-1]])
        self.middle = FiLMStack(config.mid_blocks, down_dims[-1], down_dims[-1], *shape)
        upward = pairs[:0:-1]  # from the last stage to the second
        self.up = nn.ModuleList([FiLMStack(each, 2 * o, i, *shape) for i, o in upward])
        self.upsample = nn.ModuleList([nn.ConvTranspose1d(i, i, 4, stride=2, padding=1) for i, _ in upward])
        self.stages = tuple(f"down{index}" for index in range(len(self.down)))
        self.head = nn.Sequential(
            ConvBlock(down_dims[0], down_dims[0], config.kernel_size, config.n_groups),
            nn.Conv1d(down_dims[0], action_dim, 1),
        )

    def forward(self, x: Tensor, times: tuple[Tensor, ...], features: Features) -> Tensor:
        """Return the prediction (B, Tp, Da) for noisy actions x (B, Tp, Da), times, each (B,), and features."""
        return self.tapped(x, times, features, ())[0]

    def tapped(
        self, x: Tensor, times: tuple[Tensor, ...], features: Features, taps: tuple[str, ...]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the prediction and the outputs (B, C, T) of the stages in `taps`; see `Backbone.tapped`."""
        if unknown := [name for name in taps if name not in self.stages]:
            raise ConfigError(f"the U-Net has the stages {', '.join(self.stages)}, asked for {', '.join(unknown)}")
        embedded = [embed(t) for embed, t in zip(self.time_embeddings, times, strict=True)]
        cond = torch.cat([sum(embedded[1:], embedded[0]), features.cond], dim=-1) if embedded else features.cond
        x = x.transpose(1, 2)  # (B, Da, Tp)
        skips = []
        for index, stage in enumerate(self.down):
            x = stage(x, cond)
            skips.append(x)
            if index < len(self.downsample):
                x = self.downsample[index](x)
        outputs = {name: skip for name, skip in zip(self.stages, skips, strict=True) if name in taps}
        x = self.middle(x, cond)
        for stage, upsample in zip(self.up, self.upsample, strict=True):
            x = upsample(stage(torch.cat([x, skips.pop()], dim=1), cond))
        return self.head(x).transpose(1, 2), outputs


def _time_embedding(dim: int) -> nn.Sequential:
    return nn.Sequential(
        SinusoidalEmbedding(dim),
        nn.Linear(dim, 4 * dim),
        nn.Mish(),
        nn.Linear(4 * dim, dim),
    )


def _check_horizon(horizon: int, stages: int) -> None:
    """Raise ConfigError where a chunk of `horizon` actions cannot be halved at every stage but the last."""
    unit = 2 ** (stages - 1)
    if horizon % unit:
        raise ConfigError(f"horizon {horizon} is no multiple of {unit}, which {stages} stages need")
