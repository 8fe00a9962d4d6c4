"""From demonstrations to a checkpoint, once: what teachers and students have in common around the loop."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lightning_fabric import Fabric
from rich.console import Console

from manicm_ms.errors import CheckpointError, ConfigError, OutputExistsError, require_at_least
from manicm_ms.machine.devices import resolve_device
from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.checkpoint import description_of, read_manifest, save_checkpoint
from manicm_ms.policies.parameter_counts import parameters_by_part
from manicm_ms.provenance import package_versions
from manicm_ms.training.demonstrations import Demos
from manicm_ms.training.device import make_fabric, resolve_precision
from manicm_ms.training.loop import Batches, FitResult, Snapshots, fit
from manicm_ms.training.objectives.objective import PolicyObjective
from manicm_ms.training.optim import FitConfig
from manicm_ms.training.run_folder import RUN_FILE, RunFolder, open_run, snapshot_folder, training_folder

_NOT_IDENTITY = ("log_every", "save_every", "precision")  # the precision that is used stands beside the preset


_WORK = {"teacher": "train", "student": "distill"}
"""What making one is called."""


@dataclass(frozen=True)
class Session:
    """One training: where it runs, what it makes and where that goes.

    Attributes:
        kind: "teacher" or "student", for messages.
        out: checkpoint folder to write.
        preset: all of its fields.
        precision: the one used, resolved.
        seed: of weights, batches and noise.
        fabric: device and processes, launched.
        console: for progress and messages.
        command: the command line that this is, for the record.
    """

    kind: str
    out: Path
    preset: FitConfig
    precision: str
    seed: int
    fabric: Fabric
    console: Console
    command: str

    @classmethod
    def start(
        cls,
        kind: str,
        out: Path,
        preset: FitConfig,
        *,
        device: str,
        precision: str,
        seed: int,
        num_devices: int,
        console: Console | None,
        command: str | None,
    ) -> Session:
        """Resolve device and precision and launch the processes.

        Raises ConfigError where they do not exist, or where the devices cannot share a batch equally.
        """
        require_at_least(1, num_devices=num_devices)
        if preset.batch_size % num_devices:
            raise ConfigError(
                f"batch_size={preset.batch_size} cannot be shared equally by num_devices={num_devices}: "
                f"use batch_size={-(-preset.batch_size // num_devices) * num_devices}, or fewer devices"
            )
        place = resolve_device(device)
        used = resolve_precision(precision, place)
        line = command if command is not None else shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
        fabric = make_fabric(place, used, num_devices)
        return cls(kind, Path(out), preset, used, seed, fabric, console or Console(stderr=True), line)

    def show_remarks(self, demos: Demos) -> None:
        """Say what a user should know of the demonstrations, a line each."""
        for remark in demos.remarks:
            self._say(remark)

    def complete(
        self,
        inputs: Mapping[str, Any],
        provenance: Mapping[str, Any],
        build: Callable[[], tuple[PolicyObjective, Batches]],
        snapshots: int = 0,
        on_trained: Callable[[ActionPolicy], None] | None = None,
    ) -> Path:
        """Train and write the checkpoint, or go on with what an earlier process left, or find it all done.

        Args:
            inputs: what decides the weights beside precision and seed, JSON values; `preset` is that of the preset.
            provenance: of the inputs, for the checkpoint.
            build: makes objective and data, the same at each call.
            snapshots: checkpoints kept on the way, at even distances, the last one at the end; see `snapshot_folders`.
            on_trained: called with the trained policy before its checkpoint is written, where this call trains it.

        Returns:
            The checkpoint folder.

        Raises:
            OutputExistsError: `out` holds another run or something else.
            NoSpaceError, TrainingDivergedError: see `fit`.
        """
        identity = {
            "kind": self.kind,
            **inputs,
            "preset": {k: v for k, v in inputs["preset"].items() if k not in _NOT_IDENTITY},
            "precision": self.precision,
            "seed": self.seed,
        }
        with self._open(identity) as run:
            done = _is_done(run)
            self.fabric.barrier()  # all ranks have looked before rank 0 writes
            if done:
                if self.fabric.is_global_zero:
                    run.drop_state()  # a kill between the checkpoint and this left it
                self._say(f"{self.out} is finished: nothing to do")
                return self.out
            objective, data = build()
            if self.fabric.is_global_zero:
                run.note(self._known(run, objective, len(data), provenance))
            try:
                result = fit(
                    objective,
                    data,
                    self.preset,
                    run,
                    self.fabric,
                    seed=self.seed,
                    console=self.console,
                    title=f"{_WORK[self.kind]} {self.out.name}",
                    snapshots=self._snapshots(snapshots, len(data), objective, run, provenance),
                )
            except KeyboardInterrupt:
                self._say(f"training state saved in {run.folder}")
                raise
            if self.fabric.is_global_zero:
                if on_trained is not None:
                    on_trained(objective.outcome)
                save_checkpoint(objective.outcome, self.out, self._record(run, result, provenance))
                run.drop_state()
            self.fabric.barrier()
        self._say(f"{self.out}: {result.steps} steps in {result.seconds:.0f} s, loss {result.loss:.4g}")
        return self.out

    def _snapshots(
        self, count: int, samples: int, objective: PolicyObjective, run: RunFolder, provenance: Mapping[str, Any]
    ) -> Snapshots:
        """Return what saves `count` checkpoints on the way."""
        last = self.preset.total_steps(samples)

        def take(step: int) -> None:
            so_far = FitResult(step, math.nan, math.nan, 0)
            save_checkpoint(objective.outcome, snapshot_folder(self.out, step), self._record(run, so_far, provenance))

        return Snapshots(frozenset(round(last * k / count) for k in range(1, count + 1)), take)

    def _open(self, identity: Mapping[str, Any]) -> AbstractContextManager[RunFolder]:
        if not self.fabric.is_global_zero:
            return nullcontext(RunFolder(self.out, identity))
        if not (training_folder(self.out) / RUN_FILE).exists():
            _is_done(RunFolder(self.out, identity))  # refuses what is not ours before anything is written beside it
        return open_run(self.out, identity)

    def _record(self, run: RunFolder, result: FitResult, provenance: Mapping[str, Any]) -> dict[str, Any]:
        """Return what a checkpoint says about its making."""
        return {
            "run": run.fingerprint,
            "kind": self.kind,
            "command": self.command,
            "steps": result.steps,
            **({} if math.isnan(result.loss) else {"final_loss": result.loss, "seconds": round(result.seconds, 1)}),
            "seed": self.seed,
            "device": str(self.fabric.device),
            "precision": self.precision,
            "preset": json.loads(json.dumps(asdict(self.preset))),
            **provenance,
        }

    def _known(
        self, run: RunFolder, objective: PolicyObjective, samples: int, provenance: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Return what can be said of the training before its first step, for a report on it while it goes on."""
        policy = objective.outcome
        return {
            "total_steps": self.preset.total_steps(samples),
            "description": description_of(policy),
            "parameters": parameters_by_part(policy),
            "nfe": policy.nfe,
            "packages": package_versions(),
            "provenance": self._record(run, FitResult(0, math.nan, math.nan, 0), provenance),
        }

    def _say(self, line: str) -> None:
        if self.fabric.is_global_zero:
            self.console.print(line, highlight=False, soft_wrap=True)


def _is_done(run: RunFolder) -> bool:
    """Return whether the checkpoint of this run stands; raise OutputExistsError where another's does."""
    if not run.out.exists() or (run.out.is_dir() and not any(run.out.iterdir())):
        return False
    try:
        maker = read_manifest(run.out)["provenance"].get("run")
    except CheckpointError as e:
        raise OutputExistsError(
            f"{run.out} already holds something else: choose another --out, or delete it first"
        ) from e
    if maker != run.fingerprint:
        raise OutputExistsError(
            f"{run.out} already holds another run's checkpoint: choose another --out, or delete it first"
        )
    return True
