import pytest
import torch
from diffusers import LCMScheduler
from policy_specs import CHUNK, TINY, make_obs, make_spec, wobble

from manicm_ms.errors import ConfigError
from manicm_ms.policies.methods import make_policy, methods_of, student_of


def student(nfe=1, prediction_type="sample", **consistency):
    config = TINY | {"head": {"prediction_type": prediction_type}}
    teacher = make_policy("simple_dp3", make_spec(), CHUNK, config, seed=0)
    wobble(teacher.head.backbone)
    return student_of(teacher, nfe=nfe, **consistency)


def test_starts_from_a_copy_of_the_teacher():
    teacher = make_policy("dp3", make_spec(), CHUNK, TINY, seed=0)
    teacher.normalizer.action_scale.fill_(3.0)
    pupil = student_of(teacher)
    assert pupil.name in methods_of("student")
    assert pupil.normalizer.action_scale.tolist() == [3.0, 3.0, 3.0]
    pairs = list(zip(teacher.parameters(), pupil.parameters(), strict=True))
    assert all(torch.equal(a, b) and a is not b for a, b in pairs)


@pytest.mark.parametrize("prediction_type", ["sample", "epsilon"])
def test_at_time_zero_the_consistency_function_returns_its_input(prediction_type):
    policy = student(prediction_type=prediction_type)
    x, features = torch.randn(4, 4, 3), policy.encode(make_obs(policy.spec, 4))
    torch.testing.assert_close(policy.head.consistency_function(x, torch.zeros(4, dtype=torch.long), features), x)


@pytest.mark.parametrize(
    ("nfe", "times"), [(1, (99,)), (2, (99, 49)), (4, (99, 79, 49, 29)), (10, tuple(range(99, 0, -10)))]
)
def test_sampling_visits_only_times_of_training(nfe, times):
    assert student(nfe).head.timesteps == times
    assert student(nfe).nfe == student(nfe).noise_draws == nfe


@pytest.mark.parametrize("nfe", range(1, 11))
def test_times_are_those_of_diffusers_lcm(nfe):
    scheduler = LCMScheduler(num_train_timesteps=100, original_inference_steps=10)
    scheduler.set_timesteps(nfe, original_inference_steps=10)
    assert student(nfe).head.timesteps == tuple(scheduler.timesteps.tolist())


def test_student_of_an_epsilon_teacher_starts_where_the_teacher_s_sampler_does():
    assert student(1, "epsilon").head.timesteps == (90,)
    assert student(4, "epsilon").head.timesteps == (90, 70, 50, 30)
    with pytest.raises(ConfigError, match="exceeds the 9 times"):
        student(10, "epsilon")


def test_a_student_from_before_the_spacing_acts_as_it_did():
    policy = student(prediction_type="epsilon", timestep_spacing="trailing")
    config = policy.config_dict()
    config["head"].pop("timestep_spacing")
    assert make_policy("manicm", policy.spec, CHUNK, config).head.timesteps == (99,)


@pytest.mark.parametrize("t", [10, 90])
def test_epsilon_student_is_trained_on_the_clipped_x0_with_the_gradient_of_the_unclipped(t):
    """Doubling the noise sends x0 far beyond the limit; a plain clip would leave no way back."""
    head = student(prediction_type="epsilon").head
    x, epsilon = torch.randn(2, 3, 4, 3, generator=torch.Generator().manual_seed(0))
    a, limit = head.alphas_cumprod[t], 1.0
    output = (2 * epsilon).requires_grad_()
    raw = (x - (1 - a).sqrt() * output) / a.sqrt()
    seen = head.prediction.student_x0(raw, limit)
    assert torch.equal(seen, raw.clamp(-limit, limit))
    assert (raw.abs() > limit).any()
    seen.sum().backward()
    torch.testing.assert_close(output.grad, torch.full_like(output, -float(((1 - a) / a).sqrt())))


@pytest.mark.parametrize("prediction_type", ["sample", "epsilon"])
@pytest.mark.parametrize("nfe", [1, 4])
def test_sampling_equals_diffusers_lcm(nfe, prediction_type):
    policy = student(nfe, prediction_type, timestep_spacing="trailing")
    obs = make_obs(policy.spec, 5)
    scheduler = LCMScheduler(
        num_train_timesteps=100,
        beta_schedule="squaredcos_cap_v2",
        original_inference_steps=10,
        clip_sample=True,
        prediction_type=prediction_type,
        timestep_scaling=10.0,
    )
    scheduler.set_timesteps(nfe, original_inference_steps=10)
    start = torch.randn(5, 4, 3, generator=torch.Generator().manual_seed(7))
    # diffusers draws the noise itself: the same generator gives us what it will draw
    g = torch.Generator().manual_seed(8)
    again = [torch.randn(5, 4, 3, generator=g) for _ in range(nfe - 1)]
    g, x = torch.Generator().manual_seed(8), start
    with torch.no_grad():
        features = policy.encode(obs)
        for t in scheduler.timesteps:
            output = policy.head.backbone(x, (t.repeat(5),), features)
            x = scheduler.step(output, t, x, generator=g).prev_sample
        got = policy.head.sample(features, (start, *again))
    torch.testing.assert_close(got, x, rtol=1e-5, atol=1e-6)
    executed = policy.act(obs, noise=torch.stack([start, *again]))
    torch.testing.assert_close(executed, x[:, 1:4].clamp(-1, 1), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("nfe", [1, 4])
def test_actions_follow_the_generator_and_the_noise(nfe):
    policy = student(nfe)
    obs = make_obs(policy.spec, 3)

    def act(seed):
        return policy.act(obs, generator=torch.Generator().manual_seed(seed))

    assert act(1).shape == (3, 3, 3)
    assert torch.equal(act(1), act(1))
    assert not torch.equal(act(1), act(2))
    g = torch.Generator().manual_seed(1)
    stack = torch.stack([torch.randn(3, 4, 3, generator=g) for _ in range(nfe)])
    assert torch.equal(policy.act(obs, noise=stack), act(1))


def test_a_start_noise_alone_is_completed_from_the_generator():
    policy = student(4)
    obs, start = make_obs(policy.spec, 3), torch.randn(3, 4, 3)

    def act(seed):
        return policy.act(obs, noise=start, generator=torch.Generator().manual_seed(seed))

    assert torch.equal(act(1), act(1))
    assert not torch.equal(act(1), act(2))
    with pytest.raises(ConfigError, match="noise has shape"):
        policy.act(obs, noise=start.expand(3, 3, 4, 3))


def test_the_same_weights_act_with_another_number_of_evaluations():
    policy = student(1)
    four = policy.with_nfe(4)
    assert (policy.nfe, four.nfe) == (1, 4)
    assert four.encoder is policy.encoder
    assert four.normalizer is policy.normalizer
    assert four.head.backbone is policy.head.backbone
    obs, g = make_obs(policy.spec, 2), torch.Generator().manual_seed(0)
    assert not torch.equal(four.act(obs, generator=g), policy.act(obs, generator=g.manual_seed(0)))
    with pytest.raises(ConfigError, match="nfe=11"):
        policy.with_nfe(11)


def test_is_rebuilt_from_its_configuration():
    policy = student(4)
    again = make_policy("manicm", policy.spec, CHUNK, policy.config_dict())
    again.load_state_dict(policy.state_dict())
    obs = make_obs(policy.spec, 2)
    actions = [p.act(obs, generator=torch.Generator().manual_seed(0)) for p in (policy, again)]
    assert torch.equal(*actions)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("nfe", [1, 4])
def test_a_cpu_generator_gives_every_device_the_same_actions(nfe):
    policy, obs = student(nfe), make_obs(make_spec(), 3)
    expected = policy.act(obs, generator=torch.Generator().manual_seed(0))
    policy.to("cuda")
    got = policy.act({k: v.cuda() for k, v in obs.items()}, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(got.cpu(), expected, rtol=1e-3, atol=1e-3)
