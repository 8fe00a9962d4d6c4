"""The recurrent head of behaviour cloning (robomimic's BC-RNN; Mandlekar et al. 2021)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.backbones.backbone import Backbone
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.policies.heads.head import HEADS, State, TrainableHead
from manicm_ms.spec import ChunkSpec


@dataclass(frozen=True)
class RNNConfig:
    """Shape of the LSTM.

    Attributes:
        width: of the hidden state.
        layers: of the LSTM.
    """

    width: int = 400
    layers: int = 2

    def __post_init__(self) -> None:
        require_at_least(1, width=self.width, layers=self.layers)


@HEADS.register("rnn")
class RNNHead(TrainableHead):
    """An LSTM over the frames, an action for each; trained on the actions of all frames of a window.

    The window of To frames is read anew at each decision, so that it needs no state: robomimic's keeps a hidden state
    and resets it every To steps.

    Args:
        config: shape.
        backbone: None.
        chunk: To, Tp = To, Ta = 1.
        action_dim: Da.
        features: sizes of the observation's features, a token a frame.

    Raises:
        ConfigError: horizon is not n_obs_steps, or the encoder has no token for each frame.
    """

    Config = RNNConfig
    sizes: ClassVar = {"quick": {"width": 128}, "smoke": {"width": 32, "layers": 1}}
    config: RNNConfig
    reads = ("tokens",)

    def __init__(
        self, config: RNNConfig, backbone: Backbone | None, chunk: ChunkSpec, action_dim: int, features: FeatureShape
    ) -> None:
        super().__init__(config, backbone, chunk, action_dim, features)
        if chunk.horizon != chunk.n_obs_steps:
            raise ConfigError(
                f"the head rnn predicts an action for each frame that it reads: make horizon={chunk.horizon} and "
                f"n_obs_steps={chunk.n_obs_steps} equal"
            )
        if features.tokens is None or features.tokens[0] != chunk.n_obs_steps:
            raise ConfigError("the head rnn reads a token for each frame, which this encoder does not give")
        self.lstm = nn.LSTM(features.tokens[1], config.width, config.layers, batch_first=True)
        self.output = nn.Linear(config.width, action_dim)

    @property
    def nfe(self) -> int:
        """One."""
        return 1

    @property
    def noise_draws(self) -> int:
        """None: it is deterministic."""
        return 0

    def predict(self, features: Features) -> Tensor:
        """Return an action for each frame, (B, To, Da) in [-1, 1]."""
        assert features.tokens is not None
        return self.output(self.lstm(features.tokens)[0]).float().tanh()

    def loss(self, features: Features, action: Tensor, generator: torch.Generator) -> Tensor:
        """Return the mean squared error over the actions of all frames; see `TrainableHead.loss`."""
        del generator
        return mse_loss(self.predict(features), action)

    def act(self, features: Features, noise: tuple[Tensor, ...], state: State | None) -> tuple[Tensor, State | None]:
        """Return the actions of the frames, the last of which is executed; see `ActionHead.act`."""
        del noise, state
        return self.predict(features), None
