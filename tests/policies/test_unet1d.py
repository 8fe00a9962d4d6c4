import pytest
import torch
from policy_specs import wobble

from manicm_ms.errors import ConfigError
from manicm_ms.policies.backbones.unet1d import FiLMBlock, SinusoidalEmbedding, UNet1D, UNet1DConfig
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.spec import ChunkSpec


def small(horizon=8, times=1, **changes):
    config = UNet1DConfig(**{"down_dims": (16, 24, 32), "step_embed_dim": 8} | changes)
    net = UNet1D(config, ChunkSpec(2, horizon, 3), 3, FeatureShape(6), times)
    wobble(net)
    return net


def inputs(horizon=8, batch=4):
    g = torch.Generator().manual_seed(0)
    x, cond = torch.randn(batch, horizon, 3, generator=g), torch.randn(batch, 6, generator=g)
    return x, (torch.randint(100, (batch,), generator=g),), Features(cond)


@pytest.mark.parametrize(("resnets", "mid"), [(1, 1), (2, 2)])
@pytest.mark.parametrize("horizon", [4, 8, 16])
def test_output_has_the_shape_of_the_chunk(resnets, mid, horizon):
    x, t, features = inputs(horizon)
    net = small(horizon, resnets_per_stage=resnets, mid_blocks=mid)
    assert net(x, t, features).shape == x.shape


def test_time_condition_and_actions_all_matter():
    net, (x, t, features) = small(), inputs()
    base = net(x, t, features)
    others = (x + 1, t, features), (x, (t[0] + 5,), features), (x, t, Features(features.cond + 1))
    for changed in (net(*other) for other in others):
        assert (changed - base).abs().amax((1, 2)).min() > 1e-5


def test_rows_do_not_see_each_other():
    net, (x, t, features) = small(), inputs()
    torch.testing.assert_close(net(x, t, features)[2:3], net(x[2:3], (t[0][2:3],), Features(features.cond[2:3])))


def test_every_parameter_is_used():
    net, (x, t, features) = small(resnets_per_stage=2, mid_blocks=2), inputs()
    net(x, t, features).square().sum().backward()
    idle = [name for name, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert idle == []


def test_film_scales_and_shifts_each_channel():
    block = FiLMBlock(4, 8, cond_dim=5, kernel_size=3, n_groups=2)
    linear = block.modulation[1]
    with torch.no_grad():  # the condition is ignored: scale i, bias 10 i for channel i
        linear.weight.zero_()
        linear.bias.copy_(torch.cat([torch.arange(8.0), 10 * torch.arange(8.0)]))
    x, channel = torch.randn(2, 4, 6), torch.arange(8.0)[None, :, None]
    expected = block.second(block.first(x) * channel + 10 * channel) + block.skip(x)
    torch.testing.assert_close(block(x, torch.randn(2, 5)), expected)


def test_embedding_is_sines_and_cosines_from_one_to_a_ten_thousandth():
    y = SinusoidalEmbedding(8)(torch.tensor([3, 50]))
    rates = torch.tensor([1.0, 10_000 ** (-1 / 3), 10_000 ** (-2 / 3), 1e-4])
    t = torch.tensor([[3.0], [50.0]])
    torch.testing.assert_close(y, torch.cat([torch.sin(t * rates), torch.cos(t * rates)], -1), rtol=1e-5, atol=1e-5)


def test_a_horizon_that_cannot_be_halved_is_refused():
    with pytest.raises(ConfigError, match="horizon 6 is no multiple of 4"):
        small(horizon=6)


def test_two_times_condition_it_together_and_none_leaves_the_features_alone():
    (x, (t,), features), other = inputs(), torch.tensor([3, 50, 7, 90])
    two, none = small(times=2), small(times=0)
    base = two(x, (t, other), features)
    for times in ((t + 5, other), (t, other + 5)):
        assert (two(x, times, features) - base).abs().amax((1, 2)).min() > 1e-5
    assert none(x, (), features).shape == x.shape
    assert none.time_embeddings.state_dict() == {}
    with pytest.raises(ValueError, match="zip"):
        two(x, (t,), features)
