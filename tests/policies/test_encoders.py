import pytest
import torch
from policy_specs import make_spec, wobble

from manicm_ms.policies.encoders.encoder import FeatureShape
from manicm_ms.policies.encoders.point_net import DP3Encoder, DP3EncoderConfig, PointNet
from manicm_ms.spec import ChunkSpec


@pytest.fixture(params=[3, 6])
def encoder(request):
    encoder = PointNet(request.param)
    wobble(encoder)
    return encoder, torch.randn(5, 40, request.param, generator=torch.Generator().manual_seed(0))


def test_order_of_points_does_not_matter(encoder):
    net, cloud = encoder
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(net(cloud[:, order]), net(cloud))


def test_padding_by_repetition_does_not_matter(encoder):
    net, cloud = encoder
    padded = torch.cat([cloud, cloud[:, :1].expand(-1, 24, -1)], dim=1)
    torch.testing.assert_close(net(padded), net(cloud))


def test_every_coordinate_of_some_point_matters(encoder):
    net, cloud = encoder
    cloud.requires_grad_(True)
    net(cloud).square().sum().backward()
    assert (cloud.grad.abs().sum((0, 1)) > 0).all()


def test_maximum_equals_a_loop_over_points(encoder):
    net, cloud = encoder
    features = torch.stack([net.point_mlp(cloud[:, i]) for i in range(40)])
    torch.testing.assert_close(net(cloud), net.projection(features.max(dim=0).values))


def test_frames_are_encoded_apart_and_in_order():
    net = DP3Encoder(DP3EncoderConfig(), make_spec(agent_pos=7), ChunkSpec(3, 8, 2))
    g = torch.Generator().manual_seed(0)
    cloud, state = torch.randn(4, 3, 20, 3, generator=g), torch.randn(4, 3, 7, generator=g)
    parts = [torch.cat([net.points(cloud[:, i]), net.state(state[:, i])], -1) for i in range(3)]
    assert net.shape == FeatureShape(cond=3 * 128, tokens=(3, 128))
    cond, tokens = net({"point_cloud": cloud, "agent_pos": state})
    torch.testing.assert_close(cond, torch.cat(parts, dim=-1))
    torch.testing.assert_close(tokens, torch.stack(parts, dim=1))
