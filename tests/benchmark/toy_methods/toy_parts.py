"""A method of toy parts: an encoder, a backbone without times, a head that maps noise to a chunk in one evaluation."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import nn
from torch.nn.functional import mse_loss

from manicm_ms.policies.backbones.backbone import BACKBONES, Backbone
from manicm_ms.policies.encoders.encoder import ENCODERS, Features, FeatureShape, ObsEncoder
from manicm_ms.policies.heads.head import HEADS, TrainableHead
from manicm_ms.policies.methods import METHODS, Method
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, ChunkSpec


@dataclass(frozen=True)
class ToyConfig:
    """Width of a part.

    Attributes:
        width: of its layer.
    """

    width: int = 24


@ENCODERS.register("toy_mean")
class MeanEncoder(ObsEncoder):
    """A linear map of the mean point and the state of all frames."""

    Config = ToyConfig
    keys = (POINT_CLOUD, AGENT_POS)

    def __init__(self, config, spec, chunk):
        super().__init__(config, spec, chunk)
        inputs = chunk.n_obs_steps * (spec.obs.point_channels + spec.obs.agent_pos_dim)
        self.layer, self.shape = nn.Linear(inputs, config.width), FeatureShape(config.width)

    def forward(self, obs):
        seen = torch.cat([obs[POINT_CLOUD].mean(2), obs[AGENT_POS]], dim=-1)
        return Features(self.layer(seen.flatten(1)))


@BACKBONES.register("toy_linear")
class LinearBackbone(Backbone):
    """A linear map of chunk and features."""

    Config = ToyConfig
    sizes: ClassVar = {"smoke": {"width": 8}}

    def __init__(self, config, chunk, action_dim, features, times=1):
        super().__init__(config, chunk, action_dim, features, times)
        outputs = chunk.horizon * action_dim
        self.layers = nn.Sequential(
            nn.Linear(outputs + features.cond, config.width), nn.Tanh(), nn.Linear(config.width, outputs)
        )

    def forward(self, x, times, features):
        assert times == ()
        return self.layers(torch.cat([x.flatten(1), features.cond], dim=-1)).reshape(x.shape)


@HEADS.register("toy_once")
class OnceHead(TrainableHead):
    """The backbone's answer to noise."""

    Config = ToyConfig
    needs_backbone = True
    times = 0
    nfe = 1

    def loss(self, features, action, generator):
        noise = torch.randn(action.shape, generator=generator, device=action.device)
        return mse_loss(self.backbone(noise, (), features).float(), action)

    def act(self, features, noise, state):
        return self.backbone(noise[0], (), features).float(), state


METHODS.add(
    "toy_once",
    Method(
        sentence="A toy.",
        reference="nowhere",
        encoder="toy_mean",
        backbone="toy_linear",
        head="toy_once",
        objective="averaged",
        nfe=1,
        chunk=ChunkSpec(2, 4, 3),
        inputs={"points": {}},
    ),
)
METHODS.add(
    "toy_nowhere",
    Method(
        sentence="A row that names a head which does not exist.",
        reference="nowhere",
        encoder="toy_mean",
        head="toy_twice",
        objective="plain",
        nfe=1,
        chunk=ChunkSpec(2, 4, 3),
    ),
)
