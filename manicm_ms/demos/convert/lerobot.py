"""To a LeRobotDataset (format v3.0), written by lerobot's own class in an interpreter of lerobot's own.

lerobot pins an older torch than ours, so the two share no environment.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from manicm_ms.demos.convert.base import EXPORTERS, SIDECAR, Export, MissingDependencyError, Tally
from manicm_ms.demos.convert.writer import Writer
from manicm_ms.demos.layout import Episode, frame_shapes
from manicm_ms.errors import ConfigError
from manicm_ms.paths import write_json
from manicm_ms.spec import EnvSpec

PYTHON_VARIABLE = "MANICM_MS_LEROBOT_PYTHON"
"""Environment variable that names the interpreter that has lerobot."""

KEYS = {
    "agent_pos": "observation.state",
    "point_cloud": "observation.point_cloud",
    "image": "observation.images.camera",
    "depth": "observation.depth",
    "privileged_state": "observation.environment_state",
    "voxel_grid": "observation.voxel_grid",
    "action": "action",
}
"""Field of `Episode` -> feature of the data set."""
SUCCESS, DONE = "next.success", "next.done"


@EXPORTERS.register("lerobot")
def export(job: Export) -> Tally:
    """Write the data set, with env spec, provenance, seeds and success beside LeRobot's own metadata.

    Raises MissingDependencyError without an interpreter that has lerobot, ConfigError where the control rate is not a
    whole number, ManicmError where lerobot fails.
    """
    python = lerobot_python()
    spec = job.store.spec
    if spec.action.control_hz != int(spec.action.control_hz):
        raise ConfigError(f"LeRobot's fps is a whole number, {spec.env_id} runs at {spec.action.control_hz} Hz")
    job.require_space()
    description = {
        "repo_id": f"manicm_ms/{job.out.name}",
        "fps": int(spec.action.control_hz),
        "robot_type": spec.env_id.partition("/")[0],
        "features": features(spec, job.store.fields),
        "task": job.task,
    }
    tally = Tally()
    with Writer("lerobot", python, job.folder, description) as writer:
        for episode in job.episodes():
            writer.send(_frames(episode, job.store.fields))
            tally.add(episode)
    write_json(job.folder / "meta" / SIDECAR, job.about())
    return tally


def features(spec: EnvSpec, fields: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return LeRobot's description of each feature: type, shape of a frame, and what its entries are called."""
    names: dict[str, list[str]] = {
        "agent_pos": list(spec.agent_pos_names),
        "action": list(spec.action.names),
        "point_cloud": ["point", "channel"],
        "image": ["height", "width", "channel"],
        "depth": ["height", "width"],
        "voxel_grid": ["channel", "x", "y", "z"],
        "privileged_state": [f"{n}_{k}" for n, (low, high) in spec.state_layout.items() for k in range(high - low)],
    }
    described: dict[str, dict[str, Any]] = {}
    for field in fields:
        shape, dtype = frame_shapes(spec)[field]
        kind = "image" if field == "image" else dtype.name
        described[KEYS[field]] = {"dtype": kind, "shape": list(shape), "names": names[field]}
    for name in (SUCCESS, DONE):
        described[name] = {"dtype": "bool", "shape": [1], "names": None}
    return described


def lerobot_python() -> str:
    """Return the interpreter that has lerobot; raise MissingDependencyError saying how to make one.

    Looked for: what MANICM_MS_LEROBOT_PYTHON names; the virtual environment beside ours whose name ends in "-lerobot";
    our own interpreter.
    """
    named, beside = os.environ.get(PYTHON_VARIABLE), Path(f"{sys.prefix}-lerobot")
    for python in (named,) if named else (str(beside / "bin" / "python"), sys.executable):
        if _has_lerobot(python):
            return python
    remedy = f"python -m venv {beside} && {beside}/bin/pip install lerobot (it pins another torch than this package)"
    if named:
        remedy = f"{PYTHON_VARIABLE} names {named}, which has none; unset it, or {remedy}"
    raise MissingDependencyError("lerobot", "lerobot", remedy)


def _has_lerobot(python: str) -> bool:
    look = "import importlib.util, sys; sys.exit(importlib.util.find_spec('lerobot') is None)"
    try:
        return subprocess.run([python, "-I", "-c", look], capture_output=True).returncode == 0
    except OSError:  # no such file, or not one that can be run
        return False


def _frames(episode: Episode, fields: tuple[str, ...]) -> dict[str, np.ndarray]:
    last = np.zeros((len(episode), 1), bool)
    last[-1] = True
    return {KEYS[name]: getattr(episode, name) for name in fields} | {SUCCESS: last & episode.success, DONE: last}
