"""Options of the command line for configuration keys, and the identity of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

from manicm_ms.policies.action_policy import NormalizerConfig, read_parts
from manicm_ms.policies.backbones.backbone import BACKBONES
from manicm_ms.policies.configuration import NAME, Nested, lookup
from manicm_ms.policies.encoders.cloud_crop import CropConfig
from manicm_ms.policies.encoders.encoder import ENCODERS
from manicm_ms.policies.encoders.transform import TRANSFORMS
from manicm_ms.policies.heads.head import HEADS
from manicm_ms.policies.methods import METHODS
from manicm_ms.training.optim import FitConfig
from manicm_ms.training.presets import CHUNK, TeacherPreset

FLAGS: Mapping[str, str] = {
    "n_obs_steps": "chunk.n_obs_steps",
    "horizon": "chunk.horizon",
    "n_action_steps": "chunk.n_action_steps",
    "prediction_type": "head.prediction_type",
    "cloud_frame": "inputs.cloud_frame.frame",
    "cloud_scale": "inputs.cloud_frame.scale",
    "points": "inputs.points.max_points",
    "acting_points": "inputs.points.acting",
    "training_points": "inputs.points.training",
    "min_state_range": "normalizer.min_state_range",
    "down_dims": "backbone.down_dims",
}
"""Options of the command line that stand for a key of the configuration."""


def flag_values(method: str, preset: TeacherPreset) -> dict[str, Any]:
    """Return what a training would use for each of `FLAGS`: None where the method has no such key."""
    return _flags_of(preset.configuration(method))


def _flags_of(config: Nested) -> dict[str, Any]:
    defaults = _defaults(config)
    values = {}
    for flag, path in FLAGS.items():
        try:
            values[flag] = lookup(config, path)
        except KeyError:
            values[flag] = defaults.get(path)
    return values


def _defaults(config: Nested) -> dict[str, Any]:
    """Return dotted path -> default of each field of the parts that a configuration names."""
    kinds: dict[str, Any] = {"normalizer": NormalizerConfig}
    for key, registry in (("encoder", ENCODERS), ("backbone", BACKBONES), ("head", HEADS)):
        if config.get(key):
            kinds[key] = registry.get(config[key][NAME]).Config
    kinds |= {f"inputs.{name}": TRANSFORMS.get(name).Config for name in config["inputs"] or {}}
    return {f"{key}.{f.name}": f.default for key, kind in kinds.items() for f in fields(kind)}


_ADDED_LATER = {"acting_points": "prefix", "training_points": "random", "min_state_range": 0.0}
"""Options that came after runs were made without them, with what those runs did."""
_PARTS_ADDED_LATER = {"cloud_crop": CropConfig()}
"""Transforms that rows came to name after runs were made without them, with fields that change nothing."""
_FIRST_METHODS = ("dp3", "simple_dp3")
"""Methods that runs were made with before there was a table: their identity says how a run departs from the row."""
_FORMER = {"ema_decay": "mu", "solver_stride": "skip"}
"""Fields by the names that they had when the first runs were made."""


def preset_identity(preset: FitConfig, method: str | None = None) -> dict[str, Any]:
    """Return what tells one preset from another, JSON values.

    It uses the field names of the first release: what was flat then is flat, and what came later is left out where it
    says what was done before. So older runs keep their identity: they go on, or are found finished.

    Args:
        preset: of a training or a distillation.
        method: what is trained on demonstrations; None for a distillation.
    """
    values = {_FORMER.get(k, k): v for k, v in asdict(preset).items() if k not in ("size", "changes")}
    if isinstance(preset, TeacherPreset) and method is not None:
        values |= _policy_identity(preset, method)
    return {k: v for k, v in values.items() if not (k in _ADDED_LATER and v == _ADDED_LATER[k])}


def _policy_identity(preset: TeacherPreset, method: str) -> dict[str, Any]:
    config, published = preset.configuration(method), {CHUNK: {}, **METHODS.get(method).configuration()}
    flags = _flags_of(config)
    if _lists(flags["down_dims"]) == _lists(_flags_of(published)["down_dims"]):
        flags["down_dims"] = None  # the method's own
    if method in _FIRST_METHODS and (rest := _without_flags(config)) == _without_flags(published):
        return flags
    if method in _FIRST_METHODS:
        return {**flags, "configuration": rest}
    return {CHUNK: config[CHUNK], "configuration": _resolved(config), "objective": METHODS.get(method).objective}


def _resolved(config: Nested) -> dict[str, Any]:
    """Return every field of every part, JSON values: it stays true whatever the row and the defaults become."""
    parts = read_parts({key: value for key, value in config.items() if key != CHUNK})
    named = {"encoder": parts.encoder, "backbone": parts.backbone, "head": parts.head, **parts.inputs}
    told = {key: None if part is None else [part[0].__qualname__, asdict(part[1])] for key, part in named.items()}
    idle = [key for key, fields in _PARTS_ADDED_LATER.items() if key in parts.inputs and parts.inputs[key][1] == fields]
    return {key: value for key, value in told.items() if key not in idle} | {"normalizer": asdict(parts.normalizer)}


def _lists(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _without_flags(config: Nested, prefix: str = "") -> dict[str, Any]:
    """Return what a configuration says beside `FLAGS`."""
    rest = {}
    for key, value in config.items():
        path = f"{prefix}{key}"
        if isinstance(value, Mapping):
            rest[key] = _without_flags(value, f"{path}.")
        elif path not in FLAGS.values():
            rest[key] = _lists(value)
    return rest
