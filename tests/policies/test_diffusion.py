import pytest
import torch
from diffusers import DDIMScheduler, DDPMScheduler
from policy_specs import CHUNK, TINY, make_obs, make_spec, wobble

from manicm_ms.demos.stats import FieldStats
from manicm_ms.errors import ConfigError
from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.heads.consistency_solver import CorrectedSolver
from manicm_ms.policies.heads.diffusion import PREDICTIONS, DiffusionConfig, epsilon_from_x0, x0_from_epsilon
from manicm_ms.policies.methods import make_policy


def teacher(prediction_type="sample", seed=0, spec=None):
    config = TINY | {"head": {"prediction_type": prediction_type}}
    policy = make_policy("simple_dp3", spec or make_spec(), CHUNK, config, seed=seed)
    wobble(policy.head.backbone)
    return policy


def arrays(batch=6, seed=0):
    g = torch.Generator().manual_seed(seed)
    x0, epsilon = torch.rand(batch, 4, 3, generator=g) * 2 - 1, torch.randn(batch, 4, 3, generator=g)
    return x0, epsilon, torch.tensor([0, 5, 40, 70, 90, 95])[:batch]


def diffusers_process(**changes):
    return DDPMScheduler(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", **changes)


def test_noising_is_diffusers():
    x0, epsilon, t = arrays()
    expected = diffusers_process().add_noise(x0, epsilon, t)
    torch.testing.assert_close(teacher().head.add_noise(x0, epsilon, t), expected)


def test_clean_action_and_noise_convert_into_each_other():
    x0, epsilon, t = arrays()
    alpha_bar = diffusers_process().alphas_cumprod[t][:, None, None].double()
    x0, epsilon = x0.double(), epsilon.double()
    x_t = alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * epsilon
    torch.testing.assert_close(epsilon_from_x0(x_t, x0, alpha_bar), epsilon)
    torch.testing.assert_close(x0_from_epsilon(x_t, epsilon, alpha_bar), x0)
    guess = torch.randn(x0.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    torch.testing.assert_close(x0_from_epsilon(x_t, epsilon_from_x0(x_t, guess, alpha_bar), alpha_bar), guess)


@pytest.mark.parametrize("prediction_type", ["sample", "epsilon"])
def test_conversion_equals_diffusers(prediction_type):
    x_t, output, t = arrays(seed=2)
    scheduler = DDIMScheduler(
        num_train_timesteps=100,
        beta_schedule="squaredcos_cap_v2",
        prediction_type=prediction_type,
        clip_sample=False,
    )
    scheduler.set_timesteps(10)
    for row, step in enumerate(t.tolist()):
        expected = scheduler.step(output[row], step, x_t[row]).pred_original_sample
        got = PREDICTIONS.get(prediction_type)().x0(output[row], x_t[row], scheduler.alphas_cumprod[step])
        torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("prediction_type", ["sample", "epsilon"])
def test_the_trained_target_is_what_x0_is_read_from(prediction_type):
    x0, epsilon, t = arrays()
    head = teacher(prediction_type).head
    x_t = head.add_noise(x0, epsilon, t)
    perfect = head.prediction.target(x0, epsilon)
    got = head.prediction.x0(perfect, x_t, head.alphas_cumprod[t][:, None, None])
    torch.testing.assert_close(got, x0, rtol=1e-3, atol=1e-3)


def ddim_by_hand(head, features, noise, steps):
    """DDIM written out: x0 clipped, epsilon implied by it, the last step ends at the clean action."""
    alpha_bar, stride = diffusers_process().alphas_cumprod.double(), 100 // steps
    x = noise.double()
    for t in range((steps - 1) * stride, -1, -stride):
        a, b = alpha_bar[t], alpha_bar[t - stride] if t >= stride else torch.tensor(1.0, dtype=torch.float64)
        output = head.denoise(x.float(), torch.full((len(x),), t), features).double()
        epsilon_predicted = head.config.prediction_type == "epsilon"
        x0 = ((x - (1 - a).sqrt() * output) / a.sqrt() if epsilon_predicted else output).clamp(-1, 1)
        # diffusers keeps the network's own epsilon after clipping x0
        epsilon = output if epsilon_predicted else (x - a.sqrt() * output) / (1 - a).sqrt()
        x = b.sqrt() * x0 + (1 - b).sqrt() * epsilon
    return x.float()


@pytest.mark.parametrize("prediction_type", ["sample", "epsilon"])
@pytest.mark.parametrize("steps", [10, 5, 4])
def test_sampling_is_ddim(prediction_type, steps):
    policy = teacher(prediction_type)
    head, features = policy.head, policy.encode(make_obs(policy.spec, 5))
    noise = torch.randn(5, 4, 3, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        got, expected = head.with_nfe(steps).sample(features, noise), ddim_by_hand(head, features, noise, steps)
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-4)


def test_sampling_equals_diffusers_own_scheduler():
    policy = teacher()
    features = policy.encode(make_obs(policy.spec, 5))
    noise = torch.randn(5, 4, 3, generator=torch.Generator().manual_seed(3))
    scheduler = DDIMScheduler(
        num_train_timesteps=100,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="sample",
        clip_sample=True,
        set_alpha_to_one=True,
    )
    scheduler.set_timesteps(10)
    assert scheduler.timesteps.tolist() == list(range(90, -1, -10))
    x = noise
    with torch.no_grad():
        for t in scheduler.timesteps:
            x = scheduler.step(policy.head.denoise(x, t.repeat(5), features), t, x).prev_sample
        torch.testing.assert_close(policy.head.sample(features, noise), x, rtol=0, atol=0)


class Counted:
    """Notes the times of each call of a policy's network."""

    def __init__(self, policy):
        self.times = []
        policy.head.backbone.register_forward_pre_hook(self.note)

    def note(self, module, inputs):
        self.times.append([t.tolist() for t in inputs[1]])


def test_nfe_is_the_number_of_network_calls():
    policy = teacher()
    counted = Counted(policy)
    policy.act(make_obs(policy.spec, 1))
    assert policy.nfe == len(counted.times) == 10
    counted.times.clear()
    four = policy.with_head(policy.head.with_nfe(4))
    four.act(make_obs(policy.spec, 1))
    assert four.nfe == 4
    assert counted.times == [[[75]], [[50]], [[25]], [[0]]]


def test_the_control_asks_the_teacher_once_at_its_last_time():
    policy = teacher()
    counted, control = Counted(policy), policy.one_step()
    obs, noise = make_obs(policy.spec, 2), torch.randn(2, 4, 3)
    action = control.act(obs, noise=noise)
    assert control.nfe == 1
    assert counted.times == [[[99, 99]]]
    with torch.no_grad():
        x0 = policy.head.denoise(noise, torch.tensor([99, 99]), policy.encode(obs))
    torch.testing.assert_close(action, x0[:, 1:4].clamp(-1, 1))  # the identity normaliser


def test_the_control_of_an_epsilon_teacher_reads_noise_where_the_sampler_begins():
    """At time 99 its error would be multiplied by 2029, and every action would lie on a limit."""
    policy = teacher("epsilon")
    counted, control = Counted(policy), policy.one_step()
    obs, noise = make_obs(policy.spec, 2), torch.randn(2, 4, 3)
    action = control.act(obs, noise=noise)
    assert counted.times == [[[90, 90]]]
    a = diffusers_process().alphas_cumprod[90]
    with torch.no_grad():
        output = policy.head.denoise(noise, torch.tensor([90, 90]), policy.encode(obs))
    x0 = (noise - (1 - a).sqrt() * output) / a.sqrt()
    torch.testing.assert_close(action, x0[:, 1:4].clamp(-1, 1), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("prediction_type", ["sample", "epsilon"])
@pytest.mark.parametrize("spacing", ["leading", "trailing"])
def test_the_distilled_path_is_the_sampled_path_where_clipping_acts(prediction_type, spacing):
    """Diffusers' DDIM step with the network's outputs, several times the limit: x0 is clipped, epsilon is not."""
    policy = teacher(prediction_type)
    head, last = policy.head, policy.head.backbone.head[-1]
    with torch.no_grad():
        last.weight.mul_(4.0)
        last.bias.mul_(4.0)
    scheduler = DDIMScheduler(
        num_train_timesteps=100,
        beta_schedule="squaredcos_cap_v2",
        prediction_type=prediction_type,
        clip_sample=True,
        set_alpha_to_one=True,
        timestep_spacing=spacing,
    )
    scheduler.set_timesteps(10)
    solver = CorrectedSolver(head.alphas_cumprod, timestep_spacing=spacing)
    features = policy.encode(make_obs(policy.spec, 5))
    x, beyond = torch.randn(5, 4, 3, generator=torch.Generator().manual_seed(3)), 0
    with torch.no_grad():
        for index in reversed(range(len(solver))):
            t = solver.timesteps[index].repeat(5)
            output = head.denoise(x, t, features)
            step = scheduler.step(output, int(t[0]), x)
            beyond += int((step.pred_original_sample.abs() == 1).sum())
            got = solver.previous(head.guess(x, t, features), torch.full((5,), index))
            # from time 10 the leading grid goes to the clean action, diffusers to time 0
            expected = step.pred_original_sample if index == 0 else step.prev_sample
            torch.testing.assert_close(got, expected, rtol=1e-6, atol=1e-6)
            x = got
    assert beyond > 20


@pytest.mark.parametrize("wrap", [lambda p: p, ActionPolicy.one_step])
def test_actions_follow_the_generator_and_the_noise(wrap):
    policy = wrap(teacher())
    obs = make_obs(policy.spec, 3)

    def act(seed):
        return policy.act(obs, generator=torch.Generator().manual_seed(seed))

    assert torch.equal(act(1), act(1))
    assert not torch.equal(act(1), act(2))
    noise = torch.randn(3, 4, 3, generator=torch.Generator().manual_seed(1))
    assert torch.equal(policy.act(obs, noise=noise), act(1))
    with pytest.raises(ConfigError, match="noise has shape"):
        policy.act(obs, noise=noise[:, :3])


def test_rows_do_not_depend_on_the_batch():
    policy, noise = teacher(), torch.randn(4, 4, 3)
    obs = make_obs(policy.spec, 4)
    alone = policy.act({k: v[2:3] for k, v in obs.items()}, noise=noise[2:3])
    torch.testing.assert_close(policy.act(obs, noise=noise)[2:3], alone, rtol=1e-4, atol=1e-5)


def test_actions_are_the_executed_part_in_env_units_within_the_limits():
    spec = make_spec()
    policy, noise = teacher(spec=spec), torch.randn(64, 4, 3)
    obs = make_obs(spec, 64)
    with torch.no_grad():
        chunk = policy.head.sample(policy.encode(obs), noise)

    def ranges(size, low, high):
        return FieldStats(*(torch.full((size,), v).numpy() for v in (low, high, 0.0, 1.0)))

    stats = {"point_cloud": ranges(3, -1.0, 1.0), "agent_pos": ranges(5, -1.0, 1.0), "action": ranges(3, -0.5, 2.5)}
    policy.fit_normalizer(stats)
    action = policy.act(obs, noise=noise)
    assert action.shape == (64, 3, 3)
    torch.testing.assert_close(action, (1.0 + 1.5 * chunk[:, 1:4]).clamp(-1, 1), rtol=1e-4, atol=1e-4)
    assert action.max() == 1.0  # the clip is at work


def test_schedulers_are_those_of_the_published_configuration():
    config = DiffusionConfig()
    assert config.ddim(10).config.set_alpha_to_one is True
    assert config.ddim(10).timesteps.tolist() == [90, 80, 70, 60, 50, 40, 30, 20, 10, 0]
    torch.testing.assert_close(config.ddpm().alphas_cumprod, diffusers_process().alphas_cumprod)
