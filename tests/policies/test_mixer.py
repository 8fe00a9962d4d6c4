import pytest
import torch
from policy_specs import CHUNK, adroit_door, make_spec

from manicm_ms.errors import ConfigError
from manicm_ms.policies.backbones.mixer import Mixer, MixerBlock, MixerConfig
from manicm_ms.policies.encoders.encoder import Features, FeatureShape
from manicm_ms.policies.methods import METHODS, make_policy, student_of
from manicm_ms.spec import ChunkSpec


def mixer(times=1, width=16, blocks=2, chunk=CHUNK):
    torch.manual_seed(0)
    return Mixer(MixerConfig(width, blocks), chunk, 3, FeatureShape(10), times)


def inputs(rows=5, seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.randn(rows, 4, 3, generator=g), torch.arange(rows), Features(torch.randn(rows, 10, generator=g))


def test_the_row_has_the_published_size():
    made = make_policy("pocket_dp3", adroit_door(), seed=0)
    weights = sum(p.numel() for p in made.head.parameters())
    assert 2.4e6 < weights < 2.6e6, "the paper: 2.52 M"
    assert (made.nfe, METHODS.get("pocket_dp3").nfe) == (2, 2)


def test_shapes_for_any_number_of_times():
    x, t, features = inputs()
    for times in (0, 1, 2):
        assert mixer(times)(x, (t,) * times, features).shape == x.shape


def test_a_horizon_that_a_u_net_cannot_halve():
    assert mixer(chunk=ChunkSpec(2, 5, 3))(torch.zeros(1, 5, 3), (torch.zeros(1),), Features(torch.zeros(1, 10))).shape


def test_time_features_and_every_action_matter_to_every_action():
    x, t, features = inputs()
    net = mixer()
    out = net(x, (t,), features)
    assert not torch.allclose(out, net(x, (t + 7,), features))
    assert not torch.allclose(out, net(x, (t,), Features(features.cond + 1)))
    moved = x.clone()
    moved[:, 3] += 1
    assert ((net(moved, (t,), features) - out).abs().amax((0, 2)) > 1e-5).all()


def test_rows_do_not_meet():
    x, t, features = inputs()
    net = mixer()
    alone = net(x[2:3], (t[2:3],), Features(features.cond[2:3]))
    torch.testing.assert_close(alone, net(x, (t,), features)[2:3], atol=1e-5, rtol=1e-5)


def test_a_block_is_the_formula_written_out():
    torch.manual_seed(0)
    block, x, cond = MixerBlock(16, 4), torch.randn(2, 4, 16), torch.randn(2, 16)
    y = x + torch.stack([block.over_time(block.before_time(x)[:, :, c]) for c in range(16)], dim=-1)
    y = y + block.over_channels(block.before_channels(y))
    gamma, scale, shift = (v[:, None] for v in block.modulation(cond).split(16, dim=-1))
    torch.testing.assert_close(block(x, cond), y + gamma * (y * (1 + scale) + shift))


def test_it_can_be_distilled():
    made = make_policy("pocket_dp3", make_spec(), config={"backbone": {"width": 16, "blocks": 1}}, seed=0)
    student = student_of(made)
    assert isinstance(student.head.backbone, Mixer)
    assert student.nfe == 1


@pytest.mark.parametrize("bad", [{"width": 2}, {"blocks": 0}])
def test_values_out_of_range_are_refused(bad):
    with pytest.raises(ConfigError):
        MixerConfig(**bad)
