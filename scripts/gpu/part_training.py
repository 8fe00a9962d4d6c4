"""Part 2 of the GPU kit: Simple DP3 with the `paper` preset's sizes and batch, and its student, on two tasks.

The machine is there for minutes, and the preset wants hours: each training first measures how fast steps go, then plans
as many as its share of the time allows, learning rate included. What comes back is a half-precision checkpoint each, in
an archive of its own, to be evaluated on a CPU.
"""

from __future__ import annotations

import argparse
import os
import signal
import threading
import time
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from kit import FILE_BACK_BYTES, Budget, Results, last_error, part_arguments, results_of
from rich.console import Console

from manicm_ms.demos.layout import store_path
from manicm_ms.demos.sequence_dataset import SequenceDataset
from manicm_ms.demos.store import DemoStore
from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest, save_checkpoint
from manicm_ms.policies.configuration import Nested
from manicm_ms.policies.methods import METHODS
from manicm_ms.training.distill import distill
from manicm_ms.training.interrupt import stop_requests
from manicm_ms.training.optim import FitConfig
from manicm_ms.training.presets import STUDENT_PRESETS, StudentPreset, TeacherPreset, preset_for
from manicm_ms.training.run_folder import snapshot_folders
from manicm_ms.training.train import train as train_policy

PART = "training"
POLICY = "simple_dp3"
TASKS = ("metaworld/pick-place", "adroit/hammer")  # a hard one that tells policies apart, then one that all solve
SECONDS = {"teacher": 80.0, "student": 40.0}  # of steps; 4 minutes for the two tasks
OVERHEAD_S = 6.0  # of a training: reading, saving, and what comes before the first step
WARM_UP_STEPS, TIMED_STEPS = 20, 200
CAUTION, PATIENCE = 0.9, 1.15  # shares of the time: planned for, and after which a training is ended
MOST_ABOVE_WHOLE = 3.0  # speed of the steps over that of the whole short training, overhead included: more is an error
SNAPSHOTS = 5  # kept on the way
SMOKE_BATCH = 8
SMOKE_STEPS = (2, 4)
F = TypeVar("F", TeacherPreset, StudentPreset)
Train = Callable[[Any, Path], Path]
"""(preset, folder of the checkpoint) -> that folder."""


@dataclass(frozen=True)
class Trained:
    """What a training made.

    Attributes:
        checkpoint: its folder, float32.
        numbers: for its line.
    """

    checkpoint: Path
    numbers: dict[str, Any]


@dataclass(frozen=True)
class Training:
    """How a policy is trained.

    Attributes:
        preset: of as many steps as it wants.
        train: trains with a preset that is like it but for the steps.
    """

    preset: Any
    train: Train


def common(args: argparse.Namespace) -> dict[str, Any]:
    """Return what `train` and `distill` are told alike."""
    return {
        "device": args.device,
        "console": Console(quiet=True),
        "command": "scripts/gpu/run.py",
        "snapshots": SNAPSHOTS,
    }


def of_demonstrations(method: str, store: Path, args: argparse.Namespace, changes: Nested | None = None) -> Training:
    """Return how a method learns from demonstrations with the sizes and batch of the preset `paper`.

    Args:
        method: its name.
        store: the demonstrations.
        args: of the command line.
        changes: departures from its published sizes; tiny networks know none.
    """
    preset = preset_for(method, "paper").with_changes(changes or {})
    if args.smoke:
        preset = replace(preset, batch_size=SMOKE_BATCH, size="smoke", changes={})

    def train(shorter: TeacherPreset, out: Path) -> Path:
        return train_policy(method, store, out, shorter, **common(args))

    return Training(preset, train)


def of_teacher(teacher: Path, store: Path, args: argparse.Namespace) -> Training:
    """Return how the student of a teacher's checkpoint is distilled with the batch of the preset `paper`."""
    preset = STUDENT_PRESETS.get("paper")
    if args.smoke:
        preset = replace(preset, batch_size=SMOKE_BATCH)

    def train(shorter: StudentPreset, out: Path) -> Path:
        return distill(teacher, store, out, shorter, **common(args))

    return Training(preset, train)


def size_of(store: Path, method: str) -> dict[str, int]:
    """Return how many episodes a store holds, and how many windows they are for a method of the preset `paper`."""
    with DemoStore.open(store) as opened:
        windows = SequenceDataset.from_store(opened, METHODS.get(method).chunk_of("paper"))
        return {"episodes": len(opened), "windows": len(windows)}


def shortened(preset: F, steps: int) -> F:
    """Return the preset for `steps` steps: the same in all else, but the warm-up shrinks with a very short one."""
    warm_up = min(preset.warmup_steps, steps // 4)
    return replace(preset, steps=steps, epochs=None, warmup_steps=warm_up, save_every=steps)


def steps_per_second(train: Train, preset: FitConfig, folder: Path, steps: tuple[int, int]) -> float:
    """Return how fast optimizer steps go: the difference of a short and a longer training, which have the rest alike.

    The first of three trainings only wakes the device: its libraries load and choose their kernels.
    """
    took = []
    for name, number in (("warm_up", steps[0]), ("short", steps[0]), ("long", steps[1])):
        begin = time.perf_counter()
        train(shortened(preset, number), folder / name)  # type: ignore[type-var]
        took.append(time.perf_counter() - begin)
    rate = (steps[1] - steps[0]) / max(took[2] - took[1], 1e-3)
    return min(rate, MOST_ABOVE_WHOLE * steps[1] / took[2])


def share_s(kind: str, budget: Budget, to_come: list[str]) -> float:
    """Return the seconds of this training: what is planned, less where the time will not do for all to come."""
    left = budget.left_s - OVERHEAD_S * len(to_come)
    return min(SECONDS[kind], left * SECONDS[kind] / sum(SECONDS[k] for k in to_come))


def train_one(training: Training, out: Path, seconds: float, windows: int, smoke: bool) -> Trained:
    """Train for about `seconds` and return what came of it.

    Raises TimeoutError where not even a few steps fit.
    """
    begin = time.perf_counter()
    timed = SMOKE_STEPS if smoke else (WARM_UP_STEPS, WARM_UP_STEPS + TIMED_STEPS)
    rate = steps_per_second(training.train, training.preset, out.parent / f"{out.name}_speed", timed)
    left = seconds - (time.perf_counter() - begin)
    steps = SMOKE_STEPS[1] if smoke else min(training.preset.total_steps(windows), int(rate * CAUTION * left))
    if steps < WARM_UP_STEPS and not smoke:
        raise TimeoutError(f"{left:.0f} s are too few for {rate:.1f} steps/s")
    made = train_steps(training, out, steps, PATIENCE * max(left, OVERHEAD_S), windows)
    return Trained(made.checkpoint, {**made.numbers, "steps_per_s": round(rate, 2), "seconds": since(begin)})


def since(begin: float) -> float:
    """Return the seconds since a moment of `time.perf_counter`, for a line."""
    return round(time.perf_counter() - begin, 1)


def train_steps(training: Training, out: Path, steps: int, limit_s: float, windows: int) -> Trained:
    """Train for `steps` steps, or until `limit_s` is over, and return what came of it; raises as `train_until`."""
    begin, preset = time.perf_counter(), training.preset
    checkpoint = train_until(lambda: training.train(shortened(preset, steps), out), out, limit_s)
    made, wanted = read_manifest(checkpoint)["provenance"], preset.total_steps(windows)
    numbers = {
        "steps": made["steps"],
        "planned_steps": steps,
        "preset_steps": wanted,
        "share": round(made["steps"] / wanted, 6),
        "seconds": since(begin),
        "loss": made.get("final_loss"),
        "batch_size": preset.batch_size,
        "precision": made["precision"],
        "device": made["device"],
    }
    return Trained(checkpoint, numbers)


def train_until(train: Callable[[], Path], out: Path, limit_s: float) -> Path:
    """Return the checkpoint that `train` writes, or, where it is not done in time, the last one it kept on the way.

    A training ends with its step on SIGTERM; a plan that was too long must not cost everything.

    Raises TimeoutError where it had kept none.
    """
    late = threading.Event()

    def stop() -> None:
        late.set()
        os.kill(os.getpid(), signal.SIGTERM)

    timer = threading.Timer(limit_s, stop)
    timer.start()
    with stop_requests():  # outside the loop of the steps, in saving say, the signal changes nothing
        try:
            return train()
        except KeyboardInterrupt:
            if not late.is_set():
                raise
        finally:
            timer.cancel()
    kept = snapshot_folders(out)
    if not kept:
        raise TimeoutError(f"not one of {SNAPSHOTS} parts was done within {limit_s:.0f} s")
    return kept[max(kept)]


def pack(checkpoint: Path, archive: Path, work: Path) -> int:
    """Write the checkpoint in half precision as one archive and return its bytes.

    Raises ValueError where it is too large to come back.
    """
    half = work / "half" / archive.stem
    save_checkpoint(load_checkpoint(checkpoint), half, read_manifest(checkpoint)["provenance"], dtype="float16")
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
        for file in sorted(half.iterdir()):
            packed.write(file, f"{archive.stem}/{file.name}")
    size = archive.stat().st_size
    if size > FILE_BACK_BYTES:
        archive.unlink()
        raise ValueError(f"{archive.name} has {size} bytes and {FILE_BACK_BYTES} may come back")
    return size


def archive_name(env_id: str, kind: str) -> str:
    """Return the file name of a checkpoint's archive, which is also the name of the folder in it."""
    return f"{env_id.replace('/', '_')}_{kind}.zip"


def unpacked_store(env_id: str, load: Path, work: Path) -> Path:
    """Return the demonstrations of a task, unpacked from the load."""
    store = store_path(work / "stores", env_id)
    if not store.exists():
        with zipfile.ZipFile(store_path(load / "stores", env_id).with_suffix(".zip")) as archive:
            archive.extractall(store.parent)
    return store


class Task:
    """Trains teacher and student of one task.

    Args:
        env_id: the task.
        args: of the command line.
    """

    def __init__(self, env_id: str, args: argparse.Namespace) -> None:
        self.env_id, self.args = env_id, args
        self.store = unpacked_store(env_id, args.load, args.work)
        self.folder = args.work / "checkpoints" / env_id
        self.teacher = self.folder / "teacher"  # or where its last snapshot lies
        self.size = size_of(self.store, POLICY)

    def run(self, kind: str, seconds: float) -> dict[str, Any]:
        """Train one of the two, bring it home and return its numbers."""
        if kind == "teacher":
            training = of_demonstrations(POLICY, self.store, self.args)
        else:
            training = of_teacher(self.teacher, self.store, self.args)
        made = train_one(training, self.folder / kind, seconds, self.size["windows"], self.args.smoke)
        if kind == "teacher":
            self.teacher = made.checkpoint
        archive = self.args.out / archive_name(self.env_id, kind)
        size = pack(made.checkpoint, archive, self.args.work)
        return {**self.size, **made.numbers, "archive": archive.name, "bytes": size}


def train_all(args: argparse.Namespace, results: Results, budget: Budget) -> bool:
    """Train everything that the time allows, a line each, and return whether nothing failed."""
    plan = [(env_id, kind) for env_id in TASKS for kind in SECONDS]
    tasks: dict[str, Task | None] = {}
    for number, (env_id, kind) in enumerate(plan):
        seconds = share_s(kind, budget, [k for _, k in plan[number:]])
        try:
            if env_id not in tasks:
                tasks[env_id] = None
                tasks[env_id] = Task(env_id, args)
            if (task := tasks[env_id]) is None:
                raise RuntimeError("there is no teacher to distil")
            results.write(PART, task=env_id, kind=kind, **task.run(kind, seconds))
        except Exception as error:  # the next task has its own chance
            tasks[env_id] = None
            results.write(PART, task=env_id, kind=kind, failed=last_error(error))
    return None not in tasks.values()


def main() -> int:
    """Train, and return the exit status."""
    parser = part_arguments(argparse.ArgumentParser(description=__doc__.splitlines()[0]))
    parser.add_argument("--device", default="auto", help="cpu or cuda; auto takes CUDA where there is one")
    args = parser.parse_args()
    return 0 if train_all(args, results_of(args.out), Budget(args.budget)) else 1


if __name__ == "__main__":
    raise SystemExit(main())
