"""A box to which clouds are cropped before a policy reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.transform import TRANSFORMS, InputTransform, Obs
from manicm_ms.policies.policy import ChannelStats
from manicm_ms.spec import POINT_CLOUD, EnvSpec

Point = tuple[float, float, float]


@dataclass(frozen=True)
class CropConfig:
    """The box, axis-aligned, in the cloud's own frame.

    Attributes:
        low: least x, y, z of a point that is read, metres; None: no limit.
        high: greatest x, y, z, metres; None: no limit.
    """

    low: Point | None = None
    high: Point | None = None

    def __post_init__(self) -> None:
        if self.low is not None and self.high is not None and not all(np.less(self.low, self.high)):
            raise ConfigError(f"a crop's low {self.low} must lie below its high {self.high} on each axis")


class _Range(NamedTuple):
    min: np.ndarray
    max: np.ndarray


@TRANSFORMS.register("cloud_crop")
class CloudCrop(InputTransform):
    """Reads only the points inside a box, so that what a choice of few points is spent on is what matters.

    The points inside keep their order (farthest-point order, decision 0006, so that a prefix is still an even sample)
    and fill the cloud again from the beginning, which an encoder that pools by maximum does not see. A cloud without a
    point inside is read as it is. The cloud's range for the normalizer is cut to the box.

    Args:
        config: the box.
        spec: the environment.
    """

    Config = CropConfig
    reads = (POINT_CLOUD,)
    config: CropConfig

    def __init__(self, config: CropConfig, spec: EnvSpec) -> None:
        super().__init__(config, spec)
        far = float("inf")
        self._low = torch.tensor(config.low or (-far,) * 3)
        self._high = torch.tensor(config.high or (far,) * 3)

    def read_acting(self, obs: Obs, noise: Tensor) -> Obs:
        """See `InputTransform.read_acting`."""
        del noise
        return self._cropped(obs)

    def read_training(self, obs: Obs, generator: torch.Generator) -> Obs:
        """See `InputTransform.read_training`."""
        del generator
        return self._cropped(obs)

    def ranges(self, stats: Mapping[str, ChannelStats]) -> Mapping[str, ChannelStats]:
        """See `InputTransform.ranges`; raise ConfigError where the box lies beside all points of the training data."""
        if self._everything or POINT_CLOUD not in stats:
            return stats
        least, most = (np.array(limit, dtype=float) for limit in (stats[POINT_CLOUD].min, stats[POINT_CLOUD].max))
        low, high = self._low.numpy(), self._high.numpy()
        for axis, name in enumerate("xyz"):
            if low[axis] > most[axis] or high[axis] < least[axis]:
                raise ConfigError(
                    f"the box of inputs.cloud_crop holds no point of the demonstrations: their {name} runs from "
                    f"{least[axis]:.3g} to {most[axis]:.3g}, the box's from {low[axis]:.3g} to {high[axis]:.3g}"
                )
        least[:3], most[:3] = np.clip(least[:3], low, high), np.clip(most[:3], low, high)
        return {**stats, POINT_CLOUD: _Range(least, most)}

    @property
    def _everything(self) -> bool:
        return self.config.low is None and self.config.high is None

    def _cropped(self, obs: Obs) -> Obs:
        if self._everything:
            return obs
        cloud = obs[POINT_CLOUD]  # (B, To, P, C)
        xyz = cloud[..., :3]
        inside = ((xyz >= self._low.to(cloud.device)) & (xyz <= self._high.to(cloud.device))).all(-1)  # (B, To, P)
        inside |= ~inside.any(-1, keepdim=True)
        order = inside.to(torch.uint8).argsort(dim=-1, descending=True, stable=True)  # the points inside come first
        place = torch.arange(cloud.shape[2], device=cloud.device) % inside.sum(-1, keepdim=True)  # (B, To, P)
        chosen = order.gather(-1, place)[..., None].expand_as(cloud)
        return {**obs, POINT_CLOUD: cloud.gather(2, chosen)}
