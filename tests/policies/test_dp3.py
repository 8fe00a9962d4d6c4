import pytest
import torch
from policy_specs import CHUNK, TINY, adroit_door, make_obs, make_spec

from manicm_ms.errors import ConfigError, SpecMismatchError, UnknownNameError
from manicm_ms.policies.methods import make_policy, methods_of


def count(module):
    return sum(p.numel() for p in module.parameters())


# Counted in the public DP3 code at Adroit door's shapes; its total includes 330 numbers of the normaliser.
@pytest.mark.parametrize(
    ("name", "total", "unet"), [("dp3", 255_225_638, 255_160_476), ("simple_dp3", 7_461_926, 7_396_764)]
)
def test_parameter_counts_are_the_public_codes(name, total, unet):
    with torch.device("meta"):  # no memory is touched: a billion bytes for dp3 otherwise
        policy = make_policy(name, adroit_door(), CHUNK)
    assert count(policy.head.backbone) == unet
    assert count(policy.encoder) == 64_832
    assert count(policy) == pytest.approx(total, rel=1e-3)


@pytest.mark.parametrize("name", ["dp3", "simple_dp3"])
def test_both_teachers_are_registered_and_rebuilt_from_their_configuration(name):
    assert name in methods_of("teacher")
    policy = make_policy(name, make_spec(), CHUNK, TINY, seed=0)
    again = make_policy(name, make_spec(), CHUNK, policy.config_dict(), seed=0)
    assert policy.config_dict() == again.config_dict()
    obs, noise = make_obs(make_spec(), 3), torch.randn(3, 4, 3)
    torch.testing.assert_close(policy.act(obs, noise=noise), again.act(obs, noise=noise), rtol=0, atol=0)


def test_the_seed_decides_the_weights_and_leaves_the_default_generator_alone():
    torch.manual_seed(5)
    before = torch.get_rng_state()
    a, b, c = (make_policy("simple_dp3", make_spec(), CHUNK, TINY, seed=s) for s in (0, 0, 1))
    assert torch.equal(torch.get_rng_state(), before)
    pairs = zip(a.parameters(), b.parameters(), strict=True)
    assert all(torch.equal(x, y) for x, y in pairs)
    assert any(not torch.equal(x, y) for x, y in zip(a.parameters(), c.parameters(), strict=True))


@pytest.mark.parametrize(
    ("config", "error", "message"),
    [
        ({"backbone": {"width": 3}}, UnknownNameError, "unknown configuration key 'backbone.width'"),
        ({"unet": {}}, UnknownNameError, "unknown configuration key 'unet'"),
        ({"backbone": {"down_dims": (100,)}}, ConfigError, "must divide every width"),
        ({"backbone": {"kernel_size": 4}}, ConfigError, "odd"),
        ({"backbone": {"down_dims": (16, 16, 16, 16)}}, ConfigError, "no multiple of 8"),
        ({"head": {"num_inference_steps": 101}}, ConfigError, "between 1 and"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused(config, error, message):
    with pytest.raises(error, match=message):
        make_policy("simple_dp3", make_spec(), CHUNK, config)


def test_a_wrong_name_is_answered_with_the_nearest():
    with pytest.raises(UnknownNameError, match="did you mean 'simple_dp3'"):
        make_policy("simpel_dp3", make_spec(), CHUNK)
    with pytest.raises(UnknownNameError, match="did you mean 'epsilon'"):
        make_policy("dp3", make_spec(), CHUNK, {"head": {"prediction_type": "epsilom"}})


@pytest.mark.parametrize("key", ["point_cloud", "agent_pos"])
def test_observations_of_another_shape_are_refused(key):
    policy, obs = make_policy("simple_dp3", make_spec(), CHUNK, TINY), make_obs(make_spec(), 2)
    with pytest.raises(SpecMismatchError, match=key):
        policy.act({**obs, key: obs[key][:, :1]})
    with pytest.raises(SpecMismatchError, match=key):
        policy.act({**obs, key: obs[key][..., :2]})
    del obs[key]
    with pytest.raises(SpecMismatchError, match=key):
        policy.act(obs)
