"""Every method that samples runs on every backbone; what each row says of its evaluations is counted; heads learn."""

import pytest
import torch
from policy_specs import make_obs, make_spec, wobble

from manicm_ms.policies.checkpoint import load_checkpoint, save_checkpoint
from manicm_ms.policies.configuration import parse_overrides
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.heads.head import HEADS, TrainableHead
from manicm_ms.policies.methods import METHODS, make_policy
from manicm_ms.policies.policy import example_observations

SPEC = make_spec()
GENERATIVE = [name for name in METHODS.names() if METHODS.get(name).backbone is not None and not name.startswith("toy")]
DECODERS = ("unet1d", "mixer", "tokens")
ONE_STEP = ("meanflow", "drift", "uca_flow")


def smoke(method, *overrides):
    return make_policy(method, SPEC, config=parse_overrides(overrides), size="smoke", seed=0)


@pytest.mark.parametrize("decoder", DECODERS)
@pytest.mark.parametrize("method", GENERATIVE)
def test_the_decoder_is_a_choice(method, decoder):
    policy = smoke(method, f"backbone={decoder}")
    assert policy.config_dict()["backbone"]["name"] == decoder
    obs = example_observations(policy, 3)
    assert policy.act(obs, generator=torch.Generator().manual_seed(0)).shape == (3, 3, 3)
    if isinstance(policy.head, TrainableHead):
        loss = policy.head.loss(policy.encode(obs), torch.zeros(3, 4, 3), torch.Generator().manual_seed(0))
        loss.backward()
        idle = [name for name, p in policy.named_parameters() if p.grad is None]
        assert torch.isfinite(loss)
        assert [name for name in idle if not name.startswith("normalizer")] == []


def evaluations(policy):
    """Count how often the network answers in one decision: the backbone, or a head's own last layer."""
    count, network = [], policy.head.backbone if policy.head.backbone is not None else policy.head.output
    hook = network.register_forward_hook(lambda *args: count.append(1))
    policy.act(example_observations(policy, 2), generator=torch.Generator().manual_seed(0))
    hook.remove()
    return len(count)


@pytest.mark.parametrize("method", METHODS.names())
def test_a_rows_evaluations_are_counted_on_its_network(method):
    assert evaluations(smoke(method)) == METHODS.get(method).nfe


@pytest.mark.parametrize("method", ["meanflow", "uca_flow", "simple_dp3"])
@pytest.mark.parametrize("steps", [1, 2, 4, 10])
def test_asked_evaluations_are_counted_too(method, steps):
    policy = smoke(method, f"head.num_inference_steps={steps}", "backbone=mixer")
    assert evaluations(policy) == policy.nfe == steps


@pytest.mark.parametrize("method", ONE_STEP)
def test_a_checkpoint_gives_the_same_actions(method, tmp_path):
    policy = smoke(method)
    wobble(policy.head)
    save_checkpoint(policy, tmp_path / "kept", {})
    again, obs = load_checkpoint(tmp_path / "kept"), make_obs(SPEC, 4)
    one, other = (p.act(obs, generator=torch.Generator().manual_seed(3)) for p in (policy, again))
    assert torch.equal(one, other)
    assert again.config_dict() == policy.config_dict()


@pytest.mark.parametrize("method", ONE_STEP)
def test_it_learns_an_action_of_the_observation(method):
    """The action is 0.7 where a number of the features is positive, -0.7 elsewhere; saying nothing would err by 0.7."""
    head = HEADS.get(method)
    policy = smoke(method, "backbone=mixer")
    assert isinstance(policy.head, head)
    g, width = torch.Generator().manual_seed(0), policy.encoder.shape.cond
    optimizer = torch.optim.Adam(policy.head.parameters(), lr=5e-3)

    def situations(rows):
        cond = torch.randn(rows, width, generator=g) * torch.eye(width)[0]
        return Features(cond), 0.7 * cond[:, :1, None].sign().expand(-1, 4, 3)

    for _ in range(100):
        features, action = situations(64)
        optimizer.zero_grad()
        policy.head.loss(features, action, g).backward()
        optimizer.step()
    features, action = situations(256)
    with torch.no_grad():
        chosen, _ = policy.head.act(features, (torch.randn(256, 4, 3, generator=g),), None)
    assert (chosen - action).square().mean().sqrt() < 0.45
