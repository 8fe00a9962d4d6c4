"""What a training has left on disk, finished or still under way: read for a report, never changed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manicm_ms.errors import CheckpointError
from manicm_ms.paths import sha256
from manicm_ms.policies.checkpoint import description_of, load_checkpoint, read_manifest
from manicm_ms.policies.parameter_counts import parameters_by_part
from manicm_ms.training.log import read_log
from manicm_ms.training.run_folder import RECORD_FILE, RUN_FILE, fingerprint, snapshot_folders, training_folder

_MANIFEST = "manifest.json"


@dataclass(frozen=True)
class History:
    """One training.

    Attributes:
        out: its checkpoint folder, there or not yet.
        finished: whether the checkpoint is there.
        description: what config.json holds: `policy`, `config`, `env_spec`, `chunk`; the configuration is empty where a
            run under way was begun before it was written down.
        provenance: as in the manifest; of a run under way what was known at its start.
        parameters: part -> number of weights; empty where that is not known yet.
        nfe: network evaluations of a decision; None where that is not known yet.
        packages: name -> version.
        step: optimizer steps done, as far as log or checkpoint tell; None where a checkpoint does not say.
        total_steps: that there will be; None where that is not known yet.
        log: lines of log.jsonl; None where the training folder is not there, or another run's.
        checkpoints: SHA-256 of a manifest -> steps, of this training's checkpoint and of what it kept on the way.
    """

    out: Path
    finished: bool
    description: Mapping[str, Any]
    provenance: Mapping[str, Any]
    parameters: Mapping[str, int]
    nfe: int | None
    packages: Mapping[str, str]
    step: int | None
    total_steps: int | None
    log: Sequence[Mapping[str, float]] | None
    checkpoints: Mapping[str, int]


def read_history(out: Path) -> History:
    """Return what is known of the training of checkpoint folder `out`.

    Raises:
        CheckpointError: there is neither a checkpoint nor a training of it, or one of its files is damaged.
    """
    out = Path(out)
    folder = training_folder(out)
    if (out / _MANIFEST).is_file():
        return _finished(out, folder)
    if not (folder / RUN_FILE).is_file():
        read_manifest(out)  # says what is wrong with the folder
        raise CheckpointError(f"there is no checkpoint {out} and no training folder {folder}: check the path")
    return _under_way(out, folder)


def _finished(out: Path, folder: Path) -> History:
    manifest, policy = read_manifest(out), load_checkpoint(out)
    provenance = manifest["provenance"]
    steps = provenance.get("steps")
    run = _read(folder / RUN_FILE)
    ours = run is not None and fingerprint(run) == provenance.get("run")
    return History(
        out, True, description_of(policy),
        provenance, parameters_by_part(policy), policy.nfe, manifest.get("packages", {}), steps, steps,
        read_log(folder / "log.jsonl") if ours else None,
        {**_kept(out), sha256(out / _MANIFEST): steps or 0},
    )  # fmt: skip


def _under_way(out: Path, folder: Path) -> History:
    run, record = _read(folder / RUN_FILE) or {}, _read(folder / RECORD_FILE) or {}
    log = read_log(folder / "log.jsonl")
    known: dict[str, Any] = {key: run[key] for key in ("kind", "seed", "precision", "preset") if key in run}
    known["data"] = {"sha256": run.get("data"), "env_id": run.get("env_spec", {}).get("env_id")}
    described: dict[str, Any] = {"policy": run.get("policy", run.get("kind")), "config": {}}
    described |= {key: run[key] for key in ("env_spec", "chunk") if key in run}
    return History(
        out, False, record.get("description", described), record.get("provenance", known),
        record.get("parameters", {}), record.get("nfe"), record.get("packages", {}),
        int(log[-1]["step"]) if log else 0, record.get("total_steps", run.get("preset", {}).get("steps")), log,
        _kept(out),
    )  # fmt: skip


def _kept(out: Path) -> dict[str, int]:
    """Return the checkpoints that were kept on the way, by the digest that an evaluation knows them by."""
    folders = snapshot_folders(out).items()
    return {sha256(path / _MANIFEST): step for step, path in folders if (path / _MANIFEST).is_file()}


def _read(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        value: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise CheckpointError(f"{path} is damaged ({error}): delete it, or train again with another --out") from error
    return value
