import pytest
import torch
from policy_specs import adroit_door, make_obs, make_spec

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.methods import METHODS, make_policy
from manicm_ms.spec import ChunkSpec

SPEC = make_spec()
CHUNK = METHODS.get("bc_rnn_3d").chunk
SMALL = {"head": {"width": 16, "layers": 2}, "encoder": {"point_widths": (16, 32)}}


def policy(chunk=CHUNK):
    return make_policy("bc_rnn_3d", SPEC, chunk, SMALL, seed=0)


def tokens(made, rows=3, seed=0):
    frames, width = made.encoder.shape.tokens
    return torch.randn(rows, frames, width, generator=torch.Generator().manual_seed(seed))


def test_the_row_is_robomimics():
    made = make_policy("bc_rnn_3d", adroit_door(), seed=0)
    assert (made.head.config.width, made.head.config.layers) == (400, 2)
    assert (CHUNK, made.nfe, made.noise_draws) == (ChunkSpec(10, 10, 1), 1, 0)


def test_an_action_depends_on_its_frame_and_those_before_it_alone():
    made = policy()
    seen = tokens(made)
    out = made.head.predict(Features(seen.flatten(1), seen))
    changed = seen.clone()
    changed[:, 6] += 1
    other = made.head.predict(Features(changed.flatten(1), changed))
    assert torch.equal(out[:, :6], other[:, :6])
    assert ((out - other)[:, 6:].abs().amax((0, 2)) > 0).all()


def test_the_last_frames_action_is_executed():
    made, obs = policy(), make_obs(SPEC, 4, chunk=CHUNK)
    actions = made.act(obs)
    assert actions.shape == (4, 1, 3)
    whole = made.head.predict(made.encode(obs))
    torch.testing.assert_close(actions[:, 0], whole[:, -1])
    assert torch.equal(actions, made.act(obs)), "deterministic"


def test_the_loss_covers_every_frame():
    made = policy()
    seen = Features(tokens(made).flatten(1), tokens(made))
    action = made.head.predict(seen).detach()
    assert made.head.loss(seen, action, torch.Generator()) == 0
    for frame in (0, 5, 9):
        wrong = action.clone()
        wrong[:, frame] += 0.3
        assert made.head.loss(seen, wrong, torch.Generator()).item() == pytest.approx(0.009, rel=1e-4)


def test_lengths_that_do_not_fit_are_refused():
    with pytest.raises(ConfigError, match="make horizon=12 and n_obs_steps=10 equal"):
        policy(ChunkSpec(10, 12, 1))
