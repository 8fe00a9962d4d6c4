"""Wall time of one decision: observation in, action out, measured apart from any rollout."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from manicm_ms.errors import ConfigError, OutputExistsError
from manicm_ms.evaluation.decisions import Decider
from manicm_ms.machine.devices import torch_threads
from manicm_ms.paths import write_json
from manicm_ms.policies.policy import typical_observations


class Latency(NamedTuple):
    """How long one decision takes.

    Attributes:
        median_ms: median wall time, milliseconds.
        p95_ms: 95th percentile, milliseconds.
        n: timed decisions.
        nfe: network evaluations per decision; None where the policy does not say.
        threads: torch's intra-op threads.
        dtype: dtype of the parameters, for example "float32"; "-" where it is no torch module.
        device: "cpu" or the name of the CUDA device.
    """

    median_ms: float
    p95_ms: float
    n: int
    nfe: int | None
    threads: int
    dtype: str
    device: str


def measure_latency(
    policies: Mapping[str, Decider],
    *,
    repetitions: int = 50,
    warmup: int = 5,
    threads: int = 1,
    seed: int = 0,
) -> dict[str, Latency]:
    """Time one decision of each policy at batch 1.

    One repetition times every policy once, in turn, so that a machine that slows down for a while slows
    all of them and their ratios stay fair. The clock runs from an observation in the CPU's memory to
    the action in the CPU's memory: transfers, encoder, noise and all network evaluations included. A
    CUDA device is synchronised before the clock starts and before it stops.

    Args:
        policies: name -> policy, each on its own device.
        repetitions: timed decisions per policy.
        warmup: decisions before the first timed one, not counted.
        threads: torch's intra-op threads while measuring; the former number is restored.
        seed: of the observation and the noise.

    Raises:
        ConfigError: a count below one.
    """
    if min(repetitions, threads) < 1 or warmup < 0:
        raise ConfigError(
            f"repetitions={repetitions} and threads={threads} must be at least 1, warmup={warmup} at least 0"
        )
    observations = {name: typical_observations(p, seed=seed) for name, p in policies.items()}
    times: dict[str, list[float]] = {name: [] for name in policies}
    for policy in policies.values():
        policy.eval()
    with torch_threads(threads), torch.inference_mode():
        for repetition in range(warmup + repetitions):
            for name, policy in policies.items():
                elapsed = _time_decision(policy, observations[name], seed)
                if repetition >= warmup:
                    times[name].append(elapsed)
    return {name: _summary(policies[name], times[name], threads) for name in policies}


def stored_or_measured(
    policies: Mapping[str, Decider], path: Path, *, repetitions: int, threads: int
) -> dict[str, Latency]:
    """Measure each policy, or read what an earlier call of the same evaluation measured and left at `path`.

    To be called before any worker process exists, so that the machine is quiet.

    Raises:
        OutputExistsError: the file is damaged.
    """
    if path.exists():
        stored = _stored(path)
        same = all((s.threads, s.n) == (threads, repetitions) for s in stored.values())
        if set(stored) == set(policies) and same:
            return stored
    measured = measure_latency(policies, repetitions=repetitions, threads=threads)
    write_json(path, {name: latency._asdict() for name, latency in measured.items()})
    return measured


def _stored(path: Path) -> dict[str, Latency]:
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {name: Latency(**fields) for name, fields in stored.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise OutputExistsError(f"{path} is damaged: delete it and latency is measured again") from error


def _time_decision(policy: Decider, obs: Mapping[str, torch.Tensor], seed: int) -> float:
    """Return the wall time of one decision, milliseconds."""
    device = policy.device
    generator = torch.Generator(device).manual_seed(seed)
    shape = (policy.noise_draws, 1, policy.chunk.horizon, policy.spec.action.dim)
    _synchronize(device)
    start = time.perf_counter_ns()
    noise = torch.randn(shape, generator=generator, device=device)
    actions, _ = policy.decide({key: value.to(device) for key, value in obs.items()}, noise, None)
    actions.cpu()
    _synchronize(device)
    return (time.perf_counter_ns() - start) / 1e6


def _synchronize(device: torch.device) -> None:
    # Kernels run after the call that launched them has returned; the host's clock must wait for them.
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _summary(policy: Decider, times_ms: list[float], threads: int) -> Latency:
    device = policy.device
    return Latency(
        median_ms=float(np.median(times_ms)),
        p95_ms=float(np.percentile(times_ms, 95)),
        n=len(times_ms),
        nfe=policy.nfe,
        threads=threads,
        dtype=_dtype(policy),
        device=torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
    )


def _dtype(policy: Decider) -> str:
    first = next(policy.parameters(), None) if isinstance(policy, torch.nn.Module) else None
    return "-" if first is None else str(first.dtype).removeprefix("torch.")
