"""Policies whose network is a number for each time: for Gaussian actions the perfect one is known in closed form."""

import torch
from reach_demos import reach_spec
from torch import nn

from manicm_ms.policies.action_policy import ActionPolicy, NormalizerConfig
from manicm_ms.policies.backbones.backbone import Backbone
from manicm_ms.policies.encoders.point_net import DP3Encoder, DP3EncoderConfig
from manicm_ms.policies.heads.diffusion import DiffusionConfig, DiffusionHead
from manicm_ms.spec import ChunkSpec

CHUNK = ChunkSpec(1, 1, 1)
SPEC = reach_spec(action_names=("a",))


class TimeTable(Backbone):
    """A network that multiplies x_t by a number looked up at t: enough for a Gaussian, whose score is linear."""

    def __init__(self, factors):
        nn.Module.__init__(self)
        self.factors = nn.Parameter(factors.float())

    def forward(self, x, times, features):
        return self.factors[times[0]][:, None, None] * x


def toy_teacher(backbone, prediction_type="sample", encoder=DP3Encoder):
    """Return a diffusion policy of this network; its normaliser is the identity."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        small = encoder(DP3EncoderConfig((8,), 4, (4,)), SPEC, CHUNK)
    head = DiffusionHead(DiffusionConfig(prediction_type=prediction_type), backbone, CHUNK, 1, small.shape)
    return ActionPolicy("toy", SPEC, CHUNK, {}, NormalizerConfig(), small, head)


def exact_factors(sigma, prediction_type="sample"):
    """Return (T,) float64: the network E[x0 | x_t] / x_t, or that of epsilon, for actions N(0, sigma^2)."""
    abar = DiffusionConfig().ddpm().alphas_cumprod.double()
    x0 = abar.sqrt() * sigma**2 / (abar * sigma**2 + 1 - abar)
    return x0 if prediction_type == "sample" else (1 - abar.sqrt() * x0) / (1 - abar).sqrt()
