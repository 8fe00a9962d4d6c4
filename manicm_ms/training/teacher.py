"""Trains a diffusion teacher on demonstrations: the work of `manicm-ms train`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

from rich.console import Console

from manicm_ms.errors import UnknownNameError
from manicm_ms.policies.base import POLICIES, make_policy
from manicm_ms.policies.diffusion import DiffusionPolicy
from manicm_ms.seeds import require_seed
from manicm_ms.training.demonstrations import Data, Demos, read_demos
from manicm_ms.training.loop import Batches
from manicm_ms.training.objectives import DiffusionObjective, PolicyObjective
from manicm_ms.training.optim import PowerDecay
from manicm_ms.training.presets import TeacherPreset
from manicm_ms.training.session import Session


def train_teacher(
    policy_name: str,
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
) -> Path:
    """Train a teacher and write its checkpoint; the same call goes on after a kill, and returns at once when done.

    Args:
        policy_name: a policy tagged "teacher" in `POLICIES`: "dp3", "simple_dp3".
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

    Returns:
        `out`.

    Raises:
        ManicmError: unknown name, unfit configuration, damaged store, another run in `out`, full disk, NaN loss.
    """
    require_seed(seed)
    teachers = POLICIES.names("teacher")
    if policy_name not in teachers:
        raise UnknownNameError("teacher policy", policy_name, teachers)
    demos = read_demos(data, preset.chunk)
    policy = build_teacher(policy_name, demos, preset, seed)
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
        objective = DiffusionObjective(policy, preset.points, decay)
        return objective, demos.windows.to(session.fabric.device)

    inputs = {
        "policy": policy_name,
        "chunk": asdict(preset.chunk),
        "env_spec": demos.spec.to_dict(),
        "data": demos.provenance["sha256"],
    }
    return session.complete(inputs, {"data": demos.provenance}, build, snapshots)


def build_teacher(policy_name: str, demos: Demos, preset: TeacherPreset, seed: int) -> DiffusionPolicy:
    """Return the untrained teacher of a preset, its normaliser fitted to the demonstrations."""
    network: dict[str, Any] = {
        "cloud_frame": _cloud_frame(preset, demos),
        "cloud_scale": preset.cloud_scale,
        "max_points": preset.points,
        "acting_points": preset.acting_points,
        "training_points": preset.training_points,
        "min_state_range": preset.min_state_range,
    }
    if preset.down_dims is not None:
        network["down_dims"] = preset.down_dims
    config = {"network": network, "diffusion": {"prediction_type": preset.prediction_type}}
    policy = make_policy(policy_name, demos.spec, preset.chunk, config, stats=demos.stats, seed=seed)
    return cast(DiffusionPolicy, policy)


def _cloud_frame(preset: TeacherPreset, demos: Demos) -> str:
    if preset.cloud_frame != "auto":
        return preset.cloud_frame
    return "base" if demos.spec.tcp_indices is None else "tcp"
