"""What a training run leaves on disk beside its checkpoint: its identity, its resumable state, its log.

::

    runs/teacher/                the checkpoint, written once, at the end
    runs/teacher.train/
      run.json                   what is being trained: the same identity may go on, another may not
      record.json                what is known at the start: configuration, data, command, number of steps
      state.safetensors          the latest training state, one file, replaced atomically; gone at the end
      log.jsonl                  a line every few steps
      tensorboard/               the same numbers
      snapshots/00000150/        a checkpoint after so many steps, only where asked for
      lock                       held by the process that trains
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from manicm_ms.errors import CheckpointError, NoSpaceError, OutputExistsError
from manicm_ms.paths import exclusive_lock, is_disk_full, write_json

RUN_FILE, RECORD_FILE = "run.json", "record.json"


def fingerprint(identity: Mapping[str, Any]) -> str:
    """Return a short hash of `identity` (JSON values).

    Equal identities train to equal weights on one kind of device with one number of processes; neither of the two
    is part of it, so that a run may go on elsewhere.
    """
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]


def _differences(old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = "") -> list[str]:
    found = []
    for key in sorted(old.keys() | new.keys()):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            found += _differences(a, b, f"{prefix}{key}.")
        elif a != b:
            found.append(f"{prefix}{key} {a!r} there, {b!r} now")
    return found


class RunFolder:
    """The training folder of one checkpoint folder; made by `open_run`.

    Attributes:
        out: where the checkpoint goes.
        folder: `<out>.train`.
        identity: what is being trained, JSON values.
    """

    def __init__(self, out: Path, identity: Mapping[str, Any]) -> None:
        self.out = out
        self.folder = training_folder(out)
        self.identity = json.loads(json.dumps(identity))  # tuples become lists, as they will be read back
        self._state = self.folder / "state.safetensors"

    @property
    def fingerprint(self) -> str:
        """Short hash of the identity; a finished checkpoint's provenance carries it."""
        return fingerprint(self.identity)

    @property
    def log_path(self) -> Path:
        """JSON lines, one for each logged step."""
        return self.folder / "log.jsonl"

    def claim(self) -> None:
        """Write the identity, or raise OutputExistsError where another run's stands there."""
        path = self.folder / RUN_FILE
        if not path.exists():
            write_json(path, self.identity)
            return
        try:
            there = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            raise OutputExistsError(
                f"{path} is damaged, so it cannot be told what {self.folder} holds: choose another --out, or delete it"
            ) from None
        if differences := _differences(there, self.identity):
            raise OutputExistsError(
                f"{self.out} already holds another run ({'; '.join(differences[:3])}): choose another --out, "
                f"or delete {self.out} and {self.folder} to start over"
            )

    def note(self, record: Mapping[str, Any]) -> None:
        """Write down what is known before the first step, JSON values; a run that goes on says it anew."""
        write_json(self.folder / RECORD_FILE, record)

    def save_state(self, tensors: Mapping[str, Tensor], meta: Mapping[str, Any]) -> None:
        """Replace the training state; a kill at any moment leaves the old or the new one, whole.

        Args:
            tensors: of any device; written as they are, bit for bit.
            meta: JSON values.

        Raises NoSpaceError on a full disk; the previous state stays.
        """
        fresh = self._state.with_suffix(".partial")
        # One file for both, so that no kill can pair the tensors of one step with the numbers of another.
        header = {"meta": json.dumps(meta, allow_nan=False)}
        try:
            save_file({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, fresh, metadata=header)
            with fresh.open("rb") as f:
                os.fsync(f.fileno())
            os.replace(fresh, self._state)
        except (OSError, SafetensorError) as e:
            fresh.unlink(missing_ok=True)
            if is_disk_full(e):
                raise NoSpaceError(
                    f"no space left for the training state in {self.folder}; the one saved before is whole: "
                    "free some space and run the same command again"
                ) from e
            raise

    def load_state(self) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        """Return what `save_state` last got, on the CPU, or None where nothing was saved yet."""
        if not self._state.exists():
            return None
        try:
            with safe_open(self._state, framework="pt") as f:
                return {k: f.get_tensor(k) for k in f.keys()}, json.loads(f.metadata()["meta"])  # noqa: SIM118
        except (SafetensorError, KeyError, TypeError, json.JSONDecodeError) as e:
            raise CheckpointError(f"{self._state} is damaged ({e}): delete it to train from the beginning") from e

    def drop_state(self) -> None:
        """Remove the training state, once the checkpoint is written; identity and log stay."""
        self._state.unlink(missing_ok=True)
        self._state.with_suffix(".partial").unlink(missing_ok=True)


def training_folder(out: Path) -> Path:
    """Return the folder of the training state that belongs to checkpoint folder `out`."""
    return out.with_name(out.name + ".train")


def snapshot_folder(out: Path, step: int) -> Path:
    """Return where the checkpoint after `step` steps is kept while `out` is trained."""
    return _snapshots(out) / f"{step:08d}"


def snapshot_folders(out: Path) -> dict[int, Path]:
    """Return steps -> checkpoint folder of the snapshots that the training of `out` has left so far."""
    folder = _snapshots(out)
    found = sorted(p for p in folder.iterdir() if p.name.isdecimal()) if folder.is_dir() else []
    return {int(p.name): p for p in found}


def _snapshots(out: Path) -> Path:
    return training_folder(out) / "snapshots"


@contextmanager
def open_run(out: Path, identity: Mapping[str, Any]) -> Iterator[RunFolder]:
    """Yield the run folder of checkpoint folder `out` and hold its lock.

    Raises OutputExistsError where another run stands there, or the same one is under way in another process.
    """
    run = RunFolder(out, identity)
    run.folder.mkdir(parents=True, exist_ok=True)

    def refuse(holder: str) -> OutputExistsError:
        return OutputExistsError(f"{out} is being trained by process {holder}: wait for it, or choose another --out")

    with exclusive_lock(run.folder / "lock", refuse):
        run.claim()
        yield run


def pack_optimizer(optimizer: torch.optim.Optimizer) -> tuple[dict[str, Tensor], list[dict[str, Any]]]:
    """Return an optimizer's state as named tensors and the JSON values of its parameter groups."""
    state = optimizer.state_dict()
    tensors = {f"{i}.{name}": value for i, entry in state["state"].items() for name, value in entry.items()}
    return tensors, state["param_groups"]


def unpack_optimizer(
    optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor], groups: list[dict[str, Any]]
) -> None:
    """Restore what `pack_optimizer` returned."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = value
    optimizer.load_state_dict({"state": state, "param_groups": groups})
