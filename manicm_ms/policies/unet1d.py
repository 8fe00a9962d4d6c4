"""The denoising network over an action chunk: a 1-D U-Net whose blocks are modulated by time and observation."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from manicm_ms.errors import ConfigError


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
        angles = t.float()[:, None] * self.rates
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


class UNet1D(nn.Module):
    """Predicts the clean action chunk (or its noise) from a noisy one.

    Each stage but the last halves the time axis, and the way up doubles it again; skip connections join
    equal lengths. The first stage's output is not joined, as in the public code. For three stages of
    widths a, b, c and Tp = 4::

        down   Da -> a, 4     a -> b, 2     b -> c, 1
        middle                              c -> c, 1
        up      2b -> a, 2 -> 4   <-   2c -> b, 1 -> 2        then a -> Da, 4

    Args:
        action_dim: Da.
        cond_dim: of the observation's features.
        down_dims: width of each stage.
        kernel_size: taps of the convolutions, odd.
        n_groups: of the group normalisations.
        step_embed_dim: of the diffusion time's embedding.
        resnets_per_stage: residual blocks of each stage; 2 in DP3, 1 in Simple DP3.
        mid_blocks: residual blocks between the way down and the way up; 2 in DP3, 1 in Simple DP3.
    """

    def __init__(
        self,
        action_dim: int,
        cond_dim: int,
        down_dims: Sequence[int] = (512, 1024, 2048),
        kernel_size: int = 5,
        n_groups: int = 8,
        step_embed_dim: int = 128,
        resnets_per_stage: int = 2,
        mid_blocks: int = 2,
    ) -> None:
        super().__init__()
        self.down_dims = tuple(down_dims)
        self.time_embedding = nn.Sequential(
            SinusoidalEmbedding(step_embed_dim),
            nn.Linear(step_embed_dim, 4 * step_embed_dim),
            nn.Mish(),
            nn.Linear(4 * step_embed_dim, step_embed_dim),
        )
        shape = (step_embed_dim + cond_dim, kernel_size, n_groups)
        pairs = list(itertools.pairwise((action_dim, *down_dims)))
        self.down = nn.ModuleList([FiLMStack(resnets_per_stage, i, o, *shape) for i, o in pairs])
        self.downsample = nn.ModuleList([nn.Conv1d(o, o, 3, stride=2, padding=1) for _, o in pairs[:-1]])
        self.middle = FiLMStack(mid_blocks, down_dims[-1], down_dims[-1], *shape)
        upward = pairs[:0:-1]  # from the last stage to the second
        self.up = nn.ModuleList([FiLMStack(resnets_per_stage, 2 * o, i, *shape) for i, o in upward])
        self.upsample = nn.ModuleList([nn.ConvTranspose1d(i, i, 4, stride=2, padding=1) for i, _ in upward])
        self.head = nn.Sequential(
            ConvBlock(down_dims[0], down_dims[0], kernel_size, n_groups), nn.Conv1d(down_dims[0], action_dim, 1)
        )

    def check_horizon(self, horizon: int) -> None:
        """Raise ConfigError where a chunk of `horizon` actions cannot be halved at every stage."""
        unit = 2 ** (len(self.down_dims) - 1)
        if horizon % unit:
            raise ConfigError(f"horizon {horizon} is no multiple of {unit}, which {len(self.down_dims)} stages need")

    def forward(self, x_t: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        """Return the prediction (B, Tp, Da) for noisy actions x_t (B, Tp, Da), times t (B,) and cond (B, cond_dim)."""
        cond = torch.cat([self.time_embedding(t), cond], dim=-1)
        x = x_t.transpose(1, 2)  # (B, Da, Tp)
        skips = []
        for index, stage in enumerate(self.down):
            x = stage(x, cond)
            skips.append(x)
            if index < len(self.downsample):
                x = self.downsample[index](x)
        x = self.middle(x, cond)
        for stage, upsample in zip(self.up, self.upsample, strict=True):
            x = upsample(stage(torch.cat([x, skips.pop()], dim=1), cond))
        return self.head(x).transpose(1, 2)
