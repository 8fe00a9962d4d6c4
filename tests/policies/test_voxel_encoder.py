"""The voxel encoder: the published numbers of weights, and at 58^3 the published layers one after another."""

import pytest
import torch
from policy_specs import make_spec, wobble
from torch import nn

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.encoder import FeatureShape
from manicm_ms.policies.encoders.voxel import VoxelEncoder, VoxelEncoderConfig, VoxelNet
from manicm_ms.spec import ChunkSpec


def test_it_has_the_published_numbers_of_weights():
    for channels, expected in ((4, 440_136), (1, 439_488)):
        assert sum(p.numel() for p in VoxelNet(channels, 128).parameters()) == expected


def test_at_the_published_size_it_is_the_published_sequence():
    net = VoxelNet(4, 16)
    wobble(net)
    layers = []
    for number, convolution in enumerate(net.convolutions):
        plain = nn.Conv3d(convolution.in_channels, convolution.out_channels, 3, padding=int(number not in (0, 3, 7)))
        plain.load_state_dict(convolution.state_dict())
        layers += [plain, nn.ReLU(), *([nn.MaxPool3d(2)] if number in (0, 2, 4, 6) else [])]
    grid = torch.rand(1, 4, 58, 58, 58, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.testing.assert_close(net(grid), nn.Sequential(*layers)(grid).flatten(1))


@pytest.mark.parametrize("side", [6, 14, 29, 40])
def test_grids_of_other_sizes_become_as_many_features(side):
    net = VoxelNet(1, 64)
    wobble(net)
    grid = torch.rand(4, 1, side, side, side, generator=torch.Generator().manual_seed(0)).requires_grad_()
    features = net(grid)
    assert features.shape == (4, 64)
    features.square().sum().backward()
    seen = (grid.grad != 0).any(dim=1).any(dim=0)
    faces = [seen.select(axis, place) for axis in range(3) for place in (0, side - 1)]
    assert all(face.any() for face in faces)  # no part of the grid is left out


@pytest.mark.parametrize("channels", [3, 6])
def test_frames_are_encoded_apart_and_in_order(channels):
    spec = make_spec(agent_pos=7, point_channels=channels)
    net = VoxelEncoder(VoxelEncoderConfig(features=16), spec, ChunkSpec(3, 8, 2))
    g = torch.Generator().manual_seed(0)
    shape = spec.observation("voxel_grid").shape
    assert shape[0] == (1 if channels == 3 else 4)
    grid = torch.randint(256, (2, 3, shape[0], 12, 12, 12), generator=g, dtype=torch.uint8)
    state = torch.randn(2, 3, 7, generator=g)
    parts = [torch.cat([net.grids(grid[:, i] / 255), net.state(state[:, i])], -1) for i in range(3)]
    assert net.shape == FeatureShape(cond=3 * 80, tokens=(3, 80))
    cond, tokens = net({"voxel_grid": grid, "agent_pos": state})
    torch.testing.assert_close(cond, torch.cat(parts, dim=-1))
    torch.testing.assert_close(tokens, torch.stack(parts, dim=1))


def test_unfit_sizes_are_refused():
    with pytest.raises(ConfigError, match="multiple of 16, got 40"):
        VoxelEncoderConfig(features=40)
