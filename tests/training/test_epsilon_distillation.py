"""A teacher that predicts noise can be distilled: on Gaussian actions, whose exact teachers of both kinds are known.

For actions N(0, SIGMA^2) the perfect network is a number for each time, so that teachers of both kinds are exact, and
each has the same path.
"""

import pytest
import torch
from toy_policies import TimeTable, exact_factors, toy_teacher

from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.methods import student_of
from manicm_ms.training.features import CLEAN_ACTION
from manicm_ms.training.objectives.consistency import ConsistencyDistillation

SIGMA = 0.2  # small enough that the exact x0 is seldom clipped
KINDS = ("sample", "epsilon")


def exact_teacher(kind):
    """Return the teacher E[x0 | x_t], or E[epsilon | x_t], of the Gaussian."""
    return toy_teacher(TimeTable(exact_factors(SIGMA, kind)), kind)


def objective_of(kind, error=0.0):
    """Return the distillation of the exact teacher; the student's factors are off by random numbers of size `error`."""
    teacher = exact_teacher(kind)
    student = student_of(teacher)
    off = error * torch.randn(100, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        student.head.backbone.factors += off
    return ConsistencyDistillation(teacher, student, ema_decay=0.95)


def batch(rows, seed=0):
    x0 = SIGMA * torch.randn(rows, 1, 1, generator=torch.Generator().manual_seed(seed))
    return {CLEAN_ACTION: x0, "cond": torch.zeros(rows, 1, 1)}


def loss_of(objective):
    return objective(batch(4096), torch.Generator().manual_seed(1))


def test_one_error_of_the_network_costs_an_epsilon_student_as_much_as_another_within_an_order():
    """It was 1e8 times as much: at time 99 the error of epsilon is multiplied by 2029, and squared."""
    sample, epsilon = (loss_of(objective_of(kind, error=0.05)).item() for kind in KINDS)
    assert sample > 1e-4
    assert epsilon < 30 * sample
    assert epsilon < 0.1


def test_the_gradient_of_an_epsilon_student_is_of_the_order_of_the_other_s():
    norms = {}
    for kind in KINDS:
        objective = objective_of(kind, error=0.05)
        loss_of(objective).backward()
        norms[kind] = float(objective.student.head.backbone.factors.grad.norm())
    assert norms["epsilon"] < 30 * norms["sample"]


def played(policy, noise):
    return policy.head.act(Features(torch.zeros(len(noise), 1)), (noise,), None)[0]


@pytest.mark.parametrize("kind", KINDS)
def test_the_student_learns_to_act_as_its_teacher_from_the_same_noise(kind):
    objective = objective_of(kind)
    optimizer = torch.optim.Adam([p for p in objective.parameters() if p.requires_grad], lr=5e-3)
    for step in range(500):
        optimizer.zero_grad()
        objective(batch(128, step), torch.Generator().manual_seed(step)).backward()
        optimizer.step()
        objective.after_step()
    noise = torch.randn(1000, 1, 1, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        teacher, student = played(objective.teacher, noise), played(objective.student, noise)
    assert (student - teacher).pow(2).mean().sqrt() < 0.15 * teacher.std()


def test_one_step_of_an_epsilon_teacher_is_its_guess_and_not_a_limit():
    teacher = exact_teacher("epsilon")
    noise = torch.randn(1000, 1, 1, generator=torch.Generator().manual_seed(2))
    obs = {"point_cloud": torch.zeros(1000, 1, 64, 3), "agent_pos": torch.zeros(1000, 1, 4)}
    action = teacher.one_step().act(obs, noise=noise)
    a = teacher.head.alphas_cumprod[90]
    torch.testing.assert_close(action, a.sqrt() * SIGMA**2 / (a * SIGMA**2 + 1 - a) * noise, rtol=1e-3, atol=1e-4)
