"""Objectives against hand computation and closed forms; cached features against computed ones."""

import math

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler
from reach_demos import make_store, reach_spec
from torch import nn

from manicm_ms.demos.stats import store_stats
from manicm_ms.demos.store import DemoStore
from manicm_ms.demos.windows import Windows
from manicm_ms.policies.base import make_policy
from manicm_ms.policies.consistency import boundary_scalings
from manicm_ms.policies.diffusion import DiffusionConfig, DiffusionPolicy
from manicm_ms.policies.manicm import ConsistencyConfig, ManiCM
from manicm_ms.spec import ChunkSpec
from manicm_ms.training.features import CLEAN_ACTION, COND, draw_points, encode_windows
from manicm_ms.training.objectives import (
    ConsistencyDistillation,
    DiffusionObjective,
    PublicConsistencyDistillation,
)
from manicm_ms.training.optim import PowerDecay
from manicm_ms.training.stream import step_generator, subset_generator

CHUNK = ChunkSpec()


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    with DemoStore.open(make_store(tmp_path_factory.mktemp("data") / "reach.zarr", episodes=3)) as opened:
        yield opened


@pytest.fixture(scope="module")
def windows(store):
    return Windows.from_store(store, CHUNK)


def small_policy(store, prediction_type="sample", max_points=None, **network):
    config = {
        "network": {"down_dims": (16, 32), "max_points": max_points, "cloud_frame": "tcp"} | network,
        "diffusion": {"prediction_type": prediction_type},
    }
    return make_policy("simple_dp3", store.spec, CHUNK, config, stats=store_stats(store), seed=0)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("prediction_type", ["sample", "epsilon"])
def test_diffusion_loss_equals_hand_computation(store, windows, prediction_type):
    """Noise and times are drawn again from the same generator; noising is done by diffusers."""
    policy = small_policy(store, prediction_type)
    batch = windows.batch(torch.arange(8))
    loss = DiffusionObjective(policy, None, PowerDecay())(batch, generator())
    draws = generator()
    epsilon = torch.randn(8, 4, 3, generator=draws)
    t = torch.randint(100, (8,), generator=draws)
    low, high = windows.action.amin(0), windows.action.amax(0)
    x0 = 2 * (batch["action"] - low) / (high - low) - 1
    x_t = DDPMScheduler(100, beta_schedule="squaredcos_cap_v2").add_noise(x0, epsilon, t)
    output = policy.network.denoise(x_t, t, policy.network.encode(batch))
    expected = (output - (x0 if prediction_type == "sample" else epsilon)).pow(2).sum() / (8 * 4 * 3)
    torch.testing.assert_close(loss, expected)


def test_diffusion_objective_reads_only_the_drawn_points(store, windows):
    policy = small_policy(store, max_points=16)
    objective = DiffusionObjective(policy, 16, PowerDecay())
    batch = windows.batch(torch.arange(8))
    chosen = torch.randperm(64, generator=generator())[:16]
    spoiled = batch["point_cloud"].clone()
    spoiled[:, :, [i for i in range(64) if i not in chosen.tolist()]] = math.nan
    assert torch.isfinite(objective(batch | {"point_cloud": spoiled}, generator()))


def test_outcome_of_a_teacher_is_its_average(store, windows):
    policy = small_policy(store)
    objective = DiffusionObjective(policy, None, PowerDecay(0.75))
    optimizer = torch.optim.SGD(policy.parameters(), lr=0.1)
    name = next(k for k, p in policy.named_parameters() if k.startswith("network.unet"))
    visited = []
    for step in range(3):
        objective(windows.batch(torch.arange(8)), generator(step)).backward()
        optimizer.step()
        objective.after_step()
        visited.append(policy.get_parameter(name).detach().clone())
    average = visited[0]
    for n in (1, 2):
        decay = 1 - (1 + n) ** -0.75
        average = decay * average + (1 - decay) * visited[n]
    torch.testing.assert_close(objective.outcome.get_parameter(name), average)
    assert not any(p.requires_grad for p in objective.outcome.parameters())


def test_drawn_points_are_distinct_points_of_the_cloud(windows):
    batch = windows.batch(torch.arange(5))
    drawn = draw_points(batch, 20, generator())["point_cloud"]
    assert drawn.shape == (5, 2, 20, 3)
    for cloud, subset in zip(batch["point_cloud"].flatten(0, 1), drawn.flatten(0, 1), strict=True):
        matches = (subset[:, None] == cloud[None]).all(-1)
        assert matches.any(1).all()
        assert matches.any(0).sum() == 20
    assert torch.equal(draw_points(batch, 64, generator())["point_cloud"], batch["point_cloud"])


def test_cached_features_equal_computed_ones(store, windows):
    network = small_policy(store).network
    features = encode_windows(network, windows, draws=4, seed=0)
    everything = torch.arange(len(windows))
    assert features.cond.shape == (len(windows), 1, 256)
    picked = torch.tensor([5, 0, 35])
    batch = windows.batch(picked)
    torch.testing.assert_close(features.batch(picked)[COND][:, 0], network.encode(batch))
    torch.testing.assert_close(
        network.normalizer.unnormalize("action", features.batch(everything)[CLEAN_ACTION]),
        windows.batch(everything)["action"],
    )


def test_first_cached_subset_is_what_the_policy_reads_when_acting(store, windows):
    network = small_policy(store, max_points=16).network
    features = encode_windows(network, windows, draws=3, seed=0)
    acting = network.encode(windows.batch(torch.arange(len(windows))))
    assert features.cond.shape[1] == 3
    torch.testing.assert_close(features.cond[:, 0], acting)
    assert not torch.allclose(features.cond[:, 1], features.cond[:, 2])


@pytest.mark.parametrize(
    ("acting", "training", "subsets", "prefixes"),
    [("prefix", "random", 3, 1), ("random", "random", 3, 0), ("prefix", "prefix", 1, 1), ("random", "prefix", 3, 2)],
)
def test_cached_subsets_follow_the_two_choices_of_points(store, windows, acting, training, subsets, prefixes):
    network = small_policy(store, max_points=16, acting_points=acting, training_points=training).network
    features = encode_windows(network, windows, draws=3, seed=0).cond
    prefix = network.encode(windows.batch(torch.arange(len(windows))))
    assert features.shape[1] == subsets
    assert sum(torch.allclose(features[:, k], prefix) for k in range(subsets)) == prefixes


def test_diffusion_objective_reads_the_prefix_where_it_is_told_to(store, windows):
    policy = small_policy(store, max_points=16, training_points="prefix")
    batch = windows.batch(torch.arange(8))
    spoiled = batch["point_cloud"].clone()
    spoiled[:, :, 16:] = math.nan
    objective = DiffusionObjective(policy, 16, PowerDecay())
    assert torch.isfinite(objective(batch | {"point_cloud": spoiled}, generator()))


class TimeTable(nn.Module):
    """A denoiser that multiplies x_t by a number looked up at t: enough for a Gaussian, whose score is linear."""

    def __init__(self, factors):
        super().__init__()
        self.factors = nn.Parameter(factors)
        self.encoder = nn.Identity()

    def denoise(self, x_t, t, cond):
        return self.factors[t][:, None, None] * x_t


SIGMA = 0.2  # standard deviation of the toy's actions, small enough that the teacher's x0 is not clipped


def gaussian_case(objective_type, scale=1.0):
    """Return the objective for actions N(0, SIGMA^2), with the exact teacher and the student times `scale`.

    The teacher is E[x0 | x_t] = sqrt(abar) SIGMA^2 / (abar SIGMA^2 + 1 - abar) x_t. One DDIM step multiplies
    x by a number, so that the exact consistency function multiplies by the product of these down to 0.
    """
    chunk, spec = ChunkSpec(1, 1, 1), reach_spec(action_names=("a",))
    diffusion = DiffusionConfig()
    abar = diffusion.ddpm().alphas_cumprod.double()
    posterior = abar.sqrt() * SIGMA**2 / (abar * SIGMA**2 + 1 - abar)
    consistent = torch.zeros(100, dtype=torch.float64)
    product, previous = 1.0, torch.tensor(1.0, dtype=torch.float64)
    for t in range(9, 100, 10):
        a, m = abar[t], posterior[t]
        product *= float(previous.sqrt() * m + (1 - previous).sqrt() * (1 - a.sqrt() * m) / (1 - a).sqrt())
        previous, consistent[t] = a, product
    c_skip, c_out = boundary_scalings(torch.arange(100))
    network = torch.where(consistent > 0, (scale * consistent - c_skip) / c_out.clamp_min(1e-9), 0.0)
    teacher = DiffusionPolicy("gauss", TimeTable(posterior.float()), spec, chunk, diffusion)
    student = ManiCM(TimeTable(network.float()), spec, chunk, diffusion, ConsistencyConfig())
    return objective_type(teacher, student, mu=0.95), consistent


def gaussian_batch(rows, seed=0):
    x0 = SIGMA * torch.randn(rows, 1, 1, generator=generator(seed))
    return {CLEAN_ACTION: x0, COND: torch.zeros(rows, 1, 1)}


def test_exact_consistency_function_has_no_loss_and_no_gradient():
    objective, _ = gaussian_case(ConsistencyDistillation)
    loss = objective(gaussian_batch(512), generator())
    loss.backward()
    assert loss.item() < 1e-10
    assert objective.student.network.factors.grad.abs().max() < 1e-6


def test_wrong_consistency_function_has_loss_and_the_public_formula_another_optimum():
    wrong, _ = gaussian_case(ConsistencyDistillation, scale=1.2)
    public, _ = gaussian_case(PublicConsistencyDistillation)
    for objective in (wrong, public):
        assert objective(gaussian_batch(512), generator()).item() > 1e-5


def test_distillation_of_a_gaussian_converges_to_the_exact_function():
    objective, consistent = gaussian_case(ConsistencyDistillation, scale=0.6)
    optimizer = torch.optim.Adam(objective.student.parameters(), lr=5e-3)
    for step in range(600):
        optimizer.zero_grad()
        objective(gaussian_batch(256, step), generator(step)).backward()
        optimizer.step()
        objective.after_step()
    x = torch.ones(1, 1, 1)
    for t in (99, 49, 9):
        learned = objective.student.consistency_function(x, torch.tensor([t]), None).item()
        assert learned == pytest.approx(float(consistent[t]), abs=0.03)


def test_only_the_unet_of_the_student_is_trained(store, windows):
    teacher = small_policy(store)
    objective = ConsistencyDistillation(teacher, ManiCM.from_teacher(teacher), mu=0.95)
    trained = {k for k, p in objective.named_parameters() if p.requires_grad}
    assert trained
    assert all(k.startswith("student.network.unet.") for k in trained)
    features = encode_windows(teacher.network, windows, 1, 0)
    objective(features.batch(torch.arange(8)), generator()).backward()
    assert all(objective.get_parameter(k).grad is not None for k in trained)


class NoisyDenoiser(TimeTable):
    """A denoiser with a layer that behaves otherwise in training, in the encoder and beside it."""

    def __init__(self, factors):
        super().__init__(factors)
        self.encoder = nn.Sequential(nn.Linear(1, 1), nn.Dropout(0.5))
        self.unet = nn.Sequential(nn.Linear(1, 1), nn.Dropout(0.5))


def test_training_switches_only_what_is_trained(store):
    chunk, diffusion = ChunkSpec(1, 1, 1), DiffusionConfig()
    teacher = DiffusionPolicy("noisy", NoisyDenoiser(torch.ones(100)), store.spec, chunk, diffusion)
    teacher.eval()
    student = ManiCM(NoisyDenoiser(torch.ones(100)), store.spec, chunk, diffusion, ConsistencyConfig())
    learning = DiffusionObjective(teacher, None, PowerDecay()).train()
    assert all(m.training for m in learning.policy.modules())
    assert not any(m.training for m in learning.average.modules())
    distilling = ConsistencyDistillation(teacher, student, mu=0.95).train()
    frozen = (distilling.teacher, distilling.target, distilling.student.network.encoder)
    assert not any(m.training for part in frozen for m in part.modules())
    assert all(m.training for m in distilling.student.network.unet.modules())
    assert not any(m.training for m in distilling.eval().modules())


def test_encoded_subsets_are_not_those_of_the_first_training_step(store, windows):
    network = small_policy(store, max_points=16).network
    features = encode_windows(network, windows, draws=2, seed=0).cond[:, 1]
    everything = windows.batch(torch.arange(len(windows)))
    shared = network.encode(draw_points(everything, 16, step_generator(0, 0, 0, "cpu")))
    own = network.encode(draw_points(everything, 16, subset_generator(0, 0, "cpu")))
    torch.testing.assert_close(features, own)
    assert not torch.allclose(features, shared)


def test_each_row_sees_one_of_its_subsets(store, windows):
    """All subsets but the one that a row draws are spoiled, and the loss is finite."""
    teacher = small_policy(store, max_points=16)
    objective = ConsistencyDistillation(teacher, ManiCM.from_teacher(teacher), mu=0.95)
    features = encode_windows(teacher.network, windows, draws=3, seed=0)
    batch = features.batch(torch.arange(30))
    picked = torch.randint(3, (30,), generator=generator())
    spoiled = batch[COND].clone()
    spoiled[picked[:, None] != torch.arange(3)] = math.nan
    assert len(set(np.unique(picked))) == 3
    assert torch.isfinite(objective(batch | {COND: spoiled}, generator()))
