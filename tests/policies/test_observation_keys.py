"""Policies of images and of voxel grids: what they ask for, what is normalised, what they refuse."""

from dataclasses import replace

import pytest
import torch
from policy_specs import CHUNK, make_spec

from manicm_ms.errors import NotFiniteError, SpecMismatchError
from manicm_ms.policies import example_observations
from manicm_ms.policies.action_policy import keys_read
from manicm_ms.policies.checkpoint import load_checkpoint, save_checkpoint
from manicm_ms.policies.methods import METHODS, make_policy, student_of
from manicm_ms.spec import EnvSpec

SMALL = {"backbone": {"down_dims": (16, 32), "n_groups": 4, "step_embed_dim": 16}}
KEYS = {"dp": ("image", "agent_pos"), "voxel_dp": ("voxel_grid", "agent_pos")}


def spec(**obs):
    plain = make_spec(agent_pos=5)
    return replace(plain, obs=replace(plain.obs, **{"image_size": (48, 52), "voxel_size": 8, **obs}))


@pytest.fixture(scope="module", params=KEYS)
def policy(request):
    return make_policy(request.param, spec(), CHUNK, SMALL, size="smoke", seed=0)


def decided(policy, obs):
    return policy.act(obs, noise=torch.randn(2, 4, 3, generator=torch.Generator().manual_seed(0)))


def test_they_ask_for_what_their_encoder_reads_and_normalise_the_state_alone(policy):
    assert policy.keys == KEYS[policy.name]
    assert policy.normalizer.fields == ("agent_pos", "action")
    assert keys_read(METHODS.get(policy.name).configuration("quick"), spec()) == policy.keys
    obs = example_observations(policy, 2)
    assert [values.dtype for values in obs.values()] == [torch.uint8, torch.float32]
    assert decided(policy, obs).shape == (2, 3, 3)


def test_a_transform_of_what_is_not_read_forces_nothing(policy):
    cloud = {"inputs": {"points": {"max_points": 8}, "cloud_frame": {"frame": "tcp"}}}
    other = make_policy(policy.name, spec(), CHUNK, {**SMALL, **cloud}, size="smoke", seed=0)
    assert other.keys == policy.keys
    assert list(other.transforms) == list(policy.transforms)


def test_training_reads_another_part_than_acting_which_reads_the_middle(policy):
    obs = example_observations(policy, 2)
    assert policy.varies(obs)
    acting = policy.encode(obs).cond
    assert torch.equal(acting, policy.encode(obs).cond)
    trained = [policy.encode_training(obs, torch.Generator().manual_seed(seed)).cond for seed in (0, 0, 1)]
    assert torch.equal(trained[0], trained[1])
    assert not torch.equal(trained[0], trained[2])


def test_a_checkpoint_decides_as_before_and_asks_for_the_same_sizes(policy, tmp_path):
    for made in (policy, student_of(policy)):
        save_checkpoint(made, tmp_path / made.name, {})
        loaded = load_checkpoint(tmp_path / made.name)
        obs = example_observations(loaded, 2)
        assert torch.equal(decided(loaded, obs), decided(made, obs))
        assert loaded.spec == made.spec
        assert loaded.keys == made.keys
    card = (tmp_path / policy.name / "MODEL_CARD.md").read_text()
    assert {"dp": "images of 48 x 52 pixels", "voxel_dp": "voxel grids of 1 x 8 x 8 x 8"}[policy.name] in card
    assert METHODS.get(policy.name).sentence in card


def test_other_types_and_sizes_are_refused_and_a_bad_state_is_named(policy):
    obs = example_observations(policy, 2)
    key = policy.keys[0]
    with pytest.raises(SpecMismatchError, match=rf"{key} is torch\.float32 and this policy reads uint8"):
        policy.act({**obs, key: obs[key] / 255})
    with pytest.raises(SpecMismatchError, match=f"{key} has shape"):
        policy.act({**obs, key: obs[key][..., :-1, :]})
    obs["agent_pos"][1, 0, 2] = torch.nan
    with pytest.raises(NotFiniteError, match="agent_pos holds 1 values"):
        policy.act(obs)


def test_the_usual_grid_leaves_no_trace_in_what_is_written_down():
    plain = make_spec()
    assert "voxel_size" not in plain.to_dict()["obs"]
    assert EnvSpec.from_dict(plain.to_dict()) == plain
    fine = spec(voxel_size=64)
    assert EnvSpec.from_dict(fine.to_dict()).obs.voxel_size == 64


def test_an_environment_is_asked_for_the_sizes_of_what_is_read_alone():
    obs = spec(voxel_size=64).obs
    assert obs.request(("point_cloud", "agent_pos")) == {"num_points": 32, "colors": False}
    assert obs.request(("image",)) == {"num_points": 32, "colors": False, "image_size": (48, 52)}
    assert obs.request(("voxel_grid",)) == {"num_points": 32, "colors": False, "voxel_size": 64}
