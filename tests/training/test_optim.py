"""Schedules and averages against closed forms and other libraries."""

import math

import pytest
import torch
import torchvision_oracle  # noqa: F401  diffusers.training_utils imports torchvision
from diffusers.training_utils import EMAModel
from torch import nn

from manicm_ms.errors import ConfigError
from manicm_ms.training.optim import (
    ConstantDecay,
    FitConfig,
    PowerDecay,
    averaged,
    build_optimizer,
    build_scheduler,
)


def test_learning_rate_warms_up_and_follows_a_cosine_to_zero():
    config = FitConfig(steps=50, learning_rate=2e-3, warmup_steps=10)
    optimizer = build_optimizer([nn.Parameter(torch.zeros(1))], config)
    scheduler = build_scheduler(optimizer, config, 50)
    rates = []
    for _ in range(50):
        rates.append(scheduler.get_last_lr()[0])
        optimizer.step()
        scheduler.step()
    rising = [2e-3 * k / 10 for k in range(10)]
    falling = [2e-3 * 0.5 * (1 + math.cos(math.pi * k / 40)) for k in range(40)]
    assert rates == pytest.approx(rising + falling)
    assert scheduler.get_last_lr()[0] == pytest.approx(0, abs=1e-12)


def test_optimizer_equals_adamw_by_hand():
    config = FitConfig(steps=5, learning_rate=0.1, betas=(0.9, 0.99), weight_decay=0.05, warmup_steps=0)
    p = nn.Parameter(torch.tensor([1.0, -2.0]))
    optimizer = build_optimizer([p], config)
    theta, m, v = torch.tensor([1.0, -2.0], dtype=torch.float64), 0.0, 0.0
    for k in range(1, 6):
        p.grad = torch.tensor([0.3, -0.1]) * k
        grad = p.grad.double()
        optimizer.step()
        theta = theta * (1 - 0.1 * 0.05)
        m, v = 0.9 * m + 0.1 * grad, 0.99 * v + 0.01 * grad**2
        theta = theta - 0.1 * (m / (1 - 0.9**k)) / ((v / (1 - 0.99**k)).sqrt() + 1e-8)
    torch.testing.assert_close(p.detach().double(), theta, rtol=1e-5, atol=1e-6)


def walk(module, steps):
    """Change the weights step by step; yield after each."""
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        with torch.no_grad():
            for p in module.parameters():
                p += torch.randn(p.shape, generator=generator)
        yield


def test_power_average_equals_that_of_diffusers():
    module = nn.Linear(3, 2)
    ours = averaged(module, PowerDecay(power=0.75, max_decay=0.9))
    theirs = EMAModel(module.parameters(), decay=0.9, use_ema_warmup=True, power=0.75)
    for _ in walk(module, 40):  # the ceiling of 0.9 is reached at 21
        ours.update_parameters(module)
        theirs.step(module.parameters())
        for a, b in zip(ours.module.parameters(), theirs.shadow_params, strict=True):
            torch.testing.assert_close(a, b)


def test_constant_average_is_a_geometric_sum():
    module = nn.Linear(1, 1, bias=False)
    start = module.weight.item()
    ours, kept = averaged(module, ConstantDecay(0.95)), 0.95
    visited = []
    for _ in walk(module, 12):
        ours.update_parameters(module)
        visited.append(module.weight.item())
    expected = kept**12 * start + (1 - kept) * sum(kept ** (11 - k) * visited[k] for k in range(12))
    assert ours.module.weight.item() == pytest.approx(expected, rel=1e-5)


def test_an_average_asks_for_no_gradient_and_shares_no_memory():
    module = nn.Linear(2, 2)
    average = averaged(module, ConstantDecay(0.5))
    assert not any(p.requires_grad for p in average.parameters())
    assert all(p.requires_grad for p in module.parameters())
    before = average.module.weight.clone()
    list(walk(module, 1))
    assert torch.equal(average.module.weight, before)


def test_epochs_become_steps():
    config = FitConfig(epochs=3000, batch_size=128, warmup_steps=500)
    assert config.total_steps(700) == math.ceil(3000 * 700 / 128)
    assert FitConfig(steps=1500).total_steps(700) == 1500


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"steps": 10, "epochs": 1},
        {"steps": 0},
        {"steps": 100, "warmup_steps": 100},
        {"steps": 10**9 + 1},
        {"steps": 200, "batch_size": 0},
        {"steps": 200, "clip_norm": 0.0},
        {"steps": 200, "learning_rate": 0.0},
    ],
)
def test_fields_that_do_not_fit_are_refused(fields):
    with pytest.raises(ConfigError):
        FitConfig(**fields)


@pytest.mark.parametrize("make", [lambda: ConstantDecay(1.0), lambda: PowerDecay(power=0.0)])
def test_decays_out_of_range_are_refused(make):
    with pytest.raises(ConfigError):
        make()
