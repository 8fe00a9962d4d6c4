"""The diffusion teacher: clean action and noise as separate quantities, DDIM sampling, the one-step control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.policies.base import ChannelStats, Policy, check_obs, starting_noise
from manicm_ms.policies.denoiser import ConditionedDenoiser
from manicm_ms.policies.finite import finite_obs, require_finite_actions
from manicm_ms.policies.normalizer import Normalizer
from manicm_ms.registry import Registry
from manicm_ms.spec import ACTION, ChunkSpec, EnvSpec


def epsilon_from_x0(x_t: Tensor, x0: Tensor, alpha_bar: Tensor) -> Tensor:
    """Return the noise in x_t, given its clean part: epsilon = (x_t - sqrt(abar) x0) / sqrt(1 - abar).

    Inverts x_t = sqrt(abar) x0 + sqrt(1 - abar) epsilon (Ho et al. 2020, equation 4).

    Args:
        x_t: (B, Tp, Da) noisy actions.
        x0: (B, Tp, Da) clean actions.
        alpha_bar: broadcastable to them, cumulative product of the alphas at t, below 1.
    """
    return (x_t - alpha_bar.sqrt() * x0) / (1 - alpha_bar).sqrt()


def x0_from_epsilon(x_t: Tensor, epsilon: Tensor, alpha_bar: Tensor) -> Tensor:
    """Return the clean part of x_t, given its noise: x0 = (x_t - sqrt(1 - abar) epsilon) / sqrt(abar).

    Arguments as those of `epsilon_from_x0`, alpha_bar above 0.
    """
    return (x_t - (1 - alpha_bar).sqrt() * epsilon) / alpha_bar.sqrt()


class Guess(NamedTuple):
    """What a network takes a noisy action to be made of.

    Attributes:
        x0: (B, Tp, Da) clean actions, clipped where sampling clips.
        epsilon: (B, Tp, Da) noise, of the network's output as it is: diffusers' DDIM steps along the noise of the
            unclipped output, so that x0 and epsilon need not add up to x_t where clipping acts.
    """

    x0: Tensor
    epsilon: Tensor


class Prediction(Protocol):
    """What the network's output means; all arrays are (B, Tp, Da), alpha_bar broadcasts to them.

    Attributes:
        timestep_spacing: where a single evaluation, and a student, begin: "trailing" at the last time T - 1, "leading"
            at the first time that the teacher's own sampler visits.
    """

    timestep_spacing: ClassVar[str]

    def target(self, x0: Tensor, epsilon: Tensor) -> Tensor:
        """Return what the network is trained to output."""

    def x0(self, output: Tensor, x_t: Tensor, alpha_bar: Tensor) -> Tensor:
        """Return the clean action that an output implies."""

    def epsilon(self, output: Tensor, x_t: Tensor, alpha_bar: Tensor) -> Tensor:
        """Return the noise that an output implies."""

    def student_x0(self, x0: Tensor, limit: float) -> Tensor:
        """Return the clean action as a student's loss sees it; in sampling it is clipped to [-limit, limit]."""


PREDICTIONS: Registry[type[Prediction]] = Registry("prediction_type")


@PREDICTIONS.register("sample")
class SamplePrediction:
    """The network outputs the clean action x0."""

    timestep_spacing = "trailing"

    def target(self, x0: Tensor, epsilon: Tensor) -> Tensor:
        """Return `x0`."""
        del epsilon
        return x0

    def x0(self, output: Tensor, x_t: Tensor, alpha_bar: Tensor) -> Tensor:
        """Return `output`."""
        del x_t, alpha_bar
        return output

    def epsilon(self, output: Tensor, x_t: Tensor, alpha_bar: Tensor) -> Tensor:
        """Return the noise; see `epsilon_from_x0`."""
        return epsilon_from_x0(x_t, output, alpha_bar)

    def student_x0(self, x0: Tensor, limit: float) -> Tensor:
        """Return `x0` as it is: nothing multiplies the network's error, and its targets lie within the limit."""
        del limit
        return x0


@PREDICTIONS.register("epsilon")
class EpsilonPrediction:
    """The network outputs the noise epsilon.

    In x0 its error is multiplied by sqrt((1 - abar) / abar): 2029 at the last of 100 times, where no network is
    accurate enough to say anything about x0, and 7.1 at time 90, where the sampler of ten steps begins.
    """

    timestep_spacing = "leading"

    def target(self, x0: Tensor, epsilon: Tensor) -> Tensor:
        """Return `epsilon`."""
        del x0
        return epsilon

    def x0(self, output: Tensor, x_t: Tensor, alpha_bar: Tensor) -> Tensor:
        """Return the clean action; see `x0_from_epsilon`."""
        return x0_from_epsilon(x_t, output, alpha_bar)

    def epsilon(self, output: Tensor, x_t: Tensor, alpha_bar: Tensor) -> Tensor:
        """Return `output`."""
        del x_t, alpha_bar
        return output

    def student_x0(self, x0: Tensor, limit: float) -> Tensor:
        """Return `x0` clipped as in sampling, with the gradient of the unclipped one.

        A plain clip has no gradient beyond the limit, which is where a wrong epsilon puts x0, so that it could never be
        corrected (Bengio et al. 2013, straight-through estimator).
        """
        return x0.clamp(-limit, limit).detach() + (x0 - x0.detach())


@dataclass(frozen=True)
class DiffusionConfig:
    """The noising process and its sampler.

    Attributes:
        num_train_timesteps: T; times run from 0 (almost clean) to T - 1 (noise).
        num_inference_steps: network evaluations of one decision.
        beta_schedule: diffusers' name of the noise schedule.
        prediction_type: what the network outputs, a name in `PREDICTIONS`.
        clip_range: clean actions are clipped to [-clip_range, clip_range] (normalised units) at each step.
    """

    num_train_timesteps: int = 100
    num_inference_steps: int = 10
    beta_schedule: str = "squaredcos_cap_v2"
    prediction_type: str = "sample"
    clip_range: float = 1.0

    def __post_init__(self) -> None:
        PREDICTIONS.get(self.prediction_type)
        if not 1 <= self.num_inference_steps <= self.num_train_timesteps:
            raise ConfigError(
                f"num_inference_steps={self.num_inference_steps} must lie between 1 and "
                f"num_train_timesteps={self.num_train_timesteps}"
            )

    def ddpm(self) -> DDPMScheduler:
        """Return the noising process for training."""
        return DDPMScheduler(**self._shared())

    def ddim(self, num_inference_steps: int) -> DDIMScheduler:
        """Return the deterministic sampler over "leading" timesteps (90, 80, ..., 0 for 10 of 100 steps)."""
        scheduler = DDIMScheduler(**self._shared(), set_alpha_to_one=True, steps_offset=0)
        scheduler.set_timesteps(num_inference_steps)
        return scheduler

    def _shared(self) -> dict[str, Any]:
        return {
            "num_train_timesteps": self.num_train_timesteps,
            "beta_schedule": self.beta_schedule,
            "prediction_type": self.prediction_type,
            "clip_sample": True,
            "clip_sample_range": self.clip_range,
            "timestep_spacing": "leading",
        }


class DiffusionPolicy(Policy):
    """Samples an action chunk by DDIM from a network conditioned on the observation (DP3, Ze et al. 2024).

    Args:
        name: in `POLICIES`.
        network: encoder, U-Net and normaliser.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta.
        diffusion: noising process and sampler.

    Attributes:
        alphas_cumprod: (T,) alpha_bar at each time.
    """

    alphas_cumprod: Tensor

    def __init__(
        self, name: str, network: ConditionedDenoiser, spec: EnvSpec, chunk: ChunkSpec, diffusion: DiffusionConfig
    ) -> None:
        super().__init__()
        self.name, self.spec, self.chunk, self.diffusion = name, spec, chunk, diffusion
        self.network = network
        self.prediction: Prediction = PREDICTIONS.get(diffusion.prediction_type)()
        self.register_buffer("alphas_cumprod", diffusion.ddpm().alphas_cumprod.clone(), persistent=False)
        self._samplers: dict[int, DDIMScheduler] = {}

    @property
    def nfe(self) -> int:
        """Number of DDIM steps."""
        return self.diffusion.num_inference_steps

    @property
    def normalizer(self) -> Normalizer:
        """The network's normaliser."""
        return self.network.normalizer

    def config_dict(self) -> dict[str, Any]:
        """Return the sections `network` and `diffusion`."""
        return {"network": asdict(self.network.config), "diffusion": asdict(self.diffusion)}

    def fit_normalizer(self, stats: Mapping[str, ChannelStats]) -> None:
        """Set the normaliser from the ranges of `point_cloud`, `agent_pos` and `action`."""
        self.network.fit_normalizer(stats)

    def add_noise(self, x0: Tensor, epsilon: Tensor, t: Tensor) -> Tensor:
        """Return x_t = sqrt(abar_t) x0 + sqrt(1 - abar_t) epsilon, all (B, Tp, Da), for integer times t (B,)."""
        alpha_bar = self.alphas_cumprod[t][:, None, None]
        return alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * epsilon

    def predict_x0(self, x_t: Tensor, t: Tensor, cond: Tensor) -> Tensor:
        """Return the clean chunk that the network sees in a noisy one, clipped as in sampling.

        Args:
            x_t: (B, Tp, Da) normalised noisy actions.
            t: (B,) int64 times.
            cond: (B, cond_dim) features from `network.encode`.

        Returns:
            (B, Tp, Da) normalised, within the clipping range.
        """
        return self.guess(x_t, t, cond).x0

    def guess(self, x_t: Tensor, t: Tensor, cond: Tensor) -> Guess:
        """Return the clean chunk and the noise with which `sample` takes its step; arguments as for `predict_x0`."""
        output, limit = self.network.denoise(x_t, t, cond).float(), self.diffusion.clip_range
        alpha_bar = self.alphas_cumprod[t][:, None, None]
        x0 = self.prediction.x0(output, x_t, alpha_bar)
        return Guess(x0.clamp(-limit, limit), self.prediction.epsilon(output, x_t, alpha_bar))

    @property
    def first_time(self) -> int:
        """Time at which a single evaluation reads pure noise; see `Prediction.timestep_spacing`."""
        if self.prediction.timestep_spacing == "trailing":
            return self.diffusion.num_train_timesteps - 1
        return int(self._sampler(self.diffusion.num_inference_steps).timesteps[0])

    def sample(self, cond: Tensor, noise: Tensor, num_inference_steps: int | None = None) -> Tensor:
        """Return a normalised chunk (B, Tp, Da) denoised from `noise` (B, Tp, Da) by DDIM without added noise."""
        sampler = self._sampler(num_inference_steps or self.diffusion.num_inference_steps)
        x_t = noise
        for t in sampler.timesteps.tolist():
            output = self.network.denoise(x_t, torch.full((len(x_t),), t, device=x_t.device), cond).float()
            x_t = sampler.step(output, t, x_t, return_dict=False)[0]
        return x_t

    @torch.inference_mode()
    def act(
        self,
        obs: Mapping[str, Tensor],
        *,
        generator: torch.Generator | None = None,
        noise: Tensor | None = None,
        num_inference_steps: int | None = None,
    ) -> Tensor:
        """Choose the next actions; see `Policy.act`. `num_inference_steps` overrides the configured number."""
        batch, obs = check_obs(obs, self.spec, self.chunk), finite_obs(obs, self.spec)
        (start,) = starting_noise(self, batch, generator, noise)
        chunk = self.sample(self.network.encode_acting(obs, start), start, num_inference_steps)
        return executed_actions(self, chunk)

    def _sampler(self, steps: int) -> DDIMScheduler:
        if steps not in self._samplers:
            self._samplers[steps] = self.diffusion.ddim(steps)
        return self._samplers[steps]


class OneStepTeacher(Policy):
    """The control for distillation: the undistilled teacher's own guess at x0 from pure noise, in one evaluation.

    Args:
        teacher: the policy that is run at its `first_time` only; its weights are shared.
    """

    registered = False

    def __init__(self, teacher: DiffusionPolicy) -> None:
        super().__init__()
        self.teacher = teacher
        self.name, self.spec, self.chunk = f"{teacher.name}_one_step", teacher.spec, teacher.chunk

    @property
    def nfe(self) -> int:
        """One."""
        return 1

    @property
    def network(self) -> ConditionedDenoiser:
        """The teacher's network."""
        return self.teacher.network

    @property
    def normalizer(self) -> Normalizer:
        """The teacher's normaliser."""
        return self.teacher.normalizer

    def config_dict(self) -> dict[str, Any]:
        """Return the teacher's configuration."""
        return self.teacher.config_dict()

    def fit_normalizer(self, stats: Mapping[str, ChannelStats]) -> None:
        """Set the teacher's normaliser."""
        self.teacher.fit_normalizer(stats)

    @torch.inference_mode()
    def act(
        self, obs: Mapping[str, Tensor], *, generator: torch.Generator | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Choose the next actions; see `Policy.act`."""
        batch, obs = check_obs(obs, self.spec, self.chunk), finite_obs(obs, self.spec)
        (start,) = starting_noise(self, batch, generator, noise)
        last = torch.full((batch,), self.teacher.first_time, device=start.device)
        return executed_actions(self, self.teacher.predict_x0(start, last, self.network.encode_acting(obs, start)))


class _HasNormalizer(Protocol):
    name: str
    chunk: ChunkSpec

    @property
    def normalizer(self) -> Normalizer: ...


def executed_actions(policy: _HasNormalizer, chunk: Tensor) -> Tensor:
    """Return the executed part (B, Ta, Da) of a normalised chunk (B, Tp, Da), in env units clipped to [-1, 1].

    Raises NotFiniteError where it holds NaN or infinity.
    """
    actions = policy.normalizer.unnormalize(ACTION, chunk[:, policy.chunk.executed])
    require_finite_actions(actions, policy.name)
    return actions.clamp(-1.0, 1.0)
