"""The frame in which a point cloud is encoded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.transform import TRANSFORMS, InputTransform, Obs
from manicm_ms.registry import Registry
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, EnvSpec


class Frame(Protocol):
    """How a raw cloud and a normalised one become the encoder's input.

    Attributes:
        name: in `CLOUD_FRAMES`.
        reads: observations that it reads.
    """

    name: str
    reads: tuple[str, ...]

    def __call__(self, normalized: Tensor, raw: Obs) -> Tensor:
        """Return the input (B, To, P, C).

        Args:
            normalized: the cloud (B, To, P, C), each channel mapped to [-1, 1].
            raw: `reads`, in units and frame of the environment: the cloud in metres.
        """


CLOUD_FRAMES: Registry[Callable[[EnvSpec, float], Frame]] = Registry("cloud_frame")
"""name -> (spec, metres that become 1) -> frame; a configuration says "auto" where the environment decides."""


@CLOUD_FRAMES.register("base")
class BaseFrame:
    """The environment's own frame, each channel mapped to [-1, 1] over the training data."""

    name = "base"
    reads: tuple[str, ...] = (POINT_CLOUD,)

    def __init__(self, spec: EnvSpec, scale: float) -> None:
        del spec, scale

    def __call__(self, normalized: Tensor, raw: Obs) -> Tensor:
        """Return the normalised cloud (B, To, P, C)."""
        del raw
        return normalized


@CLOUD_FRAMES.register("tcp")
class TcpFrame:
    """The cloud relative to the tool centre point of the same frame, in units of `scale` metres.

    The axes stay those of the environment's frame. Colours, where there are any, are mapped to [-1, 1].
    """

    name = "tcp"
    reads: tuple[str, ...] = (POINT_CLOUD, AGENT_POS)

    def __init__(self, spec: EnvSpec, scale: float) -> None:
        if spec.tcp_indices is None:
            raise ConfigError(
                f"cloud_frame 'tcp' needs the tool centre point, which agent_pos of {spec.env_id} does not hold: "
                "use cloud_frame 'base'"
            )
        self.tcp, self.scale = list(spec.tcp_indices), scale

    def __call__(self, normalized: Tensor, raw: Obs) -> Tensor:
        """Return the relative cloud (B, To, P, C)."""
        cloud, agent_pos = raw[POINT_CLOUD], raw[AGENT_POS]
        xyz = (cloud[..., :3] - agent_pos[..., self.tcp].unsqueeze(-2)) / self.scale
        if cloud.shape[-1] == 3:
            return xyz.float()
        return torch.cat([xyz.float(), normalized[..., 3:]], dim=-1)


@CLOUD_FRAMES.register("auto")
def natural_frame(spec: EnvSpec, scale: float) -> Frame:
    """Return the tool's frame where `agent_pos` holds that point, else the base's (a hand without a tool)."""
    return BaseFrame(spec, scale) if spec.tcp_indices is None else TcpFrame(spec, scale)


@dataclass(frozen=True)
class CloudFrameConfig:
    """Frame and scale.

    Attributes:
        frame: name in `CLOUD_FRAMES`: "base" (the environment's frame, min-max normalised), "tcp" (relative to the tool
            centre point, which generalises far better from few demonstrations), or "auto": tcp where agent_pos holds
            that point, else base.
        scale: metres that become 1 in the "tcp" frame: about the reach of what matters around a gripper.
    """

    frame: str = "base"
    scale: float = 0.15

    def __post_init__(self) -> None:
        CLOUD_FRAMES.get(self.frame)
        if not self.scale > 0:
            raise ConfigError(f"the scale of a cloud's frame must be above 0 m, got {self.scale}")


@TRANSFORMS.register("cloud_frame")
class CloudFrame(InputTransform):
    """Gives the encoder the cloud in another frame.

    Args:
        config: frame and scale; afterwards it names the frame that "auto" resolved to.
        spec: the environment.
    """

    Config = CloudFrameConfig
    sizes: ClassVar = {"quick": {"frame": "auto"}, "smoke": {"frame": "auto"}}
    changes = (POINT_CLOUD,)

    def __init__(self, config: CloudFrameConfig, spec: EnvSpec) -> None:
        super().__init__(config, spec)
        self.frame = CLOUD_FRAMES.get(config.frame)(spec, config.scale)
        self.reads = self.frame.reads
        self.config = replace(config, frame=self.frame.name)

    def normalized(self, normalized: dict[str, Tensor], raw: Obs) -> dict[str, Tensor]:
        """See `InputTransform.normalized`."""
        return {**normalized, POINT_CLOUD: self.frame(normalized[POINT_CLOUD], raw)}
