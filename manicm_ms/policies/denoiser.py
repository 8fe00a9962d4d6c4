"""The network that teacher and student share: normaliser, cloud frame, observation encoder and U-Net."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor, nn

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.point_net import DP3Encoder
from manicm_ms.policies.normalizer import Normalizer
from manicm_ms.policies.points import POINT_CHOICES
from manicm_ms.policies.unet1d import UNet1D
from manicm_ms.registry import Registry
from manicm_ms.spec import ACTION, AGENT_POS, POINT_CLOUD, ChunkSpec, EnvSpec

if TYPE_CHECKING:
    from manicm_ms.policies.base import ChannelStats


@dataclass(frozen=True)
class NetworkConfig:
    """Shape of the network; the defaults are DP3's.

    Attributes:
        down_dims: channels of each U-Net stage.
        resnets_per_stage: residual blocks of each U-Net stage.
        mid_blocks: residual blocks in the middle of the U-Net.
        kernel_size: taps of the U-Net's convolutions, odd.
        n_groups: of the group normalisations; divides every width.
        step_embed_dim: of the diffusion time's embedding, even.
        point_widths: of the per-point MLP.
        point_features: of a cloud.
        state_widths: of the proprioception MLP, the last one its features.
        cloud_frame: name in `CLOUD_FRAMES`: "base" (the environment's frame, min-max normalised) or "tcp"
            (relative to the tool centre point, which generalises far better from few demonstrations).
        cloud_scale: metres that become 1 in the "tcp" frame: about the reach of what matters around a gripper.
        max_points: so many points of a cloud are read, all where None.
        acting_points: which ones when acting, a name in `POINT_CHOICES`: "prefix" or "random". Checkpoints older than
            this field act on the prefix.
        training_points: which ones in training, so that a student learns from points like its teacher's. Checkpoints
            older than this field were trained on random ones.
        min_state_range: least range of a channel of agent_pos, in the channel's unit, when the normaliser is fitted;
            0 is DP3's rule. Checkpoints hold the fitted normaliser, so this changes none of them.
    """

    down_dims: tuple[int, ...] = (512, 1024, 2048)
    resnets_per_stage: int = 2
    mid_blocks: int = 2
    kernel_size: int = 5
    n_groups: int = 8
    step_embed_dim: int = 128
    point_widths: tuple[int, ...] = (64, 128, 256)
    point_features: int = 64
    state_widths: tuple[int, ...] = (64, 64)
    cloud_frame: str = "base"
    cloud_scale: float = 0.15
    max_points: int | None = None
    acting_points: str = "prefix"
    training_points: str = "random"
    min_state_range: float = 0.0

    def __post_init__(self) -> None:
        CLOUD_FRAMES.get(self.cloud_frame)
        POINT_CHOICES.get(self.acting_points)
        POINT_CHOICES.get(self.training_points)
        if self.kernel_size % 2 == 0:
            raise ConfigError(f"kernel_size must be odd, got {self.kernel_size}")
        if self.step_embed_dim % 2 or self.step_embed_dim < 4:
            raise ConfigError(f"step_embed_dim must be even and at least 4, got {self.step_embed_dim}")
        if bad := [width for width in self.down_dims if width % self.n_groups]:
            raise ConfigError(f"n_groups={self.n_groups} must divide every width of down_dims, not so for {bad}")
        if min(len(self.down_dims), self.resnets_per_stage, self.mid_blocks) < 1:
            raise ConfigError("down_dims needs a stage, and resnets_per_stage and mid_blocks must be at least 1")
        if self.max_points is not None and self.max_points < 1:
            raise ConfigError(f"max_points must be at least 1 or None, got {self.max_points}")
        if not self.cloud_scale > 0:
            raise ConfigError(f"cloud_scale must be above 0 m, got {self.cloud_scale}")
        if not self.min_state_range >= 0:
            raise ConfigError(f"min_state_range must be at least 0, got {self.min_state_range}")


class CloudFrame(Protocol):
    """How a raw cloud becomes the encoder's input."""

    def __init__(self, config: NetworkConfig, spec: EnvSpec) -> None: ...

    def __call__(self, cloud: Tensor, agent_pos: Tensor, normalizer: Normalizer) -> Tensor:
        """Return the input (B, To, P, C) for a cloud (B, To, P, C) in metres and agent_pos (B, To, D) in its units."""


CLOUD_FRAMES: Registry[type[CloudFrame]] = Registry("cloud_frame")


@CLOUD_FRAMES.register("base")
class BaseFrame:
    """The cloud in the environment's own frame, each channel mapped to [-1, 1] over the training data."""

    def __init__(self, config: NetworkConfig, spec: EnvSpec) -> None:
        del config, spec

    def __call__(self, cloud: Tensor, agent_pos: Tensor, normalizer: Normalizer) -> Tensor:
        """Return the normalised cloud (B, To, P, C)."""
        del agent_pos
        return normalizer.normalize(POINT_CLOUD, cloud)


@CLOUD_FRAMES.register("tcp")
class TcpFrame:
    """The cloud relative to the tool centre point of the same frame, in units of `cloud_scale` metres.

    The axes stay those of the environment's frame. Colours, where there are any, are mapped to [-1, 1].
    """

    def __init__(self, config: NetworkConfig, spec: EnvSpec) -> None:
        if spec.tcp_indices is None:
            raise ConfigError(
                f"cloud_frame 'tcp' needs the tool centre point, which agent_pos of {spec.env_id} does not hold: "
                "use cloud_frame 'base'"
            )
        self.tcp = list(spec.tcp_indices)
        self.scale = config.cloud_scale

    def __call__(self, cloud: Tensor, agent_pos: Tensor, normalizer: Normalizer) -> Tensor:
        """Return the relative cloud (B, To, P, C)."""
        xyz = (cloud[..., :3] - agent_pos[..., self.tcp].unsqueeze(-2)) / self.scale
        if cloud.shape[-1] == 3:
            return xyz.float()
        return torch.cat([xyz.float(), normalizer.normalize(POINT_CLOUD, cloud)[..., 3:]], dim=-1)


class ConditionedDenoiser(nn.Module):
    """A noisy action chunk and an observation in, a prediction about the clean chunk out.

    `encode` and `denoise` are apart because one observation serves every denoising step, and because the
    encoder is frozen while a student is distilled.

    Args:
        config: shape of the network.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta.

    Attributes:
        normalizer: of `point_cloud`, `agent_pos` and `action`.
        encoder: normalised observations to features.
        unet: the denoising network.
    """

    def __init__(self, config: NetworkConfig, spec: EnvSpec, chunk: ChunkSpec) -> None:
        super().__init__()
        self.config = config
        self.normalizer = Normalizer(
            {POINT_CLOUD: spec.obs.point_channels, AGENT_POS: spec.obs.agent_pos_dim, ACTION: spec.action.dim}
        )
        self.cloud_frame: CloudFrame = CLOUD_FRAMES.get(config.cloud_frame)(config, spec)
        self.encoder = DP3Encoder(
            spec.obs.point_channels,
            spec.obs.agent_pos_dim,
            chunk.n_obs_steps,
            config.point_widths,
            config.point_features,
            config.state_widths,
        )
        self.unet = UNet1D(
            spec.action.dim,
            self.encoder.out_features,
            config.down_dims,
            config.kernel_size,
            config.n_groups,
            config.step_embed_dim,
            config.resnets_per_stage,
            config.mid_blocks,
        )
        self.unet.check_horizon(chunk.horizon)

    @property
    def cond_dim(self) -> int:
        """Features of an observation."""
        return self.encoder.out_features

    def fit_normalizer(self, stats: Mapping[str, ChannelStats]) -> None:
        """Set the normaliser from the ranges of `point_cloud`, `agent_pos` and `action`, each in its unit."""
        self.normalizer.fit(stats, {AGENT_POS: self.config.min_state_range})

    def encode(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Return the features of raw observations, of which the first `max_points` points are read.

        Args:
            obs: `point_cloud` (B, To, P, C) and `agent_pos` (B, To, D), in the environment's units and frame.

        Returns:
            (B, cond_dim) float32.
        """
        cloud = obs[POINT_CLOUD][:, :, : self.config.max_points]
        points = self.cloud_frame(cloud, obs[AGENT_POS], self.normalizer)
        return self.encoder(points, self.normalizer.normalize(AGENT_POS, obs[AGENT_POS]))

    def encode_acting(self, obs: Mapping[str, Tensor], noise: Tensor) -> Tensor:
        """Return the features (B, cond_dim) of what is read when acting: the points that `acting_points` chooses.

        Args:
            obs: as for `encode`.
            noise: (B, Tp, Da) that the decision starts from; a random choice of points is a function of it.
        """
        cloud, count = obs[POINT_CLOUD], self.config.max_points
        if count is not None and count < cloud.shape[2]:
            cloud = POINT_CHOICES.get(self.config.acting_points).acting(cloud, count, noise)
        return self.encode({POINT_CLOUD: cloud, AGENT_POS: obs[AGENT_POS]})

    def act_on(self, points: str) -> None:
        """Read other points when acting from now on, by a name in `POINT_CHOICES`; a checkpoint saved later says so."""
        self.config = replace(self.config, acting_points=points)

    def denoise(self, x_t: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        """Return the U-Net's output (B, Tp, Da) for x_t (B, Tp, Da) normalised, t (B,) and cond (B, cond_dim)."""
        return self.unet(x_t, t, cond)
