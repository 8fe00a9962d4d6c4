"""Objectives against hand computation and closed forms; cached features against computed ones."""

import math

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler
from reach_demos import make_store
from torch import nn
from toy_policies import TimeTable, exact_factors, toy_teacher

from manicm_ms.demos.sequence_dataset import SequenceDataset
from manicm_ms.demos.stats import store_stats
from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.encoders.point_net import DP3Encoder
from manicm_ms.policies.encoders.points import PointSubset, PointSubsetConfig
from manicm_ms.policies.heads.consistency_solver import boundary_scalings
from manicm_ms.policies.heads.diffusion import DiffusionConfig
from manicm_ms.policies.methods import make_policy, student_of
from manicm_ms.spec import ChunkSpec
from manicm_ms.training.features import CLEAN_ACTION, chosen_features, encode_dataset
from manicm_ms.training.objectives.consistency import ConsistencyDistillation, PublicConsistencyDistillation
from manicm_ms.training.objectives.head_loss import AveragedHeadObjective, HeadObjective
from manicm_ms.training.objectives.objective import OBJECTIVES, trained_methods
from manicm_ms.training.optim import PowerDecay
from manicm_ms.training.stream import step_generator, subset_generator

CHUNK = ChunkSpec()


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    with DemoStore.open(make_store(tmp_path_factory.mktemp("data") / "reach.zarr", episodes=3)) as opened:
        yield opened


@pytest.fixture(scope="module")
def windows(store):
    return SequenceDataset.from_store(store, CHUNK)


def small_policy(store, prediction_type="sample", **points):
    config = {
        "inputs": {"points": points, "cloud_frame": {"frame": "tcp"}},
        "backbone": {"down_dims": (16, 32)},
        "head": {"prediction_type": prediction_type},
    }
    return make_policy("simple_dp3", store.spec, CHUNK, config, stats=store_stats(store), seed=0)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("prediction_type", ["sample", "epsilon"])
def test_diffusion_loss_equals_hand_computation(store, windows, prediction_type):
    """Noise and times are drawn again from the same generator; noising is done by diffusers."""
    policy = small_policy(store, prediction_type)
    batch = windows.batch(torch.arange(8))
    loss = AveragedHeadObjective(policy, PowerDecay())(batch, generator())
    draws = generator()
    epsilon = torch.randn(8, 4, 3, generator=draws)
    t = torch.randint(100, (8,), generator=draws)
    low, high = windows.action.amin(0), windows.action.amax(0)
    x0 = 2 * (batch["action"] - low) / (high - low) - 1
    x_t = DDPMScheduler(100, beta_schedule="squaredcos_cap_v2").add_noise(x0, epsilon, t)
    output = policy.head.denoise(x_t, t, policy.encode(batch))
    expected = (output - (x0 if prediction_type == "sample" else epsilon)).pow(2).sum() / (8 * 4 * 3)
    torch.testing.assert_close(loss, expected)


def test_diffusion_objective_reads_only_the_drawn_points(store, windows):
    policy = small_policy(store, max_points=16)
    objective = AveragedHeadObjective(policy, PowerDecay())
    batch = windows.batch(torch.arange(8))
    chosen = torch.randperm(64, generator=generator())[:16]
    spoiled = batch["point_cloud"].clone()
    spoiled[:, :, [i for i in range(64) if i not in chosen.tolist()]] = math.nan
    assert torch.isfinite(objective(batch | {"point_cloud": spoiled}, generator()))


def test_outcome_of_a_teacher_is_its_average(store, windows):
    policy = small_policy(store)
    objective = AveragedHeadObjective(policy, PowerDecay(0.75))
    optimizer = torch.optim.SGD(policy.parameters(), lr=0.1)
    name = next(k for k, p in policy.named_parameters() if k.startswith("head.backbone"))
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


def test_a_plain_objective_has_the_same_loss_and_its_outcome_is_the_policy_itself(store, windows):
    policy, batch = small_policy(store, max_points=16), windows.batch(torch.arange(8))
    plain = OBJECTIVES.get("plain")(policy, PowerDecay())
    assert type(plain) is HeadObjective
    assert torch.equal(plain(batch, generator(3)), AveragedHeadObjective(policy, PowerDecay())(batch, generator(3)))
    plain.after_step()
    assert plain.outcome is policy


def test_a_student_learns_from_no_demonstrations_alone(store):
    assert {"dp3", "simple_dp3"} <= set(trained_methods())
    assert "manicm" not in trained_methods()
    with pytest.raises(ConfigError, match="manicm learns from a teacher: train one, and use manicm-ms distill"):
        AveragedHeadObjective(student_of(small_policy(store)), PowerDecay())


def drawn_points(store, batch, count):
    """Return the batch as a step of training reads `count` of its points."""
    return PointSubset(PointSubsetConfig(max_points=count), store.spec).read_training(batch, generator())


def test_drawn_points_are_distinct_points_of_the_cloud(store, windows):
    batch = windows.batch(torch.arange(5))
    drawn = drawn_points(store, batch, 20)["point_cloud"]
    assert drawn.shape == (5, 2, 20, 3)
    for cloud, subset in zip(batch["point_cloud"].flatten(0, 1), drawn.flatten(0, 1), strict=True):
        matches = (subset[:, None] == cloud[None]).all(-1)
        assert matches.any(1).all()
        assert matches.any(0).sum() == 20
    for all_of_them in (64, None):
        assert torch.equal(drawn_points(store, batch, all_of_them)["point_cloud"], batch["point_cloud"])


def test_cached_features_equal_computed_ones(store, windows):
    policy = small_policy(store)
    features = encode_dataset(policy, windows, draws=4, seed=0)
    everything = torch.arange(len(windows))
    assert features.features["cond"].shape == (len(windows), 1, 256)
    picked = torch.tensor([5, 0, 35])
    batch = windows.batch(picked)
    torch.testing.assert_close(features.batch(picked)["cond"][:, 0], policy.encode(batch).cond)
    torch.testing.assert_close(
        policy.normalizer.unnormalize("action", features.batch(everything)[CLEAN_ACTION]),
        windows.batch(everything)["action"],
    )


def test_first_cached_subset_is_what_the_policy_reads_when_acting(store, windows):
    policy = small_policy(store, max_points=16)
    features = encode_dataset(policy, windows, draws=3, seed=0).features["cond"]
    acting = policy.encode(windows.batch(torch.arange(len(windows)))).cond
    assert features.shape[1] == 3
    torch.testing.assert_close(features[:, 0], acting)
    assert not torch.allclose(features[:, 1], features[:, 2])


@pytest.mark.parametrize(
    ("acting", "training", "subsets", "prefixes"),
    [("prefix", "random", 3, 1), ("random", "random", 3, 0), ("prefix", "prefix", 1, 1), ("random", "prefix", 3, 2)],
)
def test_cached_subsets_follow_the_two_choices_of_points(store, windows, acting, training, subsets, prefixes):
    policy = small_policy(store, max_points=16, acting=acting, training=training)
    features = encode_dataset(policy, windows, draws=3, seed=0).features["cond"]
    everything = windows.batch(torch.arange(len(windows)))
    prefix = policy.encode(everything | {"point_cloud": everything["point_cloud"][:, :, :16]}).cond
    assert features.shape[1] == subsets
    assert sum(torch.allclose(features[:, k], prefix) for k in range(subsets)) == prefixes


def test_diffusion_objective_reads_the_prefix_where_it_is_told_to(store, windows):
    policy = small_policy(store, max_points=16, training="prefix")
    batch = windows.batch(torch.arange(8))
    spoiled = batch["point_cloud"].clone()
    spoiled[:, :, 16:] = math.nan
    objective = AveragedHeadObjective(policy, PowerDecay())
    assert torch.isfinite(objective(batch | {"point_cloud": spoiled}, generator()))


SIGMA = 0.2  # standard deviation of the toy's actions, small enough that the teacher's x0 is not clipped


def gaussian_case(objective_type, scale=1.0):
    """Return the objective for actions N(0, SIGMA^2), with the exact teacher and the student times `scale`.

    The teacher is E[x0 | x_t] = sqrt(abar) SIGMA^2 / (abar SIGMA^2 + 1 - abar) x_t. One DDIM step multiplies
    x by a number, so that the exact consistency function multiplies by the product of these down to 0.
    """
    abar, posterior = DiffusionConfig().ddpm().alphas_cumprod.double(), exact_factors(SIGMA)
    consistent = torch.zeros(100, dtype=torch.float64)
    product, previous = 1.0, torch.tensor(1.0, dtype=torch.float64)
    for t in range(9, 100, 10):
        a, m = abar[t], posterior[t]
        product *= float(previous.sqrt() * m + (1 - previous).sqrt() * (1 - a.sqrt() * m) / (1 - a).sqrt())
        previous, consistent[t] = a, product
    c_skip, c_out = boundary_scalings(torch.arange(100))
    network = torch.where(consistent > 0, (scale * consistent - c_skip) / c_out.clamp_min(1e-9), 0.0)
    teacher = toy_teacher(TimeTable(posterior))
    student = student_of(teacher)
    student.head.backbone.factors.data.copy_(network)
    return objective_type(teacher, student, ema_decay=0.95), consistent


def gaussian_batch(rows, seed=0):
    x0 = SIGMA * torch.randn(rows, 1, 1, generator=generator(seed))
    return {CLEAN_ACTION: x0, "cond": torch.zeros(rows, 1, 1)}


def test_exact_consistency_function_has_no_loss_and_no_gradient():
    objective, _ = gaussian_case(ConsistencyDistillation)
    loss = objective(gaussian_batch(512), generator())
    loss.backward()
    assert loss.item() < 1e-10
    assert objective.student.head.backbone.factors.grad.abs().max() < 1e-6


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
        learned = objective.student.head.consistency_function(x, torch.tensor([t]), Features(x[0])).item()
        assert learned == pytest.approx(float(consistent[t]), abs=0.03)


def test_only_the_unet_of_the_student_is_trained(store, windows):
    teacher = small_policy(store)
    objective = ConsistencyDistillation(teacher, student_of(teacher), ema_decay=0.95)
    trained = {k for k, p in objective.named_parameters() if p.requires_grad}
    assert trained
    assert all(k.startswith("student.head.backbone.") for k in trained)
    features = encode_dataset(teacher, windows, 1, 0)
    objective(features.batch(torch.arange(8)), generator()).backward()
    assert all(objective.get_parameter(k).grad is not None for k in trained)


class NoisyTable(TimeTable):
    """A network with a layer that behaves otherwise in training."""

    def __init__(self, factors):
        super().__init__(factors)
        self.layers = nn.Sequential(nn.Linear(1, 1), nn.Dropout(0.5))


class NoisyEncoder(DP3Encoder):
    """An encoder with such a layer."""

    def __init__(self, config, spec, chunk):
        super().__init__(config, spec, chunk)
        self.layers = nn.Sequential(nn.Linear(1, 1), nn.Dropout(0.5))


def test_training_switches_only_what_is_trained():
    teacher = toy_teacher(NoisyTable(torch.ones(100)), encoder=NoisyEncoder).eval()
    student = student_of(toy_teacher(NoisyTable(torch.ones(100)), encoder=NoisyEncoder))
    learning = AveragedHeadObjective(teacher, PowerDecay()).train()
    assert all(m.training for m in learning.policy.modules())
    assert not any(m.training for m in learning.average.modules())
    distilling = ConsistencyDistillation(teacher, student, ema_decay=0.95).train()
    frozen = (distilling.teacher, distilling.target, distilling.student.encoder)
    assert not any(m.training for part in frozen for m in part.modules())
    assert all(m.training for m in distilling.student.head.backbone.modules())
    assert not any(m.training for m in distilling.eval().modules())


def test_encoded_subsets_are_not_those_of_the_first_training_step(store, windows):
    policy = small_policy(store, max_points=16)
    features = encode_dataset(policy, windows, draws=2, seed=0).features["cond"][:, 1]
    everything = windows.batch(torch.arange(len(windows)))
    shared = policy.encode_training(everything, step_generator(0, 0, 0, "cpu")).cond
    own = policy.encode_training(everything, subset_generator(0, 0, "cpu")).cond
    torch.testing.assert_close(features, own)
    assert not torch.allclose(features, shared)


def test_each_row_sees_one_of_its_subsets(store, windows):
    """All subsets but the one that a row draws are spoiled, and the loss is finite."""
    teacher = small_policy(store, max_points=16)
    objective = ConsistencyDistillation(teacher, student_of(teacher), ema_decay=0.95)
    features = encode_dataset(teacher, windows, draws=3, seed=0)
    batch = features.batch(torch.arange(30))
    picked = torch.randint(3, (30,), generator=generator())
    spoiled = batch["cond"].clone()
    spoiled[picked[:, None] != torch.arange(3)] = math.nan
    assert len(set(np.unique(picked))) == 3
    assert torch.isfinite(objective(batch | {"cond": spoiled}, generator()))


def test_tokens_are_cached_for_a_head_that_reads_them_and_chosen_with_their_vector(store, windows):
    policy = small_policy(store, max_points=16)
    assert set(encode_dataset(policy, windows, draws=3, seed=0).features) == {"cond"}
    policy.head.reads = ("cond", "tokens")
    features = encode_dataset(policy, windows, draws=3, seed=0)
    assert features.features["tokens"].shape == (len(windows), 3, 2, 128)
    chosen = chosen_features(features.batch(torch.arange(30)), generator())
    picked = torch.randint(3, (30,), generator=generator())
    assert torch.equal(chosen.cond, features.features["cond"][torch.arange(30), picked])
    assert torch.equal(chosen.tokens.flatten(1), chosen.cond)
