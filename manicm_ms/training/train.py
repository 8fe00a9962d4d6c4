"""Trains a policy on demonstrations: the work of `manicm-ms train`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from manicm_ms.errors import ConfigError
from manicm_ms.policies.action_policy import ActionPolicy, build_policy
from manicm_ms.policies.methods import METHODS
from manicm_ms.seeds import require_seed
from manicm_ms.spec import ChunkSpec, EnvSpec
from manicm_ms.training.demonstrations import Data, read_demos, spec_of
from manicm_ms.training.loop import Batches
from manicm_ms.training.objectives.objective import DISTILLATIONS, OBJECTIVES, OnDemonstrations, PolicyObjective
from manicm_ms.training.optim import PowerDecay
from manicm_ms.training.presets import CHUNK, TeacherPreset
from manicm_ms.training.session import Session
from manicm_ms.training.settings import preset_identity


def train(
    method: str,
    data: Data,
    out: Path,
    preset: TeacherPreset,
    *,
    device: str = "auto",
    precision: str | None = None,
    seed: int = 0,
    num_devices: int = 1,
    console: Console | None = None,
    command: str | None = None,
    snapshots: int = 0,
    on_trained: Callable[[ActionPolicy], None] | None = None,
) -> Path:
    """Train a policy and write its checkpoint; the same call goes on after a kill, and returns at once when done.

    Args:
        method: a name in `METHODS` whose objective learns from demonstrations.
        data: store of demonstrations, or several of the same task.
        out: checkpoint folder to write; state and logs go to `<out>.train`.
        preset: how to train.
        device: "auto", "cpu", "cuda", "cuda:1".
        precision: one of `PRECISIONS`; None takes the preset's.
        seed: of weights, batches and noise.
        num_devices: devices that share each batch.
        console: for progress; standard error by default.
        command: the command line, for the record; this process's by default.
        snapshots: checkpoints to keep on the way, at even distances; see `snapshot_folders`.
        on_trained: called with the trained policy, still in memory, before its checkpoint is written.

    Returns:
        `out`.

    Raises:
        ManicmError: unknown name, unfit configuration, damaged store, another run in `out`, full disk, NaN loss.
    """
    require_seed(seed)
    objective = objective_of(method)
    config = preset.configuration(method)
    chunk = ChunkSpec(**config.pop(CHUNK))
    policy = _untrained(method, config, spec_of(data), chunk, seed)
    demos = read_demos(data, chunk, policy.keys, method)
    policy.fit_normalizer(demos.stats)
    session = Session.start(
        "teacher",
        out,
        preset,
        device=device,
        precision=precision or preset.precision,
        seed=seed,
        num_devices=num_devices,
        console=console,
        command=command,
    )
    session.show_remarks(demos)

    def build() -> tuple[PolicyObjective, Batches]:
        decay = PowerDecay(preset.ema_power, preset.ema_max_decay)
        return objective(policy, decay), demos.dataset.to(session.fabric.device)

    inputs = {
        "policy": method,
        "chunk": {"n_obs_steps": chunk.n_obs_steps, "horizon": chunk.horizon, "n_action_steps": chunk.n_action_steps},
        "env_spec": demos.spec.to_dict(),
        "data": demos.provenance["sha256"],
        "preset": preset_identity(preset, method),
    }
    return session.complete(inputs, {"data": demos.provenance}, build, snapshots, on_trained)


def objective_of(method: str) -> OnDemonstrations:
    """Return the objective of a method; raise ConfigError where it does not learn from demonstrations."""
    name = METHODS.get(method).objective
    if name in DISTILLATIONS.names():
        raise ConfigError(f"{method} learns from a teacher, not from demonstrations: use manicm-ms distill")
    return OBJECTIVES.get(name)


def _untrained(method: str, config: Mapping[str, Any], spec: EnvSpec, chunk: ChunkSpec, seed: int) -> ActionPolicy:
    """Return the policy that a configuration describes."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build_policy(method, config, spec, chunk)
