"""The command lines that make a training again: as it was given, or put together from what is recorded."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from manicm_ms.errors import ManicmError
from manicm_ms.training.history import History
from manicm_ms.training.presets import STUDENT_PRESETS, TRAINING, preset_for

_GIVEN = ("manicm-ms train ", "manicm-ms distill ")
_FORMER = {"mu": "ema_decay", "skip": "solver_stride"}
_DISTILLED_FROM = "quick"  # a distillation does not say what its preset was called


def training_command(history: History) -> str:
    """Return the command that makes this training again: the recorded one where it is one of the command line.

    A job of a benchmark, or a call from Python, is put together from the fields of its preset; "" where a former
    version recorded too little for that.
    """
    given = str(history.provenance.get("command", ""))
    if given.startswith(_GIVEN):
        return given
    try:
        return shlex.join(_words(history))
    except (ManicmError, KeyError, TypeError):
        return ""


def _words(history: History) -> list[str]:
    made, preset = history.provenance, history.provenance["preset"]
    data = [store["path"] for store in made["data"].get("stores", [made["data"]])]
    if "teacher" in made:
        words = ["distill", "--teacher", made["teacher"]["path"]]
        start: Any = STUDENT_PRESETS.get(_DISTILLED_FROM)
        name = _DISTILLED_FROM
    else:
        method, name = history.description["policy"], preset["size"]
        words, start = ["train", method], preset_for(method, name)
    words += ["--data", *data, "--out", str(history.out), "--preset", name, "--seed", str(made["seed"])]
    now = {_FORMER.get(key, key): value for key, value in preset.items()} | {"precision": made["precision"]}
    return ["manicm-ms", *words, *_overrides(now, asdict(start))]


def _overrides(now: Mapping[str, Any], start: Mapping[str, Any]) -> Iterator[str]:
    for key, value in now.items():
        if key not in ("size", "changes") and _plain(value) != _plain(start[key]):
            yield from ("--set", f"{TRAINING}.{key}={_written(value)}")
    for path, value in flat(now.get("changes", {})).items():
        yield from ("--set", f"{path}={_written(value)}")


def flat(nested: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return dotted key -> value of nested sections, in their order."""
    found: dict[str, Any] = {}
    for key, value in nested.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found


def collection_commands(data: Mapping[str, Any]) -> list[str]:
    """Return the commands that collect the demonstrations of a training anew, each with the place of its store."""
    commands = []
    for store in data.get("stores", [data]):
        command = (store.get("collection") or {}).get("command")
        if command and store.get("path"):
            commands.append(f"{command} --out {shlex.quote(str(Path(store['path'])))}")
    return commands


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _written(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ",".join(map(_written, value))
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
