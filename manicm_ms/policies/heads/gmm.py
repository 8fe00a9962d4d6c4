"""The mixture-of-Gaussians head of behaviour cloning (robomimic's BC-GMM; Mandlekar et al. 2021)."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal
from torch.nn.functional import softplus

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.backbones.backbone import Backbone
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.policies.heads.head import HEADS, State, TrainableHead
from manicm_ms.spec import ChunkSpec


@dataclass(frozen=True)
class GMMConfig:
    """Shape of the mixture.

    Attributes:
        widths: of the hidden layers.
        modes: Gaussians of the mixture.
        min_std: least standard deviation, of normalised actions, in training.
        acting_std: standard deviation when acting: a sample is almost one mode's mean (robomimic's `low_noise_eval`).
    """

    widths: tuple[int, ...] = (1024, 1024)
    modes: int = 5
    min_std: float = 1e-4
    acting_std: float = 1e-4

    def __post_init__(self) -> None:
        require_at_least(1, modes=self.modes, widths=min(self.widths, default=0))
        if not (self.min_std > 0 and self.acting_std >= 0):
            raise ConfigError(
                f"min_std must be above 0 and acting_std not below, got {self.min_std}, {self.acting_std}"
            )


@HEADS.register("gmm")
class GMMHead(TrainableHead):
    """A mixture of diagonal Gaussians over the chunk, all its actions together; means pass through tanh.

    Args:
        config: shape.
        backbone: None.
        chunk: To, Tp, Ta.
        action_dim: Da.
        features: sizes of the observation's features.
    """

    Config = GMMConfig
    sizes: ClassVar = {"quick": {"widths": (256, 256)}, "smoke": {"widths": (64,)}}
    config: GMMConfig

    def __init__(
        self, config: GMMConfig, backbone: Backbone | None, chunk: ChunkSpec, action_dim: int, features: FeatureShape
    ) -> None:
        super().__init__(config, backbone, chunk, action_dim, features)
        self.form = (chunk.horizon, action_dim)
        self.outputs = chunk.horizon * action_dim
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise((features.cond, *config.widths)):
            layers += [nn.Linear(fan_in, fan_out), nn.ReLU()]
        self.trunk = nn.Sequential(*layers)
        self.output = nn.Linear(config.widths[-1], config.modes * (2 * self.outputs + 1))

    @property
    def nfe(self) -> int:
        """One."""
        return 1

    @property
    def noise_draws(self) -> int:
        """One array for the Gaussian, one from which the mode is drawn."""
        return 2

    def parameters_of(self, features: Features) -> tuple[Tensor, Tensor, Tensor]:
        """Return logits (B, M) of the modes, means and standard deviations (B, M, Tp Da), normalised."""
        raw = self.output(self.trunk(features.cond)).float()
        sizes = [self.config.modes, self.config.modes * self.outputs, self.config.modes * self.outputs]
        logits, means, stds = raw.split(sizes, dim=-1)
        form = (len(raw), self.config.modes, self.outputs)
        return logits, means.reshape(form).tanh(), softplus(stds.reshape(form)) + self.config.min_std

    def loss(self, features: Features, action: Tensor, generator: torch.Generator) -> Tensor:
        """Return the negative mean log-likelihood of the demonstrated chunks; see `TrainableHead.loss`."""
        del generator
        logits, means, stds = self.parameters_of(features)
        # Unchecked: a check would wait for an accelerator at each step, and the loop names a loss that is not finite.
        modes = Independent(Normal(means, stds, validate_args=False), 1, validate_args=False)
        weights = Categorical(logits=logits, validate_args=False)
        mixture = MixtureSameFamily(weights, modes, validate_args=False)
        return -mixture.log_prob(action.flatten(1)).mean()

    def act(self, features: Features, noise: tuple[Tensor, ...], state: State | None) -> tuple[Tensor, State | None]:
        """Draw a mode by its weight and return a sample of it; see `ActionHead.act`.

        The mode is that in which a uniform number falls: the distribution function of a Gaussian of the second array.
        """
        del state
        logits, means, _ = self.parameters_of(features)
        uniform = torch.special.ndtr(noise[1].flatten(1)[:, :1])  # (B, 1)
        mode = (logits.softmax(-1).cumsum(-1) < uniform).sum(-1).clamp_max(self.config.modes - 1)  # (B,)
        mean = means[torch.arange(len(mode), device=mode.device), mode]  # (B, Tp Da)
        return (mean + self.config.acting_std * noise[0].flatten(1)).unflatten(1, self.form), None
