"""MeanFlow and UCA-Flow against finite differences in double precision, flow matching and their own formulas."""

import math

import pytest
import torch
from policy_specs import make_spec, wobble

from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.heads.average_velocity import AverageVelocityConfig
from manicm_ms.policies.heads.meanflow import MeanFlowConfig, dispersive_loss
from manicm_ms.policies.methods import make_policy

BACKBONES = {
    "mixer": {"name": "mixer", "width": 16, "blocks": 2},
    "tokens": {"name": "tokens", "width": 16, "blocks": 2, "heads": 2},
    "unet1d": {"name": "unet1d", "down_dims": (8, 16), "n_groups": 4, "step_embed_dim": 8},
}
ROWS = 6


def head_of(method="meanflow", backbone="mixer", **fields):
    config = {"encoder": {"point_widths": (16, 32)}, "backbone": BACKBONES[backbone], "head": fields}
    head = make_policy(method, make_spec(), config=config, seed=0).head
    wobble(head)
    return head.double()


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def example(head, rows=ROWS):
    g, shape = generator(5), head.shape[2]
    tokens = torch.randn(rows, *shape.tokens, generator=g, dtype=torch.float64)
    action = torch.rand(rows, 4, 3, generator=g, dtype=torch.float64) * 2 - 1
    return Features(tokens.flatten(1), tokens), action


def draws(action, share):
    """Draw again what a loss draws: noise, two times, and where they are made equal."""
    g, rows = generator(), len(action)
    e = torch.randn(action.shape, generator=g, dtype=torch.float64)
    two = 1 / (1 + torch.exp(0.4 - torch.randn(2, rows, generator=g, dtype=torch.float64)))
    r, t = torch.minimum(*two), torch.maximum(*two)
    equal = torch.rand(rows, generator=g, dtype=torch.float64) < share
    return e, torch.where(equal, t, r), t


def central_difference(u, z, r, t, direction, step=1e-5):
    """Return the derivative of u along (direction, 0, 1)."""
    with torch.no_grad():
        ahead, behind = (u(z + s * direction, r, t + s) for s in (step, -step))
    return (ahead - behind) / (2 * step)


def adaptive(error):
    total = 0.0
    for row in error:
        square = row.square().sum() / row.numel()
        total = total + square / math.sqrt(float(square.detach()) + 1e-3)
    return total / len(error)


def of_meanflow(head, features):
    return lambda z, r, t: head.backbone(z, (t, r), features)


def of_uca(head, features):
    return lambda z, r, t: head.backbone(z, (t, t - r), features)


def assert_same_loss_and_gradient(head, loss, expected):
    torch.testing.assert_close(loss, expected, rtol=1e-6, atol=1e-9)
    weights = list(head.parameters())
    for found, wanted in zip(torch.autograd.grad(loss, weights), torch.autograd.grad(expected, weights), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize("kind", ["plain", "extrapolated", "improved"])
def test_meanflows_loss_and_gradient_are_those_of_finite_differences(kind, backbone):
    head = head_of(backbone=backbone, velocity_target=kind)
    features, action = example(head)
    e, r, t = draws(action, 0.5)
    assert 0 < (r == t).sum() < ROWS
    u, v, z = of_meanflow(head, features), e - action, (1 - t)[:, None, None] * action + t[:, None, None] * e
    own = u(z, t, t).detach()
    direction, wanted = {"plain": (v, v), "extrapolated": (2 * v - own,) * 2, "improved": (own, v)}[kind]
    target = wanted - (t - r)[:, None, None] * central_difference(u, z, r, t, direction)
    assert_same_loss_and_gradient(head, head.loss(features, action, generator()), adaptive(u(z, r, t) - target))


@pytest.mark.parametrize("backbone", BACKBONES)
def test_uca_flows_loss_and_gradient_are_those_of_finite_differences(backbone):
    head = head_of("uca_flow", backbone)
    features, action = example(head)
    e, r, t = draws(action, 0.0)
    u, v, z = of_uca(head, features), e - action, (1 - t)[:, None, None] * action + t[:, None, None] * e
    own = u(z, t, t)
    implied = u(z, r, t) + (t - r)[:, None, None] * central_difference(u, z, r, t, own.detach())
    expected = adaptive(implied - v) + adaptive(own - v)
    assert_same_loss_and_gradient(head, head.loss(features, action, generator()), expected)


def test_where_r_is_t_it_is_flow_matching():
    head = head_of(equal_share=1.0)
    features, action = example(head)
    e, _, t = draws(action, 1.0)
    z = action + t[:, None, None] * (e - action)
    expected = adaptive(head.backbone(z, (t, t), features) - (e - action))
    torch.testing.assert_close(head.loss(features, action, generator()), expected)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_times_are_logistic_gaussians_in_order_and_equal_by_their_share(share):
    head = head_of(equal_share=share)
    action = torch.zeros(20_000, 1, 1, dtype=torch.float64)
    z, v, r, t = head.drawn_path(action, generator())
    assert (r <= t).all()
    assert (r == t).double().mean().item() == pytest.approx(share, abs=0.01)
    torch.testing.assert_close(z, t[:, None, None] * v)
    if share == 0:  # the smaller and the larger of two draws, together all draws
        logits = torch.cat([r, t]).logit()
        assert logits.mean().item() == pytest.approx(-0.4, abs=0.03)
        assert logits.std().item() == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(("method", "second"), [("meanflow", 0.0), ("uca_flow", 1.0)])
def test_one_step_subtracts_the_average_velocity_of_the_whole_way(method, second):
    head = head_of(method)
    features, noise = example(head)
    ones = torch.ones(ROWS, dtype=torch.float64)
    expected = noise - head.backbone(noise, (ones, second * ones), features)
    torch.testing.assert_close(head.act(features, (noise,), None)[0], expected)


@pytest.mark.parametrize("method", ["meanflow", "uca_flow"])
def test_several_steps_cross_equal_parts_of_the_way(method):
    head = head_of(method, num_inference_steps=4)
    features, z = example(head)
    chosen, state = head.act(features, (z,), None)
    for end in (1.0, 0.75, 0.5, 0.25):
        second = end - 0.25 if method == "meanflow" else 0.25
        times = [torch.full((ROWS,), value, dtype=torch.float64) for value in (end, second)]
        z = z - 0.25 * head.backbone(z, tuple(times), features)
    torch.testing.assert_close(chosen, z)
    assert (head.nfe, state) == (4, None)


def test_any_number_of_steps_follows_a_constant_velocity_to_its_action():
    """Where u is e - x whatever the times, every number of steps ends at x."""
    x = torch.rand(ROWS, 4, 3, dtype=torch.float64)
    noise = torch.randn(ROWS, 4, 3, dtype=torch.float64)
    for steps in (1, 2, 10):
        head = head_of(num_inference_steps=steps)
        head.velocity = lambda z, r, t, features: noise - x
        torch.testing.assert_close(head.sample(Features(x[:, 0]), noise), x)


@pytest.mark.parametrize("backbone", BACKBONES)
@pytest.mark.parametrize(
    ("method", "fields"),
    [
        ("meanflow", {"velocity_target": "improved"}),
        ("meanflow", {"velocity_target": "extrapolated"}),
        ("uca_flow", {}),
    ],
)
def test_products_in_16_bits_leave_every_weight_its_gradient(method, fields, backbone):
    head = head_of(method, backbone, **fields).float()
    features, action = example(head)
    features, action = features.changed(torch.Tensor.float), action.float()
    slopes = []
    for enabled in (False, True):
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            loss = head.loss(features, action, generator())
        slopes.append(torch.autograd.grad(loss, list(head.parameters())))
    assert all(slope.abs().sum() > 0 for slope in slopes[1])
    exact, rounded = (torch.cat([slope.flatten() for slope in each]) for each in slopes)
    assert torch.cosine_similarity(exact, rounded, dim=0) > 0.99


# ---- the dispersive loss --------------------------------------------------------------------------------------------


def test_dispersive_loss_is_the_loop_over_pairs():
    values = torch.randn(5, 3, 2, generator=generator(), dtype=torch.float64).float()
    distances = [[float((a - b).square().sum()) for b in values] for a in values]
    largest = max(map(max, distances))
    mean = sum(math.exp(-d / largest) for row in distances for d in row) / 25
    assert dispersive_loss(values).item() == pytest.approx(math.log(mean), abs=1e-6)


@pytest.mark.parametrize("rows", [1, 4])
def test_dispersive_loss_of_equal_rows_is_zero_and_its_gradient_finite(rows):
    values = torch.ones(rows, 3, requires_grad=True)
    loss = dispersive_loss(values)
    loss.backward()
    assert loss.item() == 0
    assert torch.isfinite(values.grad).all()


def test_dispersive_part_is_that_of_every_stage_but_the_last_with_its_gradient():
    """The stages' outputs come out of forward mode; here they are read by hooks on an ordinary evaluation."""
    config = BACKBONES["unet1d"] | {"down_dims": (8, 16, 16)}
    made = {}
    for weight in (0.0, 0.5):
        sections = {"encoder": {"point_widths": (16, 32)}, "backbone": config, "head": {"dispersive_weight": weight}}
        made[weight] = make_policy("meanflow", make_spec(), config=sections, seed=0).head.double()
    head = made[0.5]
    assert (made[0.0].taps, head.taps) == ((), ("down0", "down1"))
    features, action = example(head)
    seen = []
    hooks = [stage.register_forward_hook(lambda *args: seen.append(args[-1])) for stage in head.backbone.down[:-1]]
    z, _, r, t = head.drawn_path(action, generator())
    head.backbone(z, (t, r), features)
    for hook in hooks:
        hook.remove()
    extra = 0.5 * sum(dispersive_loss(values) for values in seen)
    whole, plain = (made[w].loss(features, action, generator()) for w in (0.5, 0.0))
    torch.testing.assert_close((whole - plain), extra.double(), rtol=1e-5, atol=1e-6)
    first = [h.backbone.down[0][0].first[0].weight for h in (head, made[0.0])]
    parts = [torch.autograd.grad(loss, w)[0] for loss, w in ((whole, first[0]), (extra, first[0]), (plain, first[1]))]
    torch.testing.assert_close(parts[0], parts[1] + parts[2], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("backbone", [BACKBONES["mixer"], BACKBONES["tokens"], {"down_dims": (8,), "n_groups": 4}])
def test_a_backbone_without_stages_to_read_is_refused(backbone):
    with pytest.raises(ConfigError, match="dispersive_weight needs a backbone with two stages or more"):
        make_policy("meanflow", make_spec(), config={"backbone": backbone, "head": {"dispersive_weight": 0.5}})


def test_stages_that_do_not_exist_are_named():
    x, times = torch.zeros(1, 4, 3), (torch.zeros(1), torch.zeros(1))
    for backbone, message in (("unet1d", "has the stages down0, down1, asked for up0"), ("mixer", "Mixer has no stag")):
        head = head_of(backbone=backbone).float()
        with pytest.raises(ConfigError, match=message):
            head.backbone.tapped(x, times, Features(torch.zeros(1, head.shape[2].cond)), ("up0",))


@pytest.mark.parametrize(
    "bad",
    [
        {"num_inference_steps": 0},
        {"equal_share": 1.5},
        {"time_std": 0.0},
        {"weight_floor": 0.0},
        {"weight_power": -1.0},
        {"dispersive_weight": -0.5},
    ],
)
def test_values_out_of_range_are_refused(bad):
    with pytest.raises(ConfigError, match=next(iter(bad))):
        MeanFlowConfig(**bad)


def test_a_velocity_target_that_does_not_exist_is_named():
    with pytest.raises(UnknownNameError, match="velocity_target"):
        MeanFlowConfig(velocity_target="guided")
    assert AverageVelocityConfig() == AverageVelocityConfig(1, -0.4, 1.0, 0.5, 0.5, 1e-3)
