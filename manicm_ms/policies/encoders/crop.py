"""Crops of pictures and of voxel grids: another one of each frame in each step of training, the middle when acting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.transform import TRANSFORMS, InputTransform, Obs
from manicm_ms.spec import IMAGE, VOXEL_GRID, EnvSpec


def centre_crop(frames: Tensor, axes: tuple[int, ...], share: float) -> Tensor:
    """Return the middle of frames (N, ...), `share` of each side of `axes`; odd rests are split as by torchvision."""
    for axis in axes:
        size = frames.shape[axis]
        kept = kept_side(size, share)
        frames = frames.narrow(axis, round((size - kept) / 2), kept)
    return frames


def random_crop(frames: Tensor, axes: tuple[int, ...], share: float, generator: torch.Generator) -> Tensor:
    """Return a part of each of the frames (N, ...), `share` of each side of `axes`, its place drawn for each alone."""
    n, device = len(frames), frames.device
    index: list[Tensor] = [torch.arange(n, device=device).view(-1, *[1] * len(axes))]
    for place, axis in enumerate(axes):
        size = frames.shape[axis]
        kept = kept_side(size, share)
        start = torch.randint(size - kept + 1, (n, 1), generator=generator, device=device)
        shape = [n, *(kept if k == place else 1 for k in range(len(axes)))]
        index.append((start + torch.arange(kept, device=device)).view(shape))
    ahead = tuple(range(1, 1 + len(axes)))
    return frames.movedim(axes, ahead)[tuple(index)].movedim(ahead, axes)


def kept_side(size: int, share: float) -> int:
    """Return how much of a side is kept: 76 of 84 pixels, 58 of 64 cells, 29 of 32."""
    return max(1, round(size * share))


class Crop(InputTransform):
    """Reads a part of each frame of one observation: in training at random places, when acting the middle.

    Each of the To frames of a row has a place of its own, as in the published code. Bytes stay bytes.
    """

    key: ClassVar[str]
    """The observation that is cropped."""
    axes: ClassVar[tuple[int, ...]]
    """Its sides, as axes of (N, ...)."""

    def read_acting(self, obs: Obs, noise: Tensor) -> Obs:
        """See `InputTransform.read_acting`."""
        del noise
        frames = obs[self.key]
        cropped = centre_crop(frames.flatten(0, 1), self.axes, self.config.share)
        return {**obs, self.key: cropped.unflatten(0, frames.shape[:2])}

    def read_training(self, obs: Obs, generator: torch.Generator) -> Obs:
        """See `InputTransform.read_training`."""
        frames = obs[self.key]
        cropped = random_crop(frames.flatten(0, 1), self.axes, self.config.share, generator)
        return {**obs, self.key: cropped.unflatten(0, frames.shape[:2])}

    def varies(self, obs: Obs) -> bool:
        """See `InputTransform.varies`."""
        sides = [obs[self.key].shape[axis + 1] for axis in self.axes]
        return any(kept_side(side, self.config.share) < side for side in sides)


def _require_share(share: float) -> None:
    if not 0 < share <= 1:
        raise ConfigError(f"the share of a side that a crop keeps must lie in (0, 1], got {share}")


@dataclass(frozen=True)
class ImageCropConfig:
    """How much of a picture is read.

    Attributes:
        share: of each side: 76 of 84 pixels, and as much of other sizes.
    """

    share: float = 76 / 84

    def __post_init__(self) -> None:
        _require_share(self.share)


@TRANSFORMS.register("image_crop")
class ImageCrop(Crop):
    """Crops camera images, as Diffusion Policy does (Chi et al. 2023).

    Args:
        config: how much is kept.
        spec: the environment.
    """

    Config = ImageCropConfig
    config: ImageCropConfig
    key, axes = IMAGE, (1, 2)
    reads = changes = (IMAGE,)

    def __init__(self, config: ImageCropConfig, spec: EnvSpec) -> None:
        super().__init__(config, spec)


@dataclass(frozen=True)
class VoxelCropConfig:
    """How much of a voxel grid is read.

    Attributes:
        share: of each side: 58 of 64 cells, and as much of other sizes: 29 of 32.
    """

    share: float = 58 / 64

    def __post_init__(self) -> None:
        _require_share(self.share)


@TRANSFORMS.register("voxel_crop")
class VoxelCrop(Crop):
    """Crops voxel grids, as Equivariant Diffusion Policy does (Wang et al. 2024).

    Args:
        config: how much is kept.
        spec: the environment.
    """

    Config = VoxelCropConfig
    config: VoxelCropConfig
    key, axes = VOXEL_GRID, (2, 3, 4)
    reads = changes = (VOXEL_GRID,)

    def __init__(self, config: VoxelCropConfig, spec: EnvSpec) -> None:
        super().__init__(config, spec)
