"""Evaluations of a training's checkpoints: finished ones that are named, and those of a benchmark beside it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.contestants import evaluations_asked
from manicm_ms.evaluation.protocol import CONTROL
from manicm_ms.evaluation.records import RUN_FILE
from manicm_ms.evaluation.results import renewed
from manicm_ms.evaluation.text import HEADERS, episodes_title, paired_sentences, realism_sentence, rows

_MARK = " (this one)"


class Point(NamedTuple):
    """Success of the checkpoint after `step` steps: `successes` of `n` episodes."""

    step: int
    n: int
    successes: int


class Evaluation(NamedTuple):
    """A finished evaluation in which a checkpoint of the training was played.

    Attributes:
        path: its folder.
        title: what was played.
        headers: of its table.
        rows: a policy each, those of this training marked.
        sentences: what the paired comparison says.
        command: that made it.
        points: what the training's checkpoints reached with their own number of network evaluations.
    """

    path: Path
    title: str
    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    sentences: Sequence[str]
    command: str
    points: Sequence[Point]


def named_evaluation(folder: Path, checkpoints: Mapping[str, int]) -> Evaluation:
    """Return a finished evaluation.

    Args:
        folder: that `manicm-ms evaluate` wrote.
        checkpoints: SHA-256 of a manifest -> steps, of the checkpoints that are asked for.

    Raises ConfigError where it is not there, not finished, damaged, or of other checkpoints.
    """
    results, request = (_read(Path(folder) / name) for name in ("results.json", RUN_FILE))
    try:
        return _named(Path(folder), results, request, checkpoints)
    except (KeyError, TypeError, AttributeError, ValueError, IndexError) as error:
        why = f"{type(error).__name__}: {error}"
        raise ConfigError(
            f"{folder} cannot be read as an evaluation's ({why}): evaluate again, or leave it out"
        ) from error


def _named(
    folder: Path, results: Mapping[str, Any], request: Mapping[str, Any], checkpoints: Mapping[str, int]
) -> Evaluation:
    digests = [digest for _, _, digest in request.get("policies", [])]
    steps = [checkpoints.get(digest) for digest in digests]
    found = renewed(results)
    if len(steps) != len(found.get("policies", [])) or all(step is None for step in steps):
        names = ", ".join(str(p.get("checkpoint")) for p in found.get("policies", []))
        raise ConfigError(f"{folder} is no evaluation of this training's checkpoint: it played {names or 'nothing'}")
    policies, table = found["policies"], rows(found)
    marked = [(row.name + ("" if step is None else _MARK), *row[1:]) for row, step in zip(table, steps, strict=True)]
    points = [
        Point(step, policy["n"], policy["successes"])
        for policy, step in zip(policies, steps, strict=True)
        if step is not None and policy["role"] != CONTROL and not evaluations_asked(policy["name"])
    ]
    sentences = [*filter(None, [realism_sentence(found)]), *paired_sentences(found)]
    title = f"{found['env_id']}: {episodes_title(found)}, {found['seeds'][0]} to {found['seeds'][-1]}."
    return Evaluation(folder, title, HEADERS, marked, sentences, found["command"], points)


def evaluations_of(checkpoint: Path) -> list[Point]:
    """Return what a benchmark with `--evaluations` found of the checkpoints on the way to this one of its jobs."""
    path = checkpoint.parent / "judge.json"
    if checkpoint.name != "checkpoint" or not path.is_file():
        return []
    return [Point(e["step"], e["n"], e["successes"]) for e in _read(path).get("evaluations", [])]


def _read(path: Path) -> dict[str, Any]:
    try:
        value: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path.parent} is no finished evaluation: it has no {path.name}") from None
    except ValueError as error:
        raise ConfigError(f"{path} is not readable JSON ({error}): evaluate again") from error
    return value
