"""Diffusion Policy's encoder of camera images: a ResNet-18 and a spatial soft-max, and proprioception as it is."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.encoders.encoder import ENCODERS, Features, FeatureShape, ObsEncoder
from manicm_ms.policies.encoders.state import frame_features
from manicm_ms.spec import AGENT_POS, IMAGE, ChunkSpec, EnvSpec

_GROUP = 16
"""Channels of a group of GroupNorm."""
_LEAST = 48
"""Pixels: a map of the trunk has a 32nd of the cropped side, and should have more than one place."""


def _norm(channels: int) -> nn.GroupNorm:
    return nn.GroupNorm(channels // _GROUP, channels)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a way around them (He et al. 2016, Deep Residual Learning), with GroupNorm.

    Args:
        in_channels: of the input.
        channels: of the output.
        stride: of the first convolution; where it or the channels change, so does the way around, by a 1x1 convolution.
    """

    def __init__(self, in_channels: int, channels: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, channels, 3, stride, padding=1, bias=False)
        self.norm1 = _norm(channels)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        self.norm2 = _norm(channels)
        self.around: nn.Module = nn.Identity()
        if stride != 1 or in_channels != channels:
            self.around = nn.Sequential(nn.Conv2d(in_channels, channels, 1, stride, bias=False), _norm(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Return (N, channels, H / stride, W / stride)."""
        inner = self.norm2(self.conv2(relu(self.norm1(self.conv1(x)))))
        return relu(inner + self.around(x))


class ResNet18(nn.Module):
    """The trunk of a ResNet-18, not pretrained, without its pooling and its classifier.

    GroupNorm of channels / 16 groups stands in place of BatchNorm, whose running statistics do not go with averaged
    weights (Chi et al. 2023, Diffusion Policy, section III-B).

    Args:
        width: channels of the first stage, 64 as published; the others have 2, 4 and 8 times as many.
    """

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            nn.Conv2d(3, width, 7, 2, padding=3, bias=False), _norm(width), nn.ReLU(), nn.MaxPool2d(3, 2, padding=1)
        )
        channels = (width, width, 2 * width, 4 * width, 8 * width)
        self.stages = nn.Sequential(
            *(
                nn.Sequential(BasicBlock(before, after, 1 if k == 0 else 2), BasicBlock(after, after, 1))
                for k, (before, after) in enumerate(itertools.pairwise(channels))
            )
        )

    def forward(self, image: Tensor) -> Tensor:
        """Return (N, 8 width, H / 32, W / 32) of images (N, 3, H, W)."""
        return self.stages(self.stem(image))


class SpatialSoftmax(nn.Module):
    """Where each of K maps is large: the mean place under a soft-max over the map, temperature 1 (Finn et al. 2016).

    Args:
        channels: of what the maps are made of, by a 1x1 convolution.
        keypoints: K.
    """

    def __init__(self, channels: int, keypoints: int) -> None:
        super().__init__()
        self.maps = nn.Conv2d(channels, keypoints, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Return (N, K, 2): x, to the right, and y, downward, in [-1, 1] of features (N, C, H, W)."""
        height, width = features.shape[-2:]
        weight = self.maps(features).flatten(2).float().softmax(-1)  # (N, K, H W)
        y = torch.linspace(-1, 1, height, device=weight.device)
        x = torch.linspace(-1, 1, width, device=weight.device)
        place = torch.stack([x.expand(height, width), y[:, None].expand(height, width)], dim=-1)
        return weight @ place.reshape(-1, 2)


@dataclass(frozen=True)
class ImageEncoderConfig:
    """Sizes of the encoder.

    Attributes:
        width: channels of the ResNet's first stage, a multiple of 16.
        keypoints: of the spatial soft-max.
        features: of an image.
    """

    width: int = 64
    keypoints: int = 32
    features: int = 64

    def __post_init__(self) -> None:
        require_at_least(1, width=self.width, keypoints=self.keypoints, features=self.features)
        if self.width % _GROUP:
            raise ConfigError(f"the width of a ResNet with GroupNorm must be a multiple of {_GROUP}, got {self.width}")


@ENCODERS.register("image")
class ImageEncoder(ObsEncoder):
    """Encodes To frames: per frame the image's features, then proprioception, which no layer changes.

    Diffusion Policy's hybrid encoder (robomimic's VisualCore): bytes mapped to [-1, 1], ResNet-18, spatial soft-max,
    a linear layer.

    Args:
        config: sizes.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta.

    Raises:
        ConfigError: the images are too small.
    """

    Config = ImageEncoderConfig
    config: ImageEncoderConfig
    sizes: ClassVar = {"smoke": {"width": 16, "keypoints": 8, "features": 16}}
    keys = (IMAGE, AGENT_POS)

    def __init__(self, config: ImageEncoderConfig, spec: EnvSpec, chunk: ChunkSpec) -> None:
        super().__init__(config, spec, chunk)
        if min(spec.obs.image_size) < _LEAST:
            height, width = spec.obs.image_size
            raise ConfigError(
                f"images of {height} x {width} pixels leave the spatial soft-max a single place: render at least "
                f"{_LEAST} x {_LEAST}"
            )
        self.trunk = ResNet18(config.width)
        self.places = SpatialSoftmax(8 * config.width, config.keypoints)
        self.output = nn.Linear(2 * config.keypoints, config.features)
        width = config.features + spec.obs.agent_pos_dim
        self.shape = FeatureShape(chunk.n_obs_steps * width, (chunk.n_obs_steps, width))

    def forward(self, obs: Mapping[str, Tensor]) -> Features:
        """Return the features of images (B, To, H, W, 3) uint8 and normalised proprioception (B, To, D)."""
        image, agent_pos = obs[IMAGE], obs[AGENT_POS]
        pixels = image.flatten(0, 1).movedim(-1, 1).float() / 127.5 - 1  # (B To, 3, H, W)
        seen = self.output(self.places(self.trunk(pixels)).flatten(1))
        return frame_features([seen, agent_pos.flatten(0, 1)], image.shape[1])
