import math

import pytest
import torch
from policy_specs import adroit_door, make_obs, make_spec

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.methods import METHODS, make_policy
from manicm_ms.spec import ChunkSpec

SPEC = make_spec()
CHUNK = METHODS.get("bc_gmm_3d").chunk
SMALL = {"head": {"widths": (16,), "modes": 3}, "encoder": {"point_widths": (16, 32)}}


def policy(**head):
    return make_policy("bc_gmm_3d", SPEC, config={**SMALL, "head": {**SMALL["head"], **head}}, seed=0)


def features(made, rows, seed=0):
    return Features(torch.randn(rows, made.encoder.shape.cond, generator=torch.Generator().manual_seed(seed)))


def test_the_row_is_robomimics():
    made = make_policy("bc_gmm_3d", adroit_door(), seed=0)
    assert ChunkSpec(1, 1, 1) == CHUNK
    assert (made.head.config.widths, made.head.config.modes, made.nfe) == ((1024, 1024), 5, 1)
    assert METHODS.get("bc_gmm_3d").optimizer == {"betas": (0.9, 0.999), "weight_decay": 0.0}


def test_loss_is_the_negative_log_likelihood_written_out():
    made = policy()
    head, seen = made.head, features(made, 7)
    action = torch.rand(7, 1, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1
    logits, means, stds = head.parameters_of(seen)
    z = (action.flatten(1)[:, None] - means) / stds
    each = -0.5 * z**2 - stds.log() - 0.5 * math.log(2 * math.pi)
    wanted = -torch.logsumexp(logits.log_softmax(-1) + each.sum(-1), dim=-1).mean()
    torch.testing.assert_close(head.loss(seen, action, torch.Generator()), wanted)


def test_means_and_deviations_keep_within_their_bounds():
    made = policy()
    with torch.no_grad():
        made.head.output.bias.fill_(-50.0)
    _, means, stds = made.head.parameters_of(features(made, 4))
    assert means.abs().max() <= 1
    assert stds.min() >= made.head.config.min_std


def test_a_mode_is_drawn_by_its_weight_and_the_sample_is_its_mean():
    made, rows = policy(acting_std=1e-4), 20_000
    seen = Features(features(made, 1).cond.expand(rows, -1))
    noise = torch.randn(2, rows, 1, 3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        logits, means, _ = made.head.parameters_of(Features(seen.cond[:1]))
        chunk, _ = made.head.act(seen, (noise[0], noise[1]), None)
    distance = (chunk.flatten(1)[:, None] - means).abs().amax(-1)  # (rows, M)
    nearest = distance.argmin(1)
    assert distance.min(1).values.max() < 1e-3
    shares = torch.bincount(nearest, minlength=3) / rows
    torch.testing.assert_close(shares, logits.softmax(-1)[0], atol=0.02, rtol=0)


def test_the_same_noise_gives_the_same_action_and_rows_do_not_meet():
    made, obs = policy(), make_obs(SPEC, 4, chunk=CHUNK)
    noise = torch.randn(2, 4, 1, 3, generator=torch.Generator().manual_seed(2))
    together = made.act(obs, noise=noise)
    assert torch.equal(together, made.act(obs, noise=noise))
    alone = made.act({key: value[2:3] for key, value in obs.items()}, noise=noise[:, 2:3])
    torch.testing.assert_close(alone, together[2:3], atol=1e-6, rtol=0)


def test_it_learns_two_modes_and_keeps_them_apart():
    """A regression would answer with the mean, 0, which no demonstration holds."""
    made = policy(widths=(32,))
    seen = Features(torch.zeros(64, made.encoder.shape.cond))
    action = torch.where(torch.arange(64) % 2 == 0, 0.6, -0.6)[:, None, None].expand(-1, 1, 3)
    optimizer = torch.optim.Adam(made.head.parameters(), lr=1e-2)
    for _ in range(200):
        optimizer.zero_grad()
        made.head.loss(seen, action, torch.Generator()).backward()
        optimizer.step()
    noise = torch.randn(2, 64, 1, 3, generator=torch.Generator().manual_seed(0))
    chunk, _ = made.head.act(seen, (noise[0], noise[1]), None)
    assert (chunk.abs() - 0.6).abs().max() < 0.1
    assert {bool(v) for v in (chunk[:, 0, 0] > 0)} == {True, False}


@pytest.mark.parametrize("bad", [{"modes": 0}, {"widths": ()}, {"min_std": 0.0}, {"acting_std": -1.0}])
def test_values_out_of_range_are_refused(bad):
    with pytest.raises(ConfigError):
        policy(**bad)


def test_weights_that_diverged_give_a_loss_that_is_not_finite_and_no_traceback():
    made = policy()
    with torch.no_grad():
        made.head.output.weight.fill_(float("nan"))
    assert made.head.loss(features(made, 2), torch.zeros(2, 1, 3), torch.Generator()).isnan()
