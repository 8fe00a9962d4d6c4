"""To a Minari data set (Farama), written by Minari's own storage class.

Minari wants what followed the last action too, which a store does not hold: the last observation
stands there twice. Rewards are the sparse ones: 1 at the end of a solved episode, else 0.
"""

from __future__ import annotations

import os
import re
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from manicm_ms.demos.convert.base import EXPORTERS, SIDECAR, Export, MissingDependencyError, Tally
from manicm_ms.demos.convert.writer import Writer
from manicm_ms.demos.layout import Episode, frame_shapes
from manicm_ms.errors import ConfigError
from manicm_ms.paths import write_json
from manicm_ms.spec import EnvSpec

_NAME = re.compile(r"[-_\w]+-v\d+")
REMEDY = "pip install 'manicm_ms[minari]'"


@EXPORTERS.register("minari")
def export(job: Export) -> Tally:
    """Write `data/` in Minari's HDF5 format, pictures without loss, and env spec and provenance beside it.

    Raises MissingDependencyError without minari, ConfigError where the output's name is no id of a Minari data set.
    """
    if find_spec("minari") is None:
        raise MissingDependencyError("minari", "minari", REMEDY)
    spec, provenance = job.store.spec, job.store.provenance
    metadata = {
        "dataset_id": _dataset_id(job.out),
        "algorithm_name": f"{provenance.get('expert')}, {provenance.get('style')}",
        "description": f"{job.task} ({spec.env_id}); the last observation of an episode stands there twice",
    }
    job.require_space()
    tally = Tally(notes=["the last observation of each episode is repeated, rewards are sparse"])
    description = {"metadata": metadata, "spaces": spaces(spec, job.store.fields)}
    with Writer("minari", sys.executable, job.folder, description) as writer:
        for episode in job.episodes():
            writer.send(_arrays(episode, job.store.fields))
            tally.add(episode)
    write_json(job.folder / SIDECAR, job.about())
    return tally


def spaces(spec: EnvSpec, fields: tuple[str, ...]) -> dict[str, Any]:
    """Return (low, high, shape, type) of a frame of each field."""
    bounds = {"action": (-1.0, 1.0), "image": (0, 255), "voxel_grid": (0, 255)}
    return {
        name: (*bounds.get(name, (-np.inf, np.inf)), shape, dtype.name)
        for name, (shape, dtype) in frame_shapes(spec).items()
        if name in fields
    }


def _arrays(episode: Episode, fields: tuple[str, ...]) -> dict[str, Any]:
    ends = np.zeros(len(episode), bool)
    ends[-1] = True
    frames = {name: getattr(episode, name) for name in fields}
    seen = {name: np.concatenate([v, v[-1:]]) for name, v in frames.items() if name != "action"}  # (L + 1, ...)
    return {
        **seen,
        "action": episode.action,
        "reward": (ends & episode.success).astype(np.float32),
        "termination": ends & episode.success,
        "truncation": ends & (not episode.success),
        "seed": episode.seed,
        "success": episode.success,
    }


def _dataset_id(out: Path) -> str:
    """Return the id that Minari will know `out` by: its path below Minari's folder, elsewhere its name."""
    root = Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets").absolute()
    out = out.absolute()
    if not _NAME.fullmatch(out.name):
        raise ConfigError(
            f"{out.name!r} is no id of a Minari data set: let --out end in a name with a version, like slide-block-v0"
        )
    return out.relative_to(root).as_posix() if out.is_relative_to(root) else out.name
