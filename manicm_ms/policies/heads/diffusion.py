"""The diffusion head: clean action and noise as separate quantities, DDIM sampling, the one-step control."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from torch import Tensor
from torch.nn.functional import mse_loss

from manicm_ms.errors import ConfigError
from manicm_ms.policies.backbones.backbone import Backbone
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.policies.heads.head import HEADS, State, TrainableHead
from manicm_ms.registry import Registry
from manicm_ms.spec import ChunkSpec


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
        if not self.clip_range > 0:
            raise ConfigError(f"clip_range must be above 0, got {self.clip_range}")
        if not 1 <= self.num_inference_steps <= self.num_train_timesteps:
            raise ConfigError(
                f"num_inference_steps={self.num_inference_steps} must lie between 1 and "
                f"num_train_timesteps={self.num_train_timesteps}"
            )
        try:
            self.ddpm()
        except NotImplementedError as error:
            raise ConfigError(
                f"diffusers has no beta_schedule {self.beta_schedule!r}: try squaredcos_cap_v2"
            ) from error

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


@HEADS.register("diffusion")
class DiffusionHead(TrainableHead):
    """Samples a chunk by DDIM from a network conditioned on the observation (DP3, Ze et al. 2024).

    Args:
        config: noising process and sampler.
        backbone: predicts the clean chunk, or its noise, from a noisy one and its time.
        chunk: To, Tp, Ta.
        action_dim: Da.
        features: sizes of the observation's features.

    Attributes:
        alphas_cumprod: (T,) alpha_bar at each time.
    """

    Config = DiffusionConfig
    needs_backbone = True
    role: ClassVar[str | None] = "teacher"
    nfe_field: ClassVar[str | None] = "num_inference_steps"
    alphas_cumprod: Tensor
    config: DiffusionConfig
    backbone: Backbone

    def __init__(
        self, config: DiffusionConfig, backbone: Backbone, chunk: ChunkSpec, action_dim: int, features: FeatureShape
    ) -> None:
        super().__init__(config, backbone, chunk, action_dim, features)
        self.prediction: Prediction = PREDICTIONS.get(config.prediction_type)()
        self.register_buffer("alphas_cumprod", config.ddpm().alphas_cumprod.clone(), persistent=False)
        self._samplers: dict[int, DDIMScheduler] = {}

    @property
    def nfe(self) -> int:
        """Number of DDIM steps."""
        return self.config.num_inference_steps

    def add_noise(self, x0: Tensor, epsilon: Tensor, t: Tensor) -> Tensor:
        """Return x_t = sqrt(abar_t) x0 + sqrt(1 - abar_t) epsilon, all (B, Tp, Da), for integer times t (B,)."""
        alpha_bar = self.alphas_cumprod[t][:, None, None]
        return alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * epsilon

    def loss(self, features: Features, action: Tensor, generator: torch.Generator) -> Tensor:
        """Return E |output(x_t, t, obs) - target|^2 over t, noise and rows (Ho et al. 2020, equation 14).

        The target is x0 or epsilon, as `prediction_type` has it. Arguments as for `TrainableHead.loss`.
        """
        epsilon = torch.randn(action.shape, generator=generator, device=action.device)
        last = self.config.num_train_timesteps
        t = torch.randint(last, (len(action),), generator=generator, device=action.device)
        output = self.denoise(self.add_noise(action, epsilon, t), t, features)
        return mse_loss(output, self.prediction.target(action, epsilon))

    def denoise(self, x_t: Tensor, t: Tensor, features: Features) -> Tensor:
        """Return the network's output (B, Tp, Da), float32, for x_t (B, Tp, Da) normalised and times t (B,)."""
        return self.backbone(x_t, (t,), features).float()

    def predict_x0(self, x_t: Tensor, t: Tensor, features: Features) -> Tensor:
        """Return the clean chunk that the network sees in a noisy one, clipped as in sampling.

        Args:
            x_t: (B, Tp, Da) normalised noisy actions.
            t: (B,) int64 times.
            features: of the observations.

        Returns:
            (B, Tp, Da) normalised, within the clipping range.
        """
        return self.guess(x_t, t, features).x0

    def guess(self, x_t: Tensor, t: Tensor, features: Features) -> Guess:
        """Return the clean chunk and the noise with which `sample` takes its step; arguments as for `predict_x0`."""
        x0, epsilon = self.raw_guess(x_t, t, features)
        return Guess(x0.clamp(-self.config.clip_range, self.config.clip_range), epsilon)

    def raw_guess(self, x_t: Tensor, t: Tensor, features: Features) -> Guess:
        """Return what the output implies before clipping; arguments as for `predict_x0`."""
        output = self.denoise(x_t, t, features)
        alpha_bar = self.alphas_cumprod[t][:, None, None]
        return Guess(self.prediction.x0(output, x_t, alpha_bar), self.prediction.epsilon(output, x_t, alpha_bar))

    @property
    def first_time(self) -> int:
        """Time at which a single evaluation reads pure noise; see `Prediction.timestep_spacing`."""
        if self.prediction.timestep_spacing == "trailing":
            return self.config.num_train_timesteps - 1
        return int(self._sampler(self.config.num_inference_steps).timesteps[0])

    def sample(self, features: Features, noise: Tensor) -> Tensor:
        """Return a normalised chunk (B, Tp, Da) denoised from `noise` (B, Tp, Da) by DDIM without added noise."""
        sampler = self._sampler(self.config.num_inference_steps)
        x_t = noise
        for t in sampler.timesteps.tolist():
            output = self.denoise(x_t, torch.full((len(x_t),), t, device=x_t.device), features)
            x_t = sampler.step(output, t, x_t, return_dict=False)[0]
        return x_t

    def act(self, features: Features, noise: tuple[Tensor, ...], state: State | None) -> tuple[Tensor, State | None]:
        """Choose chunks by `sample`; see `ActionHead.act`."""
        del state
        return self.sample(features, noise[0]), None

    def one_step(self) -> OneStepHead:
        """Return the control of a distillation; see `OneStepHead`."""
        return self._of_same_network(OneStepHead, self.config)

    def _sampler(self, steps: int) -> DDIMScheduler:
        if steps not in self._samplers:
            self._samplers[steps] = self.config.ddim(steps)
        return self._samplers[steps]


class OneStepHead(DiffusionHead):
    """The control for distillation: the undistilled teacher's own guess at x0 from pure noise, in one evaluation.

    It is run at `first_time` only, and is not saved: its weights are the teacher's.
    """

    role = None
    nfe_field = None

    @property
    def nfe(self) -> int:
        """One."""
        return 1

    def sample(self, features: Features, noise: Tensor) -> Tensor:
        """Return the guess (B, Tp, Da) at the clean chunk."""
        return self.predict_x0(noise, torch.full((len(noise),), self.first_time, device=noise.device), features)
