import pytest
import torch
from policy_specs import CHUNK, TINY, make_obs, make_spec

from manicm_ms.demos.stats import FieldStats
from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.policies.configuration import merged
from manicm_ms.policies.encoders.encoder import ENCODERS, Features, FeatureShape, ObsEncoder
from manicm_ms.policies.encoders.point_net import DP3EncoderConfig
from manicm_ms.policies.methods import make_policy


def stats(spec, seed=0):
    g = torch.Generator().manual_seed(seed)

    def of(channels):
        low = torch.randn(channels, generator=g)
        high = low + 0.5 + torch.rand(channels, generator=g)
        return FieldStats(*(v.numpy() for v in (low, high, (low + high) / 2, (high - low) / 4)))

    sizes = {"point_cloud": spec.obs.point_channels, "agent_pos": spec.obs.agent_pos_dim, "action": spec.action.dim}
    return {name: of(channels) for name, channels in sizes.items()}


def made(spec, points=None, cloud_frame=None, **sections):
    inputs = {"points": points or {}, "cloud_frame": cloud_frame or {}}
    config = merged(TINY, {"inputs": inputs, **sections})
    return make_policy("simple_dp3", spec, CHUNK, config, stats=stats(spec), seed=0)


def moved(obs, spec, by):
    """Return the same scene with hand and cloud both moved by `by` (3,) metres."""
    obs = {k: v.clone() for k, v in obs.items()}
    obs["point_cloud"][..., :3] += by
    obs["agent_pos"][..., list(spec.tcp_indices)] += by
    return obs


def seen_cloud(policy, obs):
    """Return the cloud (B, To, P, C) as the encoder gets it."""
    normalized = {key: policy.normalizer.normalize(key, obs[key]) for key in policy.keys}
    return policy.transforms["cloud_frame"].normalized(normalized, obs)["point_cloud"]


def cloud_features(policy, obs):
    return policy.encoder.points(seen_cloud(policy, obs).flatten(0, 1))


def test_tcp_frame_subtracts_the_hand_of_the_same_frame_and_scales():
    spec = make_spec()
    obs = make_obs(spec, 2)
    seen = seen_cloud(made(spec, cloud_frame={"frame": "tcp", "scale": 0.15}), obs)
    for b in range(2):
        for t in range(2):
            tcp = obs["agent_pos"][b, t][[2, 0, 1]]  # where make_spec puts x, y, z
            torch.testing.assert_close(seen[b, t], (obs["point_cloud"][b, t] - tcp) / 0.15)


@pytest.mark.parametrize("channels", [3, 6])
def test_moving_hand_and_cloud_together_is_invisible_in_the_tcp_frame_only(channels):
    spec = make_spec(point_channels=channels)
    obs, by = make_obs(spec, 2), torch.tensor([0.3, -0.2, 0.1])
    for frame, same in (("tcp", True), ("base", False)):
        policy = made(spec, cloud_frame={"frame": frame})
        a, b = cloud_features(policy, obs), cloud_features(policy, moved(obs, spec, by))
        assert torch.allclose(a, b, atol=1e-4) is same


def test_colours_are_normalised_in_the_tcp_frame():
    spec = make_spec(point_channels=6)
    obs, policy = make_obs(spec, 2), made(spec, cloud_frame={"frame": "tcp"})
    expected = policy.normalizer.normalize("point_cloud", obs["point_cloud"])[..., 3:]
    torch.testing.assert_close(seen_cloud(policy, obs)[..., 3:], expected)


def test_tcp_frame_without_a_known_tcp_is_refused_with_the_remedy():
    with pytest.raises(ConfigError, match="use cloud_frame 'base'"):
        made(make_spec(tcp=False), cloud_frame={"frame": "tcp"})


def test_auto_is_the_tools_frame_where_there_is_one_and_the_policy_says_which():
    for tcp, frame in ((True, "tcp"), (False, "base")):
        policy = made(make_spec(tcp=tcp), cloud_frame={"frame": "auto"})
        assert policy.transforms["cloud_frame"].config.frame == frame
        assert policy.config_dict()["inputs"]["cloud_frame"]["frame"] == frame


def test_only_the_first_points_are_read_where_max_points_says_so():
    spec = make_spec(points=32)
    obs, policy = make_obs(spec, 2), made(spec, points={"max_points": 8})
    prefix = {**obs, "point_cloud": obs["point_cloud"][:, :, :8]}
    torch.testing.assert_close(policy.encode(obs), policy.encode(prefix), rtol=0, atol=0)
    assert not torch.allclose(policy.encode(obs).cond, made(spec).encode(obs).cond)


def test_both_frames_of_the_history_and_both_inputs_matter():
    spec = make_spec()
    obs, policy = make_obs(spec, 2), made(spec)
    base = policy.encode(obs).cond
    assert base.shape == (2, policy.encoder.shape.cond)
    for key in ("point_cloud", "agent_pos"):
        for frame in range(2):
            other = {k: v.clone() for k, v in obs.items()}
            other[key][:, frame] += 0.5
            assert (policy.encode(other).cond - base).abs().amax(1).min() > 1e-3


def test_least_range_holds_for_the_state_and_never_for_actions():
    spec, least = make_spec(), 4.0  # every range of `stats` lies between 0.5 and 1.5
    plain, held = made(spec), made(spec, normalizer={"min_state_range": least})
    for field in ("point_cloud", "agent_pos", "action"):
        low, high = (torch.as_tensor(getattr(stats(spec)[field], name)) for name in ("min", "max"))
        share = (high - low) / least if field == "agent_pos" else torch.ones_like(low)
        torch.testing.assert_close(held.normalizer.normalize(field, high), share)
        torch.testing.assert_close(plain.normalizer.normalize(field, high), torch.ones_like(high))
    with pytest.raises(ConfigError, match="min_state_range"):
        made(spec, normalizer={"min_state_range": -1.0})


class CloudOnly(ObsEncoder):
    """Reads the cloud alone."""

    Config = DP3EncoderConfig
    keys = ("point_cloud",)

    def __init__(self, config, spec, chunk):
        super().__init__(config, spec, chunk)
        self.layer, self.shape = torch.nn.Linear(spec.obs.point_channels, 8), FeatureShape(8)

    def forward(self, obs):
        return Features(self.layer(obs["point_cloud"].mean((1, 2))))


@pytest.fixture
def cloud_only():
    ENCODERS.add("cloud_only", CloudOnly)
    yield
    ENCODERS._remove("cloud_only")


@pytest.mark.usefixtures("cloud_only")
@pytest.mark.parametrize(("frame", "keys"), [("base", ("point_cloud",)), ("tcp", ("point_cloud", "agent_pos"))])
def test_a_policy_reads_what_its_encoder_and_its_transforms_read(frame, keys):
    spec = make_spec()
    config = {**TINY, "encoder": "cloud_only", "inputs": {"cloud_frame": {"frame": frame}, "points": {"max_points": 8}}}
    policy = make_policy("simple_dp3", spec, CHUNK, config, seed=0)
    assert policy.keys == keys
    assert set(policy.normalizer.fields) == {*keys, "action"}
    obs = make_obs(spec, 2)
    generator = torch.Generator().manual_seed(0)
    assert policy.act({key: obs[key] for key in keys}, generator=generator).shape == (2, 3, 3)
    assert policy.encode_training(obs, generator).cond.shape == (2, 8)
    with pytest.raises(SpecMismatchError, match="reads 'point_cloud'"):
        policy.act({"agent_pos": obs["agent_pos"]})
