"""The drift field against a plain loop, its symmetries, and the head that follows it."""

import math

import pytest
import torch
from policy_specs import make_spec

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.heads.drift import DriftConfig
from manicm_ms.policies.heads.drift_field import drift_field
from manicm_ms.policies.methods import METHODS, make_policy

TEMPERATURES = (0.02, 0.05, 0.2)


def clouds(samples=4, data=1, observations=3, size=6, seed=0):
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(observations, n, size, generator=g, dtype=torch.float64) for n in (samples, data)]


def plain_field(samples, data, temperatures, self_distance):
    """Return the field of all samples by loops over observations, samples and targets."""
    observations, count, size = samples.shape
    targets = torch.cat([samples, data], dim=1)
    distance = [[[math.dist(x, y) for y in ys] for x in xs] for xs, ys in zip(samples, targets, strict=True)]
    scale = sum(d for a in distance for b in a for d in b) / (observations * count * targets.shape[1])
    total = torch.zeros_like(samples)
    for temperature in temperatures:
        force = torch.zeros_like(samples)
        for b in range(observations):
            weight = [
                [
                    math.exp(-(distance[b][i][k] / scale + (self_distance if i == k else 0)) / temperature)
                    for k in range(targets.shape[1])
                ]
                for i in range(count)
            ]
            for i in range(count):
                affinity = []
                for k in range(targets.shape[1]):
                    over_targets = weight[i][k] / sum(weight[i])
                    column = sum(weight[j][k] for j in range(count))
                    affinity.append(math.sqrt(max(over_targets * weight[i][k] / column, 1e-6)))
                repelled, attracted = sum(affinity[:count]), sum(affinity[count:])
                for k, target in enumerate(targets[b]):
                    sign = -attracted if k < count else repelled
                    force[b, i] += sign * affinity[k] * (target - samples[b, i]) / (scale / math.sqrt(size))
        total += force / math.sqrt(float(force.square().mean()))
    return total, scale / math.sqrt(size)


@pytest.mark.parametrize("data", [1, 3])
@pytest.mark.parametrize("self_distance", [0.5, 2.0])
def test_the_field_is_the_loop_over_observations_samples_and_targets(data, self_distance):
    a, y = clouds(data=data)
    wanted, unit = plain_field(a, y, (0.2, 0.5), self_distance)
    found = drift_field(a, a, y, (0.2, 0.5), self_distance)
    torch.testing.assert_close(found.field, wanted, rtol=1e-6, atol=1e-9)
    assert found.unit.item() == pytest.approx(unit)


def test_a_sample_beyond_its_own_reach_is_one_that_does_not_count():
    """At this distance its weight is 0 in double precision too, up to the floor, which pulls it to where it is."""
    a, y = clouds()
    far, farther = (drift_field(a, a, y, TEMPERATURES, d).field for d in (100.0, 1e4))
    torch.testing.assert_close(far, farther)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_is_finite_and_zero_where_all_samples_lie_on_the_data(dtype):
    y = torch.full((2, 1, 5), 0.3, dtype=dtype)
    a = y.expand(2, 4, 5)
    for self_distance in (0.0, 100.0):
        assert torch.equal(drift_field(a, a, y, TEMPERATURES, self_distance).field, torch.zeros_like(a))


def test_one_observation_that_is_solved_among_others_stays_finite():
    a, y = clouds()
    a[0] = y[0]
    assert torch.isfinite(drift_field(a, a, y, TEMPERATURES).field).all()


def test_without_the_mask_exchanging_data_and_samples_turns_it_round():
    points, _ = clouds(samples=5)
    a, y = clouds(samples=4, data=4, seed=1)
    one, other = (drift_field(points, *pair, TEMPERATURES, 0.0) for pair in ((a, y), (y, a)))
    assert one.field.abs().max() > 0.1
    torch.testing.assert_close(one.field, -other.field)
    torch.testing.assert_close(one.unit, other.unit)


def test_without_the_mask_it_is_zero_where_samples_equal_data_and_with_it_it_is_not():
    a, _ = clouds()
    assert drift_field(a, a, a, TEMPERATURES, 0.0).field.abs().max() == 0
    assert drift_field(a, a, a, TEMPERATURES).field.abs().max() > 0.1


def test_samples_that_lie_together_far_from_the_data_are_drawn_to_it():
    """No temperature reaches so far: the floor of the affinity does."""
    g = torch.Generator().manual_seed(0)
    a, y = 0.01 * torch.randn(1, 4, 12, generator=g), torch.ones(1, 1, 12)
    field = drift_field(a, a, y, TEMPERATURES).field
    assert (torch.cosine_similarity(field, y - a, dim=-1) > 0.95).all()


def test_samples_that_lie_together_amid_two_demonstrations_rest_on_average():
    """The published field rests here too: a force is P_i sum_j N_ij (y - a_j), whose mean over y vanishes."""
    g = torch.Generator().manual_seed(0)
    a, y = 1e-3 * torch.randn(1, 4, 12, generator=g).expand(2, 4, 12), torch.ones(2, 1, 12)
    y[1] = -1
    field = drift_field(a, a, y, TEMPERATURES).field
    assert field.mean(0).abs().max() < 0.01 * field.abs().max()


# ---- the head -------------------------------------------------------------------------------------------------------

SMALL = {
    "encoder": {"point_widths": (16, 32)},
    "backbone": {"name": "mixer", "width": 16, "blocks": 1},
    "head": {"samples": 3},
}


def example(head, rows=5):
    g = torch.Generator().manual_seed(1)
    return Features(torch.randn(rows, head.shape[2].cond, generator=g)), torch.randn(rows, 4, 3, generator=g)


def test_the_row_is_the_published_one():
    made = make_policy("drift", make_spec(), seed=0)
    assert (made.head.config.samples, made.head.config.temperatures) == (4, TEMPERATURES)
    assert (made.nfe, made.noise_draws, made.head.times, METHODS.get("drift").nfe) == (1, 1, 0, 1)


def test_the_gradient_moves_each_sample_along_its_drift():
    head = make_policy("drift", make_spec(), config=SMALL, seed=0).head
    features, action = example(head)
    made = []
    head.generate = lambda seen, noise: made.append((seen, noise.requires_grad_())) or noise
    loss = head.loss(features, action, torch.Generator().manual_seed(0))
    (seen, noise), *more = made
    assert not more
    assert torch.equal(seen.cond, features.cond[torch.arange(15) // 3]), "an observation's samples lie together"
    samples = noise.detach().reshape(5, 3, 12)
    field, unit = drift_field(samples, samples, action.reshape(5, 1, 12), TEMPERATURES)
    torch.testing.assert_close(loss, field.square().mean())
    slope = torch.autograd.grad(loss, noise)[0].reshape(5, 3, 12)
    torch.testing.assert_close(slope, -2 * field / (unit * field.numel()))


def test_acting_is_the_networks_answer_to_the_noise():
    head = make_policy("drift", make_spec(), config=SMALL, seed=0).head
    features, noise = example(head)
    chosen, state = head.act(features, (noise,), None)
    torch.testing.assert_close(chosen, head.backbone(noise, (), features))
    assert state is None


@pytest.mark.parametrize("bad", [{"samples": 1}, {"temperatures": ()}, {"temperatures": (0.1, 0.0)}])
def test_values_out_of_range_are_refused(bad):
    with pytest.raises(ConfigError, match=next(iter(bad))):
        DriftConfig(**bad)
