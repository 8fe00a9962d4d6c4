"""Builds a method at full size, takes a few steps on real demonstrations, saves, loads, and compares the actions.

It shows that a method of whatever size runs on this machine from a store to a checkpoint, and what that costs. A method
that learns from a teacher is distilled from one that is as good as untrained: one step on the same store.
"""

from __future__ import annotations

import contextlib
import resource
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from torch import Tensor

from manicm_ms.demos.collect import collect
from manicm_ms.demos.layout import OPTIONAL_FIELDS, store_path
from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.evaluation.machine import machine
from manicm_ms.machine.devices import resolve_device
from manicm_ms.paths import write_json
from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest
from manicm_ms.policies.encoders.encoder import ENCODERS
from manicm_ms.policies.encoders.transform import TRANSFORMS
from manicm_ms.policies.methods import METHODS, methods_of
from manicm_ms.policies.parameter_counts import TOTAL, parameters_by_part
from manicm_ms.policies.policy import example_observations
from manicm_ms.training.demonstrations import spec_of
from manicm_ms.training.distill import distill
from manicm_ms.training.log import read_log
from manicm_ms.training.objectives.objective import DISTILLATIONS
from manicm_ms.training.presets import SIZES, STUDENT_PRESETS, Preset, preset_for
from manicm_ms.training.run_folder import training_folder
from manicm_ms.training.train import train

_ROWS = 4  # observations that the actions are compared on


@dataclass(frozen=True)
class Options:
    """What is measured.

    Attributes:
        method: a name in `METHODS`.
        size: of the presets, in `SIZES`.
        steps: of the optimizer.
        data: stores of demonstrations; none: some are collected.
        env: of which they are collected then.
        episodes: that are collected.
        teacher: that a student is distilled from; None: the first one with the student's encoder and backbone.
        batch_size: None takes the preset's.
        device: torch device.
        seed: of weights, batches and noise.
        folder: where the collected store and the result go.
    """

    method: str
    size: str
    steps: int
    data: tuple[Path, ...]
    env: str
    episodes: int
    teacher: str | None
    batch_size: int | None
    device: str
    seed: int
    folder: Path


def bench(options: Options, command: str, console: Console | None = None) -> bool:
    """Measure, print a table, and write METHOD-SIZE.json into the folder.

    Returns:
        Whether the loaded policy chose the actions of the one that was saved.

    Raises:
        UnknownNameError: no such method, size or teacher.
        ConfigError: no teacher fits the student, or one is named for what has none.
        StoreError: a store is not there.
    """
    METHODS.get(options.method)
    if options.size not in SIZES:
        raise UnknownNameError("size", options.size, SIZES)
    student = learns_from_teacher(options.method)
    if options.teacher is not None and not student:
        raise ConfigError(f"{options.method} learns from demonstrations alone: leave --teacher out")
    teacher = teacher_of(options.method, options.size, options.teacher) if student else None
    _ = spec_of(options.data) if options.data else None  # refuses a store that is not there before anything is made
    console = console or Console()
    data = options.data or (_collected(options, teacher or options.method, console),)
    found = measure(options, data, teacher, console)
    path = options.folder / f"{options.method}-{options.size}.json"
    write_json(path, {"command": command, **found})
    print(f"\n{table(found)}\n\nwritten to {path}")
    return bool(found["equal_actions"])


def learns_from_teacher(method: str) -> bool:
    """Return whether a method is distilled rather than trained on demonstrations."""
    return METHODS.get(method).objective in DISTILLATIONS.names()


def teacher_of(student: str, size: str, asked: str | None = None) -> str:
    """Return the method that a student is distilled from: the one asked for, or the first with its network and encoder.

    Raises:
        UnknownNameError: what is asked for is no teacher.
        ConfigError: none fits.
    """
    teachers = methods_of("teacher")
    if asked is not None:
        if asked not in teachers:
            raise UnknownNameError("teacher", asked, teachers)
        return asked
    wanted = METHODS.get(student).configuration(size)
    for name in teachers:
        has = METHODS.get(name).configuration(size)
        if all(has[part] == wanted[part] for part in ("encoder", "backbone")):
            return name
    raise ConfigError(f"no teacher has the encoder and the backbone of {student}: name one by --teacher")


def extras_of(method: str) -> tuple[str, ...]:
    """Return the optional fields of a store that a method reads: what `collect --extras` must add."""
    config = METHODS.get(method).configuration()
    encoder = ENCODERS.get(config["encoder"]["name"])
    reads = {*encoder.keys, *(key for name in config["inputs"] for key in TRANSFORMS.get(name).reads)}
    return tuple(field for field in OPTIONAL_FIELDS if field in reads)


def measure(options: Options, data: tuple[Path, ...], teacher: str | None, console: Console) -> dict[str, Any]:
    """Return what building, training, saving and loading came to, JSON values.

    Args:
        options: what is measured.
        data: stores of demonstrations.
        teacher: method that is distilled; None for what learns from demonstrations.
        console: where progress goes.
    """
    options.folder.mkdir(parents=True, exist_ok=True)
    chosen: list[Tensor] = []
    with tempfile.TemporaryDirectory(dir=options.folder) as work:
        out = Path(work) / options.method
        run = _trainer(options, data, teacher, Path(work), console)
        forget_peak_memory(options.device)
        run(out, lambda policy: chosen.append(_actions(policy.eval())))
        peak = peak_memory_mb(options.device)
        policy = load_checkpoint(out, device=str(resolve_device(options.device)))
        error = float((_actions(policy) - chosen[0]).abs().max())
        log, manifest = read_log(training_folder(out) / "log.jsonl"), read_manifest(out)
    times = [line["seconds"] for line in log]
    each = [now - before for before, now in zip([0.0, *times], times, strict=False)]
    made = manifest["provenance"]
    return {
        "method": options.method,
        "size": options.size,
        "teacher": teacher,
        "parameters": parameters_by_part(policy),
        "nfe": policy.nfe,
        "checkpoint_mb": manifest["files"]["model.safetensors"]["bytes"] / 1e6,
        "steps": len(log),
        "batch_size": made["preset"]["batch_size"],
        "seconds_first_step": each[0],
        "seconds_per_step": statistics.median(each[1:] or each),
        "peak_memory_mb": peak,
        "loss_first": log[0]["loss"],
        "loss_last": log[-1]["loss"],
        "action_error": error,
        "equal_actions": error == 0.0,
        "precision": made["precision"],
        "device": made["device"],
        "data": made["data"]["path"],
        "windows": made["data"]["windows"],
        "machine": machine(),
        "options": {k: str(v) if isinstance(v, Path) else v for k, v in asdict(options).items() if k != "data"},
    }


def _trainer(
    options: Options, data: tuple[Path, ...], teacher: str | None, work: Path, console: Console
) -> Callable[[Path, Callable[[ActionPolicy], None]], Path]:
    """Return what trains the method into a folder; the teacher of a student is made here, and not measured."""
    shared: dict[str, Any] = {"device": options.device, "seed": options.seed, "console": console}
    if teacher is None:
        preset = _shortened(preset_for(options.method, options.size), options.steps, options.batch_size)
        return lambda out, seen: train(options.method, data, out, preset, on_trained=seen, **shared)
    one = _shortened(preset_for(teacher, options.size), 1, options.batch_size)
    source = train(teacher, data, work / "teacher", one, **shared)
    full = replace(STUDENT_PRESETS.get(options.size), nfe=METHODS.get(options.method).nfe)
    student = _shortened(full, options.steps, options.batch_size)
    return lambda out, seen: distill(source, data, out, student, on_trained=seen, **shared)


def _shortened(preset: Preset, steps: int, batch_size: int | None) -> Preset:
    size = batch_size or preset.batch_size
    return replace(preset, steps=steps, epochs=None, warmup_steps=0, log_every=1, batch_size=size)


def _collected(options: Options, method: str, console: Console) -> Path:
    extras = extras_of(method)
    path = store_path(options.folder / "-".join(["data", *extras]), options.env)
    return collect(options.env, options.episodes, path, extras=extras, console=console).path


def _actions(policy: ActionPolicy) -> Tensor:
    """Return (4, Ta, Da) what a policy chooses for observations, and noise, that are always the same."""
    obs = example_observations(policy, batch=_ROWS)
    device = next(policy.parameters()).device
    generator = torch.Generator(device).manual_seed(0)
    return policy.act({key: value.to(device) for key, value in obs.items()}, generator=generator).cpu()


def forget_peak_memory(device: str) -> None:
    """Count the peak of memory from now on, where the system can."""
    if resolve_device(device).type == "cuda":
        torch.cuda.reset_peak_memory_stats()
        return
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_memory_mb(device: str) -> float:
    """Return the most memory that was held: of the accelerator, or of this process as a whole, in 10^6 bytes."""
    if resolve_device(device).type == "cuda":
        return torch.cuda.max_memory_allocated() / 1e6
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def table(found: dict[str, Any]) -> str:
    """Return the result as Markdown."""
    parts = {name: count for name, count in found["parameters"].items() if name != TOTAL}
    of_parts = ", ".join(f"{name} {count:,}" for name, count in parts.items())
    source = f", from {found['teacher']}" if found["teacher"] else ""
    entries = {
        "method": f"{found['method']} ({found['size']}{source})",
        "parameters": f"{found['parameters'][TOTAL]:,} ({of_parts})",
        "network evaluations a decision": str(found["nfe"]),
        "steps": f"{found['steps']} of {found['batch_size']} windows, {found['precision']} on {found['device']}",
        "a step": f"{found['seconds_per_step']:.3g} s (the first {found['seconds_first_step']:.3g} s)",
        "peak memory": f"{found['peak_memory_mb']:,.0f} MB",
        "checkpoint": f"{found['checkpoint_mb']:,.1f} MB",
        "loss, first and last step": f"{found['loss_first']:.4g}, {found['loss_last']:.4g}",
        "saved and loaded": "equal actions" if found["equal_actions"] else f"differs by {found['action_error']:.3g}",
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in entries.items())])
