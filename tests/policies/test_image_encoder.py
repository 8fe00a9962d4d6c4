"""The image encoder: the published number of weights, torchvision's ResNet-18, a soft-max written out."""

import math
from dataclasses import replace

import pytest
import torch
from policy_specs import make_spec, wobble
from torch import nn
from torchvision_oracle import functional, resnet18

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.image import ImageEncoder, ImageEncoderConfig, ResNet18, SpatialSoftmax
from manicm_ms.spec import ChunkSpec

CHUNK = ChunkSpec(2, 4, 3)


def count(module):
    return sum(p.numel() for p in module.parameters())


def test_it_has_the_weights_of_diffusion_policys_hybrid_encoder():
    encoder = ImageEncoder(ImageEncoderConfig(), make_spec(agent_pos=9), CHUNK)
    trunk, maps, output = 11_176_512, 512 * 32 + 32, 64 * 64 + 64
    assert count(encoder.trunk) == trunk
    assert count(encoder) == trunk + maps + output  # 11.2 million
    assert encoder.shape.cond == 2 * (64 + 9)


def test_the_trunk_is_torchvisions_resnet18_with_groupnorm():
    theirs = resnet18(norm_layer=lambda channels: nn.GroupNorm(channels // 16, channels))
    theirs.avgpool, theirs.fc = nn.Identity(), nn.Identity()
    wobble(theirs)
    ours = ResNet18()
    weights = [value for name, value in theirs.state_dict().items()]
    names = list(ours.state_dict())
    assert [w.shape for w in weights] == [w.shape for w in ours.state_dict().values()]
    ours.load_state_dict(dict(zip(names, weights, strict=True)))
    image = torch.randn(2, 3, 76, 76, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.testing.assert_close(ours(image).flatten(1), theirs(image))
    assert ours(image).shape == (2, 512, 3, 3)


def test_bytes_are_mapped_to_minus_one_and_one_as_by_torchvision():
    encoder, seen = ImageEncoder(ImageEncoderConfig(16, 4, 8), make_spec(agent_pos=5), CHUNK), []
    encoder.trunk.register_forward_pre_hook(lambda module, given: seen.append(given[0]))
    image = torch.randint(256, (3, 2, 20, 24, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    state = torch.randn(3, 2, 5)
    features = encoder({"image": image, "agent_pos": state})
    pixels = functional.to_dtype(image.flatten(0, 1).movedim(-1, 1), torch.float32, scale=True)
    torch.testing.assert_close(seen[0], functional.normalize(pixels, [0.5] * 3, [0.5] * 3))
    assert torch.equal(features.tokens[..., 8:], state)  # no layer changes proprioception
    torch.testing.assert_close(features.cond, features.tokens.flatten(1))


def test_the_spatial_softmax_equals_its_sums_written_out():
    net = SpatialSoftmax(6, 2)
    x = torch.randn(1, 6, 3, 4, generator=torch.Generator().manual_seed(0))
    maps = net.maps(x)[0].tolist()
    for point, place in zip(maps, net(x)[0].tolist(), strict=True):
        weights = {(i, j): math.exp(point[i][j]) for i in range(3) for j in range(4)}
        total = sum(weights.values())
        expected = [sum(w * (2 * j / 3 - 1) for (_, j), w in weights.items()) / total,
                    sum(w * (i - 1) for (i, _), w in weights.items()) / total]  # fmt: skip
        assert place == pytest.approx(expected, abs=1e-5)


def test_unfit_sizes_are_refused():
    small = replace(make_spec(), obs=replace(make_spec().obs, image_size=(84, 40)))
    with pytest.raises(ConfigError, match="images of 84 x 40 pixels leave the spatial soft-max a single place"):
        ImageEncoder(ImageEncoderConfig(), small, CHUNK)
    with pytest.raises(ConfigError, match="multiple of 16, got 24"):
        ImageEncoderConfig(width=24)
