import pytest
import torch
from diffusers import DDIMScheduler

from manicm_ms.errors import ConfigError
from manicm_ms.policies.heads.consistency_solver import (
    CorrectedSolver,
    PublicSolver,
    boundary_scalings,
    consistency_pair,
    ddim_step,
    solver_timesteps,
)
from manicm_ms.policies.heads.diffusion import DiffusionConfig, Guess, epsilon_from_x0

ABAR = DiffusionConfig().ddpm().alphas_cumprod


def points(batch=10, seed=0):
    g = torch.Generator().manual_seed(seed)
    x0, epsilon = torch.rand(batch, 4, 3, generator=g) * 2 - 1, torch.randn(batch, 4, 3, generator=g)
    return x0, epsilon, torch.arange(batch) % 10


def noisy(x0, epsilon, alpha_bar):
    alpha_bar = alpha_bar[:, None, None]
    return alpha_bar.sqrt() * x0 + (1 - alpha_bar).sqrt() * epsilon


def test_at_time_zero_the_function_is_the_identity():
    c_skip, c_out = boundary_scalings(torch.tensor([0]))
    assert (c_skip.item(), c_out.item()) == (1.0, 0.0)


def test_scalings_are_those_of_the_paper():
    t = torch.tensor([1, 9, 99])
    c_skip, c_out = boundary_scalings(t)
    expected_skip = [0.25 / (100 * n * n + 0.25) for n in (1, 9, 99)]
    expected_out = [10 * n / (100 * n * n + 0.25) ** 0.5 for n in (1, 9, 99)]
    torch.testing.assert_close(c_skip, torch.tensor(expected_skip))
    torch.testing.assert_close(c_out, torch.tensor(expected_out))


def test_grid_ends_at_the_noisiest_time():
    assert solver_timesteps(100, 10).tolist() == [9, 19, 29, 39, 49, 59, 69, 79, 89, 99]
    assert solver_timesteps(1000, 50).tolist()[-1] == 999
    with pytest.raises(ConfigError, match="must divide"):
        solver_timesteps(100, 7)


def test_leading_grid_holds_the_times_of_the_teacher_s_sampler_but_for_zero():
    sampler = DiffusionConfig().ddim(10).timesteps.tolist()
    assert solver_timesteps(100, 10, "leading").flip(0).tolist() == [t for t in sampler if t > 0]
    solver = CorrectedSolver(ABAR, timestep_spacing="leading")
    assert solver.timesteps_prev.tolist() == [0, *range(10, 90, 10)]
    assert solver.alpha_bar_prev[0] == 1.0
    with pytest.raises(ConfigError, match="at least 2"):
        solver_timesteps(100, 1, "leading")


def test_the_step_moves_along_the_path_of_a_known_noise():
    x0, epsilon, index = points()
    solver = CorrectedSolver(ABAR)
    x_t = noisy(x0, epsilon, solver.alpha_bar[index])
    expected = noisy(x0, epsilon, solver.alpha_bar_prev[index])
    guess = Guess(x0, epsilon_from_x0(x_t, x0, solver.alpha_bar[index][:, None, None]))
    torch.testing.assert_close(solver.previous(guess, index), expected, rtol=1e-4, atol=1e-4)


def test_the_first_grid_point_steps_to_the_clean_action():
    x0, epsilon, index = points()
    solver = CorrectedSolver(ABAR)
    assert solver.timesteps_prev[0] == 0
    torch.testing.assert_close(solver.previous(Guess(x0, epsilon), index)[:1], x0[:1], rtol=0, atol=0)


def test_the_step_is_diffusers_ddim_on_trailing_times():
    scheduler = DDIMScheduler(
        num_train_timesteps=100,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="sample",
        clip_sample=False,
        set_alpha_to_one=True,
        timestep_spacing="trailing",
    )
    scheduler.set_timesteps(10)
    assert scheduler.timesteps.tolist() == solver_timesteps(100, 10).flip(0).tolist()
    x_t, x0, index = points(seed=3)
    solver = CorrectedSolver(ABAR)
    epsilon = epsilon_from_x0(x_t, x0, solver.alpha_bar[index][:, None, None])
    got = solver.previous(Guess(x0, epsilon), index)
    for row in range(10):
        expected = scheduler.step(x0[row], int(scheduler.timesteps[9 - index[row]]), x_t[row]).prev_sample
        torch.testing.assert_close(got[row], expected, rtol=1e-5, atol=1e-5)


def test_the_public_step_is_the_same_formula_with_the_action_in_place_of_the_noise():
    x0, epsilon, index = points()
    solver = PublicSolver(ABAR)
    a = solver.alpha_bar_prev[index][:, None, None]
    torch.testing.assert_close(solver.previous(Guess(x0, epsilon), index), a.sqrt() * x0 + (1 - a).sqrt() * x0)
    assert solver.alpha_bar_prev[0] == ABAR[0]
    public = solver.previous(Guess(x0, epsilon), index)
    torch.testing.assert_close(public, solver.previous(Guess(x0, epsilon + 1), index))
    corrected = CorrectedSolver(ABAR).previous(Guess(x0, epsilon), index)
    assert (corrected - public)[1:].abs().amax((1, 2)).min() > 0.1


def test_one_long_step_equals_two_short_ones_while_the_guess_stays():
    x_t, x0, _ = points()
    a, b, c = (torch.tensor(v) for v in (0.1, 0.5, 0.9))

    def step(x, source, target):
        return ddim_step(Guess(x0, epsilon_from_x0(x, x0, source)), target)

    torch.testing.assert_close(step(step(x_t, a, b), b, c), step(x_t, a, c), rtol=1e-4, atol=1e-4)


def test_the_pair_compares_both_ends_of_the_step_and_only_one_has_a_gradient():
    x0, epsilon, index = points()
    solver, seen = CorrectedSolver(ABAR), {}
    x_t = noisy(x0, epsilon, solver.alpha_bar[index])
    gain = torch.tensor(2.0, requires_grad=True)

    def student(name):
        def f(x, t):
            seen[name] = (x, t)
            return gain * x

        return f

    guess = Guess(x0, epsilon)
    prediction, wanted = consistency_pair(solver, lambda x, t: guess, student("online"), student("target"), x_t, index)
    assert torch.equal(seen["online"][1], solver.timesteps[index])
    assert torch.equal(seen["target"][1], solver.timesteps_prev[index])
    torch.testing.assert_close(seen["target"][0], solver.previous(guess, index))
    assert prediction.requires_grad
    assert not wanted.requires_grad


def test_an_exactly_consistent_student_has_no_loss():
    """For a single clean action a the consistency function is f = a, but f(x, 0) = x by the boundary condition."""
    a = torch.tensor([0.3, -0.7, 0.1]).expand(10, 4, 3)
    _, epsilon, index = points()
    solver = CorrectedSolver(ABAR)
    x_t = noisy(a, epsilon, solver.alpha_bar[index])

    def exact(x, t):
        return torch.where(t[:, None, None] == 0, x, a)

    prediction, wanted = consistency_pair(solver, lambda x, t: Guess(a, epsilon), exact, exact, x_t, index)
    torch.testing.assert_close(prediction, wanted, rtol=0, atol=1e-6)
