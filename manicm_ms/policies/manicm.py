"""The ManiCM student (Gao, Lu et al. 2024): the teacher's network as a consistency function of one or a few steps."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.base import (
    POLICIES,
    ChannelStats,
    Policy,
    check_obs,
    check_sections,
    starting_noise,
    updated_config,
)
from manicm_ms.policies.consistency import (
    SIGMA_DATA,
    SPACINGS,
    TIMESTEP_SCALING,
    boundary_scalings,
    solver_timesteps,
)
from manicm_ms.policies.denoiser import ConditionedDenoiser, NetworkConfig
from manicm_ms.policies.diffusion import PREDICTIONS, DiffusionConfig, DiffusionPolicy, Prediction, executed_actions
from manicm_ms.policies.finite import finite_obs
from manicm_ms.policies.normalizer import Normalizer
from manicm_ms.spec import ChunkSpec, EnvSpec


@dataclass(frozen=True)
class ConsistencyConfig:
    """The consistency function and its sampler.

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
        SPACINGS.get(self.timestep_spacing)
        if not 1 <= self.nfe <= self.num_solver_steps:
            raise ConfigError(f"nfe={self.nfe} must lie between 1 and num_solver_steps={self.num_solver_steps}")


class ManiCM(Policy):
    """Maps noise to an action chunk by a consistency function f(x_t, t) = c_skip x_t + c_out F(x_t, t).

    With nfe = 1, x0 = f(noise, last time of the grid), which is T - 1 for a student of a "sample" teacher. With more,
    noise is added to x0 again at the next lower time of the latent-consistency schedule (99, 79, 49, 29 for 4 of 10
    steps over T = 100) and f is applied anew.

    Args:
        network: encoder, U-Net and normaliser.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta.
        diffusion: the teacher's noising process.
        consistency: consistency function and sampler.

    Attributes:
        alphas_cumprod: (T,) alpha_bar at each time.
        timesteps: times that sampling visits, descending.
    """

    alphas_cumprod: Tensor

    name = "manicm"

    def __init__(
        self,
        network: ConditionedDenoiser,
        spec: EnvSpec,
        chunk: ChunkSpec,
        diffusion: DiffusionConfig,
        consistency: ConsistencyConfig,
    ) -> None:
        super().__init__()
        self.spec, self.chunk, self.diffusion, self.consistency = spec, chunk, diffusion, consistency
        self.network = network
        self.prediction: Prediction = PREDICTIONS.get(diffusion.prediction_type)()
        self.register_buffer("alphas_cumprod", diffusion.ddpm().alphas_cumprod.clone(), persistent=False)
        self.timesteps = lcm_timesteps(diffusion, consistency)

    @classmethod
    def from_teacher(cls, teacher: DiffusionPolicy, nfe: int = 1, **consistency: Any) -> ManiCM:
        """Return a student that starts from a copy of the teacher's weights and normaliser.

        Args:
            teacher: a trained policy, left untouched.
            nfe: network evaluations of one decision.
            **consistency: further fields of `ConsistencyConfig`; `timestep_spacing` is by default what suits the
                teacher's prediction.
        """
        consistency.setdefault("timestep_spacing", teacher.prediction.timestep_spacing)
        return cls(
            copy.deepcopy(teacher.network),
            teacher.spec,
            teacher.chunk,
            teacher.diffusion,
            ConsistencyConfig(nfe=nfe, **consistency),
        )

    def with_nfe(self, nfe: int) -> ManiCM:
        """Return a policy that shares these weights and evaluates the network `nfe` times a decision."""
        config = updated_config(self.consistency, {"nfe": nfe}, "the consistency function")
        return ManiCM(self.network, self.spec, self.chunk, self.diffusion, config).to(self.device)

    @property
    def nfe(self) -> int:
        """Number of network evaluations of one decision."""
        return self.consistency.nfe

    @property
    def noise_draws(self) -> int:
        """One array to start from, and one for each further evaluation."""
        return self.consistency.nfe

    @property
    def normalizer(self) -> Normalizer:
        """The network's normaliser."""
        return self.network.normalizer

    def config_dict(self) -> dict[str, Any]:
        """Return the sections `network`, `diffusion` and `consistency`."""
        return {
            "network": asdict(self.network.config),
            "diffusion": asdict(self.diffusion),
            "consistency": asdict(self.consistency),
        }

    def fit_normalizer(self, stats: Mapping[str, ChannelStats]) -> None:
        """Set the normaliser from the ranges of `point_cloud`, `agent_pos` and `action`."""
        self.network.fit_normalizer(stats)

    def consistency_function(self, x_t: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        """Return f(x_t, t), as it is trained; whether x0 is clipped there, `Prediction.student_x0` says.

        Args:
            x_t: (B, Tp, Da) normalised noisy actions.
            t: (B,) int64 times.
            cond: (B, cond_dim) features from `network.encode`.

        Returns:
            (B, Tp, Da) normalised clean actions.
        """
        c_skip, c_out = self._scalings(t)
        x0 = self.prediction.student_x0(self._network_x0(x_t, t, cond), self.diffusion.clip_range)
        return c_skip * x_t + c_out * x0

    def sample(self, cond: Tensor, noise: tuple[Tensor, ...]) -> Tensor:
        """Return a normalised chunk (B, Tp, Da) from `nfe` arrays of noise (B, Tp, Da).

        The network's x0 is clipped as in diffusers' `LCMScheduler`, which this loop equals.
        """
        limit = self.diffusion.clip_range
        x_t, x0 = noise[0], noise[0]
        for step, t in enumerate(self.timesteps):
            if step > 0:
                alpha_bar = self.alphas_cumprod[t]
                x_t = alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * noise[step]
            times = torch.full((len(x_t),), t, device=x_t.device)
            c_skip, c_out = self._scalings(times)
            x0 = c_skip * x_t + c_out * self._network_x0(x_t, times, cond).clamp(-limit, limit)
        return x0

    @torch.inference_mode()
    def act(
        self, obs: Mapping[str, Tensor], *, generator: torch.Generator | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Choose the next actions; see `Policy.act`."""
        batch, obs = check_obs(obs, self.spec, self.chunk), finite_obs(obs, self.spec)
        draws = starting_noise(self, batch, generator, noise)
        return executed_actions(self, self.sample(self.network.encode_acting(obs, draws[0]), draws))

    def _network_x0(self, x_t: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        output = self.network.denoise(x_t, t, cond).float()
        return self.prediction.x0(output, x_t, self.alphas_cumprod[t][:, None, None])

    def _scalings(self, t: Tensor) -> tuple[Tensor, Tensor]:
        config = self.consistency
        c_skip, c_out = boundary_scalings(t, config.sigma_data, config.timestep_scaling)
        return c_skip[:, None, None], c_out[:, None, None]


def lcm_timesteps(diffusion: DiffusionConfig, consistency: ConsistencyConfig) -> tuple[int, ...]:
    """Return the times that sampling visits, descending: every so many-th of the grid of training, from its end.

    On the trailing grid they are those of diffusers' `LCMScheduler` with `original_inference_steps` = K; its default
    of 50 would lead to times never trained on.
    """
    grid = solver_timesteps(diffusion.num_train_timesteps, consistency.num_solver_steps, consistency.timestep_spacing)
    if consistency.nfe > len(grid):
        raise ConfigError(f"nfe={consistency.nfe} exceeds the {len(grid)} times of training: {grid.tolist()}")
    places = np.floor(np.linspace(0, len(grid), consistency.nfe, endpoint=False)).astype(int)
    return tuple(grid.flip(0)[places.tolist()].tolist())


@POLICIES.register("manicm", tags=("student",))
def manicm(config: Mapping[str, Any], spec: EnvSpec, chunk: ChunkSpec) -> ManiCM:
    """Build an untrained student; `config` has the sections `network`, `diffusion` and `consistency`."""
    check_sections(config, ("network", "diffusion", "consistency"), "manicm")
    network = updated_config(NetworkConfig(), config.get("network", {}), "the network of manicm")
    diffusion = updated_config(DiffusionConfig(), config.get("diffusion", {}), "the diffusion process of manicm")
    consistency = updated_config(
        ConsistencyConfig(), config.get("consistency", {}), "the consistency function of manicm"
    )
    return ManiCM(ConditionedDenoiser(network, spec, chunk), spec, chunk, diffusion, consistency)
