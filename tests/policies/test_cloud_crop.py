"""Clouds cropped to a box before a policy reads them."""

import numpy as np
import pytest
import torch
from policy_specs import CHUNK, TINY, make_obs, make_spec

from manicm_ms.demos.stats import field_stats
from manicm_ms.errors import ConfigError
from manicm_ms.policies.checkpoint import load_checkpoint, save_checkpoint
from manicm_ms.policies.encoders.cloud_crop import CloudCrop, CropConfig
from manicm_ms.policies.methods import make_policy
from manicm_ms.spec import ACTION, AGENT_POS, POINT_CLOUD

SPEC = make_spec(points=32)
BOX = {"low": (-0.5, -1.0, 0.0), "high": (0.5, 1.0, 1.0)}


def cloud(seed=0, channels=3):
    return torch.rand(3, 2, 32, channels, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def by_hand(points):
    """Return the cloud (P, C) by a loop: the points inside, again and again."""
    kept = [p for p in points if all(BOX["low"][k] <= p[k] <= BOX["high"][k] for k in range(3))] or list(points)
    return torch.stack([kept[k % len(kept)] for k in range(len(points))])


@pytest.mark.parametrize("channels", [3, 6])
def test_the_points_inside_keep_their_order_and_fill_the_cloud(channels):
    crop, raw = CloudCrop(CropConfig(**BOX), SPEC), cloud(channels=channels)
    raw[0, 0, :, 2] = -1.0  # this frame has no point inside
    generator = torch.Generator()
    read = crop.read_training({POINT_CLOUD: raw}, generator)[POINT_CLOUD]
    assert torch.equal(read, torch.stack([torch.stack([by_hand(frame) for frame in row]) for row in raw]))
    assert torch.equal(read, crop.read_acting({POINT_CLOUD: raw}, torch.zeros(3, 4, 3))[POINT_CLOUD])
    assert not torch.equal(read, raw)


def test_without_a_limit_nothing_changes():
    raw, generator = {POINT_CLOUD: cloud()}, torch.Generator()
    assert CloudCrop(CropConfig(), SPEC).read_training(raw, generator)[POINT_CLOUD] is raw[POINT_CLOUD]
    upper = CloudCrop(CropConfig(high=(2.0, 2.0, 2.0)), SPEC)
    assert torch.equal(upper.read_training(raw, generator)[POINT_CLOUD], raw[POINT_CLOUD])


def test_a_policy_does_not_see_what_lies_outside_and_says_so_in_its_checkpoint(tmp_path):
    policy = make_policy("simple_dp3", SPEC, CHUNK, TINY | {"inputs": {"cloud_crop": BOX}}, seed=0)
    rng = np.random.default_rng(0)
    fields = {POINT_CLOUD: cloud().numpy().reshape(-1, 32, 3)} | {
        key: rng.normal(size=(6, dim)).astype(np.float32)
        for key, dim in ((AGENT_POS, SPEC.obs.agent_pos_dim), (ACTION, SPEC.action.dim))
    }
    policy.fit_normalizer({key: field_stats(values, key) for key, values in fields.items()})
    corner = torch.tensor([[BOX["low"], BOX["high"]]])
    ends = policy.normalizer.normalize(POINT_CLOUD, corner)
    assert torch.allclose(ends[0, :, [0, 2]].abs(), torch.ones(2, 2), atol=0.1), "its range is that of the box"

    obs, noise = make_obs(SPEC, 3), torch.zeros(3, CHUNK.horizon, SPEC.action.dim)
    obs[POINT_CLOUD] = cloud(1)
    moved = obs[POINT_CLOUD].clone()
    moved[..., 0] += 3.0 * (moved[..., 0] > 0.5)  # what is outside goes further away
    assert torch.equal(policy.act(obs, noise=noise), policy.act(obs | {POINT_CLOUD: moved}, noise=noise))
    save_checkpoint(policy, tmp_path / "saved", {})
    back = load_checkpoint(tmp_path / "saved")
    assert torch.equal(back.act(obs, noise=noise), policy.act(obs, noise=noise))
    assert back.config_dict()["inputs"]["cloud_crop"] == BOX


def test_an_empty_box_is_refused():
    with pytest.raises(ConfigError, match="must lie below its high"):
        CropConfig(low=(0.0, 0.0, 0.0), high=(1.0, 0.0, 1.0))


def test_a_box_beside_all_demonstrations_is_refused_rather_than_ignored():
    crop = CloudCrop(CropConfig(low=(0.0, 0.0, 2.0)), SPEC)
    with pytest.raises(ConfigError, match="their z runs from -1 to 1, the box's from 2 to inf"):
        crop.ranges({POINT_CLOUD: field_stats(np.array([[[-1.0] * 3, [1.0] * 3]], np.float32), POINT_CLOUD)})
