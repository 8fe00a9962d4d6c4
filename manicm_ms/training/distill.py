"""Distils a teacher into a one-step student: the work of `manicm-ms distill`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from manicm_ms.errors import CheckpointError, ConfigError, SpecMismatchError
from manicm_ms.machine.devices import torch_threads
from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest
from manicm_ms.policies.heads.diffusion import DiffusionHead
from manicm_ms.policies.methods import student_of
from manicm_ms.progress import working
from manicm_ms.seeds import require_seed
from manicm_ms.spec import EnvSpec, require_compatible
from manicm_ms.training.demonstrations import Data, read_demos
from manicm_ms.training.features import encode_dataset
from manicm_ms.training.loop import Batches
from manicm_ms.training.objectives.objective import DISTILLATIONS, PolicyObjective
from manicm_ms.training.presets import StudentPreset
from manicm_ms.training.session import Session
from manicm_ms.training.settings import preset_identity


def distill(
    teacher: Path,
    data: Data,
    out: Path,
    preset: StudentPreset,
    *,
    device: str = "auto",
    precision: str | None = None,
    seed: int = 0,
    num_devices: int = 1,
    console: Console | None = None,
    command: str | None = None,
    snapshots: int = 0,
    allow_other_task: bool = False,
    on_trained: Callable[[ActionPolicy], None] | None = None,
) -> Path:
    """Distil a teacher and write the student's checkpoint; the same call goes on after a kill.

    The student starts from the teacher's averaged weights and keeps its encoder and normalizer.

    Args:
        teacher: checkpoint folder of a diffusion policy.
        data: store of demonstrations, or several, as a rule what the teacher was trained on.
        out: checkpoint folder to write; state and logs go to `<out>.train`.
        preset: how to distil.
        device: "auto", "cpu", "cuda", "cuda:1".
        precision: one of `PRECISIONS`; None takes the preset's.
        seed: of point subsets, batches and noise.
        num_devices: devices that share each batch.
        console: for progress; standard error by default.
        command: the command line, for the record; this process's by default.
        snapshots: checkpoints to keep on the way, at even distances; see `snapshot_folders`.
        on_trained: called with the trained policy, still in memory, before its checkpoint is written.
        allow_other_task: distil on demonstrations of another task than the teacher's, which is refused otherwise.

    Returns:
        `out`.

    Raises:
        CheckpointError: the teacher is missing, damaged, or not a diffusion policy.
        SpecMismatchError: data and teacher were made for different observations or actions, or for different tasks.
        ManicmError: unfit configuration, damaged store, another run in `out`, full disk, NaN loss.
    """
    require_seed(seed)
    teacher, objective_type = Path(teacher), DISTILLATIONS.get(preset.objective)
    policy = _load_teacher(teacher)
    demos = read_demos(data, policy.chunk, policy.keys, f"the teacher {teacher}")
    source = f"the data {demos.provenance['path']}"
    require_compatible(demos.spec, policy.spec, source, f"the teacher {teacher}", policy.keys)
    if not allow_other_task:
        _require_same_task(demos.spec, demos.provenance["path"], policy.spec, teacher)
    student = student_of(policy, nfe=preset.nfe, num_solver_steps=_solver_steps(policy, preset.solver_stride))
    manifest = read_manifest(teacher)
    session = Session.start(
        "student", out, preset, device=device, precision=precision or preset.precision, seed=seed,
        num_devices=num_devices, console=console, command=command,
    )  # fmt: skip
    session.show_remarks(demos)

    def build() -> tuple[PolicyObjective, Batches]:
        policy.to(session.fabric.device)
        seen = session.console if session.fabric.is_global_zero else None
        with torch_threads(preset.threads), working(seen, "encode the demonstrations"):
            features = encode_dataset(policy, demos.dataset.to(session.fabric.device), preset.draws, seed)
        return objective_type(policy, student, preset.ema_decay), features

    weights = manifest["files"]["model.safetensors"]["sha256"]
    inputs = {"teacher": weights, "data": demos.provenance["sha256"], "preset": preset_identity(preset)}
    made_from = {"path": str(teacher), "sha256": weights, "provenance": manifest["provenance"]}
    return session.complete(inputs, {"data": demos.provenance, "teacher": made_from}, build, snapshots, on_trained)


def _load_teacher(folder: Path) -> ActionPolicy:
    policy = load_checkpoint(folder)
    if not isinstance(policy.head, DiffusionHead):
        raise CheckpointError(f"{folder} holds a {policy.name}, which cannot be distilled: give a diffusion teacher")
    return policy


def _require_same_task(demonstrated: EnvSpec, data: str, learnt: EnvSpec, teacher: Path) -> None:
    """Raise SpecMismatchError where the demonstrations are of another task than the one that the teacher learnt."""
    if demonstrated.env_id != learnt.env_id:
        raise SpecMismatchError(
            f"the data {data} are of {demonstrated.env_id} and the teacher {teacher} was trained for {learnt.env_id}: "
            "name its own demonstrations, or add --allow-other-task if you mean it"
        )


def _solver_steps(teacher: ActionPolicy, stride: int) -> int:
    """Return the grid points of a solver that spans `stride` of the teacher's timesteps at a time."""
    timesteps = teacher.head.config.num_train_timesteps
    if timesteps % stride:
        raise ConfigError(f"solver_stride={stride} must divide the teacher's {timesteps} timesteps: try 10")
    return timesteps // stride
