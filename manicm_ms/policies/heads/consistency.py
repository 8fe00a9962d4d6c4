"""ManiCM's head (Gao, Lu et al. 2024): the teacher's network as a consistency function of one or a few steps."""

from __future__ import annotations

import copy
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.backbones.backbone import Backbone
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.policies.heads.consistency_solver import (
    SIGMA_DATA,
    SPACINGS,
    TIMESTEP_SCALING,
    boundary_scalings,
    solver_timesteps,
)
from manicm_ms.policies.heads.diffusion import PREDICTIONS, DiffusionConfig, DiffusionHead, Prediction
from manicm_ms.policies.heads.head import HEADS, ActionHead, State
from manicm_ms.spec import ChunkSpec


@dataclass(frozen=True)
class ConsistencyConfig(DiffusionConfig):
    """The teacher's noising process, and the consistency function with its sampler.

    Attributes:
        nfe: network evaluations of one decision; 1 in the paper's main result, 4 in its variant.
        num_solver_steps: K, steps of the grid of times on which the student is trained, spread evenly over the noising
            process. Sampling visits only these times: others were never seen in training.
        timestep_spacing: of that grid, a name in `SPACINGS`: "trailing" begins at T - 1, "leading" where the teacher's
            own sampler begins. A teacher that predicts epsilon needs "leading"; see `EpsilonPrediction`.
        sigma_data: balance value of the boundary scalings.
        timestep_scaling: beta of the boundary scalings.
    """

    nfe: int = 1
    num_solver_steps: int = 10
    timestep_spacing: str = "trailing"
    sigma_data: float = SIGMA_DATA
    timestep_scaling: float = TIMESTEP_SCALING

    def __post_init__(self) -> None:
        super().__post_init__()
        SPACINGS.get(self.timestep_spacing)
        if not 1 <= self.nfe <= self.num_solver_steps:
            raise ConfigError(f"nfe={self.nfe} must lie between 1 and num_solver_steps={self.num_solver_steps}")


@HEADS.register("consistency")
class ConsistencyHead(ActionHead):
    """Maps noise to a chunk by a consistency function f(x_t, t) = c_skip x_t + c_out F(x_t, t) (ManiCM).

    With nfe = 1, x0 = f(noise, last time of the grid), which is T - 1 for a student of a "sample" teacher. With more,
    noise is added to x0 again at the next lower time of the latent-consistency schedule (99, 79, 49, 29 for 4 of 10
    steps over T = 100) and f is applied anew.

    Args:
        config: the teacher's noising process, the consistency function and its sampler.
        backbone: the teacher's network, distilled.
        chunk: To, Tp, Ta.
        action_dim: Da.
        features: sizes of the observation's features.

    Attributes:
        alphas_cumprod: (T,) alpha_bar at each time.
        timesteps: times that sampling visits, descending.
    """

    Config = ConsistencyConfig
    needs_backbone = True
    role = "student"
    nfe_field = "nfe"
    alphas_cumprod: Tensor
    config: ConsistencyConfig
    backbone: Backbone

    def __init__(
        self, config: ConsistencyConfig, backbone: Backbone, chunk: ChunkSpec, action_dim: int, features: FeatureShape
    ) -> None:
        super().__init__(config, backbone, chunk, action_dim, features)
        self.prediction: Prediction = PREDICTIONS.get(config.prediction_type)()
        self.register_buffer("alphas_cumprod", config.ddpm().alphas_cumprod.clone(), persistent=False)
        self.timesteps = lcm_timesteps(config)

    @classmethod
    def from_teacher(cls, teacher: DiffusionHead, nfe: int = 1, **consistency: Any) -> ConsistencyHead:
        """Return a head that starts from a copy of the teacher's weights.

        Args:
            teacher: trained, left untouched.
            nfe: network evaluations of one decision.
            **consistency: further fields of `ConsistencyConfig`; `timestep_spacing` is by default what suits the
                teacher's prediction.
        """
        consistency.setdefault("timestep_spacing", teacher.prediction.timestep_spacing)
        process = {f.name: getattr(teacher.config, f.name) for f in fields(DiffusionConfig)}
        config = ConsistencyConfig(**process, nfe=nfe, **consistency)
        return cls(config, copy.deepcopy(teacher.backbone), *teacher.shape).to(teacher.alphas_cumprod.device)

    @property
    def nfe(self) -> int:
        """Number of network evaluations of one decision."""
        return self.config.nfe

    @property
    def noise_draws(self) -> int:
        """One array to start from, and one for each further evaluation."""
        return self.config.nfe

    def consistency_function(self, x_t: Tensor, t: Tensor, features: Features) -> Tensor:
        """Return f(x_t, t), as it is trained; whether x0 is clipped there, `Prediction.student_x0` says.

        Args:
            x_t: (B, Tp, Da) normalised noisy actions.
            t: (B,) int64 times.
            features: of the observations.

        Returns:
            (B, Tp, Da) normalised clean actions.
        """
        c_skip, c_out = self._scalings(t)
        x0 = self.prediction.student_x0(self._network_x0(x_t, t, features), self.config.clip_range)
        return c_skip * x_t + c_out * x0

    def sample(self, features: Features, noise: tuple[Tensor, ...]) -> Tensor:
        """Return a normalised chunk (B, Tp, Da) from `nfe` arrays of noise (B, Tp, Da).

        The network's x0 is clipped as in diffusers' `LCMScheduler`, which this loop equals.
        """
        limit = self.config.clip_range
        x_t, x0 = noise[0], noise[0]
        for step, t in enumerate(self.timesteps):
            if step > 0:
                alpha_bar = self.alphas_cumprod[t]
                x_t = alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * noise[step]
            times = torch.full((len(x_t),), t, device=x_t.device)
            c_skip, c_out = self._scalings(times)
            x0 = c_skip * x_t + c_out * self._network_x0(x_t, times, features).clamp(-limit, limit)
        return x0

    def act(self, features: Features, noise: tuple[Tensor, ...], state: State | None) -> tuple[Tensor, State | None]:
        """Choose chunks by `sample`; see `ActionHead.act`."""
        del state
        return self.sample(features, noise), None

    def _network_x0(self, x_t: Tensor, t: Tensor, features: Features) -> Tensor:
        output = self.backbone(x_t, (t,), features).float()
        return self.prediction.x0(output, x_t, self.alphas_cumprod[t][:, None, None])

    def _scalings(self, t: Tensor) -> tuple[Tensor, Tensor]:
        c_skip, c_out = boundary_scalings(t, self.config.sigma_data, self.config.timestep_scaling)
        return c_skip[:, None, None], c_out[:, None, None]


def lcm_timesteps(config: ConsistencyConfig) -> tuple[int, ...]:
    """Return the times that sampling visits, descending: every so many-th of the grid of training, from its end.

    On the trailing grid they are those of diffusers' `LCMScheduler` with `original_inference_steps` = K; its default
    of 50 would lead to times never trained on.
    """
    grid = solver_timesteps(config.num_train_timesteps, config.num_solver_steps, config.timestep_spacing)
    if config.nfe > len(grid):
        raise ConfigError(f"nfe={config.nfe} exceeds the {len(grid)} times of training: {grid.tolist()}")
    places = np.floor(np.linspace(0, len(grid), config.nfe, endpoint=False)).astype(int)
    return tuple(grid.flip(0)[places.tolist()].tolist())
