"""Optimizer, learning-rate schedule and averaged weights, put together from libraries."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from diffusers.optimization import get_scheduler
from torch import Tensor, nn
from torch.optim import AdamW
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import AveragedModel

from manicm_ms.errors import ConfigError, require_at_least

MOST_STEPS = 10**9
"""Steps, or epochs, of a training: more is a slip of the keyboard."""


@dataclass(frozen=True, kw_only=True)
class FitConfig:
    """How long and with what optimizer to train; the loop reads nothing else of a preset.

    Attributes:
        steps: optimizer steps, or None where `epochs` says how long.
        epochs: passes over the windows, converted to steps when the data set is known, or None.
        batch_size: B, windows of a step, over all devices.
        learning_rate: after warm-up; a cosine brings it to 0 at the last step.
        warmup_steps: steps over which the learning rate rises linearly from 0.
        betas: AdamW's; (0.95, 0.999) as diffusion_policy and DP3 have it.
        weight_decay: AdamW's.
        clip_norm: largest 2-norm of the gradient, or None for no clipping.
        threads: CPU threads of the tensor library while training. One is the default: the products of a small
            network gain little from more, lose much where cores are shared, and the bits of the result would
            depend on the number of cores.
        log_every: steps between lines of the log; also how often the loss is checked for NaN.
        save_every: steps between saved training states, which is what a kill can cost.
    """

    steps: int | None = None
    epochs: int | None = None
    batch_size: int = 64
    learning_rate: float = 1e-3
    warmup_steps: int = 100
    betas: tuple[float, float] = (0.95, 0.999)
    weight_decay: float = 1e-6
    clip_norm: float | None = 1.0
    threads: int = 1
    log_every: int = 10
    save_every: int = 250

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.epochs is None):
            raise ConfigError(f"give steps or epochs, one of the two: got steps={self.steps}, epochs={self.epochs}")
        length = {"epochs": self.epochs} if self.steps is None else {"steps": self.steps}
        require_at_least(1, **length, batch_size=self.batch_size, threads=self.threads)
        if (self.steps or self.epochs or 0) > MOST_STEPS:
            raise ConfigError(f"{next(iter(length))} must be at most {MOST_STEPS}, got {self.steps or self.epochs}")
        require_at_least(1, log_every=self.log_every, save_every=self.save_every)
        if self.warmup_steps < 0 or self.learning_rate <= 0 or self.weight_decay < 0:
            raise ConfigError("learning_rate must be positive, warmup_steps and weight_decay not negative")
        if self.steps is not None and self.warmup_steps >= self.steps:
            raise ConfigError(f"warmup_steps={self.warmup_steps} leaves nothing of steps={self.steps}: lower it")
        if self.clip_norm is not None and self.clip_norm <= 0:
            raise ConfigError(f"clip_norm must be positive or None, got {self.clip_norm}")

    def total_steps(self, size: int) -> int:
        """Return the steps that `size` windows are trained for."""
        if self.steps is not None:
            return self.steps
        assert self.epochs is not None
        return math.ceil(self.epochs * size / self.batch_size)


def build_optimizer(parameters: Iterable[nn.Parameter], config: FitConfig, *, fused: bool = True) -> AdamW:
    """Return AdamW over `parameters`; `fused` must be off where a gradient scaler is used (float16)."""
    return AdamW(
        list(parameters), lr=config.learning_rate, betas=config.betas, weight_decay=config.weight_decay, fused=fused
    )


def build_scheduler(optimizer: torch.optim.Optimizer, config: FitConfig, steps: int) -> LambdaLR:
    """Return linear warm-up and then half a cosine down to 0 at `steps`."""
    return get_scheduler(
        "cosine", optimizer, num_warmup_steps=min(config.warmup_steps, steps), num_training_steps=steps
    )


Tensors = tuple[Tensor, ...] | list[Tensor]

DecayRule = Callable[[int], float]
"""Number of averages taken before -> share of the old average that is kept, in [0, 1]."""


@dataclass(frozen=True)
class ConstantDecay:
    """Keep a share of the old average: theta' <- d theta' + (1 - d) theta (target network of Song et al. 2023).

    Attributes:
        ema_decay: d, in [0, 1).
    """

    ema_decay: float = 0.95

    def __post_init__(self) -> None:
        if not 0 <= self.ema_decay < 1:
            raise ConfigError(f"the decay of an average must lie in [0, 1), got {self.ema_decay}")

    def __call__(self, count: int) -> float:
        """Return `ema_decay`."""
        return self.ema_decay


@dataclass(frozen=True)
class PowerDecay:
    """Keep 1 - (1 + n)^-power of the old average after n averages, as diffusion_policy does for its teachers.

    Attributes:
        power: 0.75 reaches a decay of 0.99 after 460 steps, 0.999 after 10,000.
        max_decay: never more than this.
    """

    power: float = 0.75
    max_decay: float = 0.9999

    def __post_init__(self) -> None:
        if self.power <= 0 or not 0 <= self.max_decay < 1:
            raise ConfigError(f"power must be positive and max_decay in [0, 1), got {self.power} and {self.max_decay}")

    def __call__(self, count: int) -> float:
        """Return the decay of average number `count`, counted from 0; the first one is a plain copy."""
        return min(1.0 - (1.0 + count) ** -self.power, self.max_decay)


def averaged(module: nn.Module, rule: DecayRule) -> AveragedModel:
    """Return a running average of `module`'s parameters, starting from a copy of them; buffers are copied.

    `.update_parameters(module)` takes one step, `.module` is the averaged copy; nothing in it asks for a gradient.
    """

    def average(old: Tensors, new: Tensors, count: Tensor | int) -> None:
        torch._foreach_lerp_(old, new, 1.0 - rule(int(count) - 1))

    copy = AveragedModel(module, multi_avg_fn=average)
    copy.n_averaged.fill_(1)  # torch would replace the first average by a plain copy, whatever the rule says
    return copy.requires_grad_(False)
