"""How the demonstrations of a store came about: the command, and what must be the same to go on with it."""

from __future__ import annotations

import reprlib
import shlex
from collections.abc import Mapping
from typing import Any

from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.env_request import EnvRequest
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import StoreError
from manicm_ms.spec import VOXEL_SIZE, EnvSpec

IDENTITY = (
    "env_id", "seed", "expert", "style", "tail_steps", "fields", "point_channels", "backend", "realism",
    "realism_ranges", "camera", "success_steps", "obs_preset", "voxel_size",
)  # fmt: skip
_UNRECORDED: Mapping[str, Any] = {
    "realism": "clean", "realism_ranges": None, "camera": None, "success_steps": 1, "obs_preset": "manicm_ms",
}  # fmt: skip
"""What stores mean that were made before they recorded it."""
_BRIEF = reprlib.Repr()
_BRIEF.maxstring = 100  # names stay whole, a camera's matrix does not


def require_same_origin(store: DemoStore, asked: Mapping[str, Any], spec: EnvSpec | None = None) -> None:
    """Raise StoreError where the store's data came about otherwise than is asked for now."""
    has = {**_UNRECORDED, **store.provenance}
    for key in IDENTITY:
        if key in asked and has.get(key) != asked[key]:
            key, theirs, ours = _first_difference(key, has.get(key), asked[key])
            raise StoreError(
                f"{store.path} holds demonstrations with {key} {_BRIEF.repr(theirs)} where {_BRIEF.repr(ours)} is "
                "asked for: choose another --out, or the same options as before to go on"
            )
    if spec is not None and store.spec != spec:
        raise StoreError(
            f"{store.path} was collected with other specs of {spec.env_id} than it has now: choose another --out"
        )


def _first_difference(name: str, theirs: Any, ours: Any) -> tuple[str, Any, Any]:
    """Return name and both values of the first entry that differs, within mappings as that of a camera."""
    if not (isinstance(theirs, Mapping) and isinstance(ours, Mapping)):
        return name, theirs, ours
    key = next(key for key in sorted({*theirs, *ours}) if theirs.get(key) != ours.get(key))
    return _first_difference(f"{name}.{key}", theirs.get(key), ours.get(key))


def collect_command(asked: Mapping[str, Any], episodes: int, extras: tuple[str, ...], env: EnvRequest) -> str:
    """Return the command that makes the same data (the number of environments has no part in it)."""
    words = ["manicm-ms", "collect", asked["env_id"], "--episodes", episodes, "--seed", asked["seed"]]
    words += ["--style", asked["style"], "--backend", asked["backend"]]
    tail = asked["tail_steps"]
    words += ["--tail-steps", tail] if tail != ENVS.get(asked["env_id"]).demos.tail_steps else []
    words += env.options()
    words += ["--extras", *extras] if extras else []
    size = asked.get("voxel_size", VOXEL_SIZE)
    words += ["--voxel-size", size] if size != VOXEL_SIZE else []
    return shlex.join(str(w) for w in words)
