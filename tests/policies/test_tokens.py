import pytest
import torch
from policy_specs import CHUNK, adroit_door, make_spec, wobble
from torch.nn.functional import scaled_dot_product_attention

from manicm_ms.errors import ConfigError
from manicm_ms.policies.backbones.tokens import TokenBlock, Tokens, TokensConfig
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.policies.methods import make_policy


def tokens(times=1, width=16, blocks=2, heads=4):
    torch.manual_seed(0)
    net = Tokens(TokensConfig(width, blocks, heads), CHUNK, 3, FeatureShape(10, (2, 5)), times)
    wobble(net)
    return net


def inputs(rows=5, seed=0):
    g = torch.Generator().manual_seed(seed)
    seen = torch.randn(rows, 2, 5, generator=g)
    return torch.randn(rows, 4, 3, generator=g), torch.rand(rows, generator=g), Features(seen.flatten(1), seen)


def counted(width, blocks, times, channels=128, frames=2, horizon=4, actions=28):
    """Count the weights by hand: linear layers with biases, norms, positions."""
    linear = lambda a, b: a * b + b  # noqa: E731
    attention = linear(width, 3 * width) + linear(width, width)
    mlp = linear(width, 4 * width) + linear(4 * width, width)
    ends = linear(channels, width) + linear(actions, width) + linear(width, actions) + (frames + horizon) * width
    return blocks * (attention + mlp + 4 * width) + times * mlp + ends + 2 * width


def test_published_and_small_shapes_have_the_parameters_of_a_count_by_hand():
    published = make_policy("uca_flow", adroit_door(), seed=0).head
    small = make_policy("uca_flow", adroit_door(), size="quick", seed=0).head
    assert sum(p.numel() for p in published.parameters()) == counted(384, 8, 2)
    assert sum(p.numel() for p in small.parameters()) == counted(128, 6, 2)
    assert counted(128, 6, 2) / 1e6 == pytest.approx(1.4, abs=0.1)


@pytest.mark.parametrize("times", [0, 1, 2])
def test_shapes_for_any_number_of_times(times):
    x, t, features = inputs()
    assert tokens(times)(x, (t,) * times, features).shape == x.shape


def test_every_frame_time_and_action_matters_to_every_action():
    x, t, features = inputs()
    net, other = tokens(2), t / 2
    base = net(x, (t, other), features)
    frame = features.tokens.clone()
    frame[:, 0] += 1
    action = x.clone()
    action[:, 3] += 1
    changed = [
        net(x, (t + 0.3, other), features),
        net(x, (t, other + 0.3), features),
        net(x, (t, other), Features(features.cond, frame)),
        net(action, (t, other), features),
    ]
    for out in changed:
        assert ((out - base).abs().amax((0, 2)) > 1e-5).all()


def test_order_in_time_matters():
    x, t, features = inputs()
    net = tokens()
    turned = Features(features.cond, features.tokens.flip(1))
    assert not torch.allclose(net(x, (t,), features), net(x, (t,), turned), atol=1e-4)
    assert not torch.allclose(net(x.flip(1), (t,), features).flip(1), net(x, (t,), features), atol=1e-4)


def test_rows_do_not_meet():
    x, t, features = inputs()
    net = tokens()
    alone = net(x[2:3], (t[2:3],), features.changed(lambda part: part[2:3]))
    torch.testing.assert_close(alone, net(x, (t,), features)[2:3], atol=1e-5, rtol=1e-5)


def test_attention_is_torchs():
    torch.manual_seed(0)
    block, x = TokenBlock(16, 4), torch.randn(3, 7, 16)
    q, k, v = (part.reshape(3, 7, 4, 4).transpose(1, 2) for part in block.queries_keys_values(x).split(16, dim=-1))
    joined = scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(3, 7, 16)
    torch.testing.assert_close(block.attention(x), block.joined(joined))


def test_every_parameter_is_used():
    x, t, features = inputs()
    net = tokens(2)
    net(x, (t, t), features).square().sum().backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0] == []


def test_an_encoder_without_a_sequence_is_refused():
    with pytest.raises(ConfigError, match="reads a sequence of features"):
        Tokens(TokensConfig(16, 1, 2), CHUNK, 3, FeatureShape(10), 1)


def test_the_policy_reads_tokens():
    assert make_policy("uca_flow", make_spec(), size="smoke", seed=0).head.reads == ("tokens",)


@pytest.mark.parametrize("bad", [{"width": 2}, {"width": 15}, {"blocks": 0}, {"heads": 5}, {"heads": 0}])
def test_values_out_of_range_are_refused(bad):
    with pytest.raises(ConfigError):
        TokensConfig(**bad)
