"""Policies of finished evaluations, read back from their records to be compared without being played again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from manicm_ms.errors import ConfigError, NotComparableError
from manicm_ms.evaluation.pairs import states_differ
from manicm_ms.evaluation.policies import AskedCheckpoint
from manicm_ms.evaluation.protocol import CLEAN, CONTROL
from manicm_ms.evaluation.records import RUN_FILE
from manicm_ms.evaluation.rollout import EpisodeResult

RESULTS_FILE, MANIFEST_FILE = "results.json", "manifest.json"


@dataclass(frozen=True)
class Contestant:
    """One policy of a comparison.

    Attributes:
        name: its name in the comparison.
        source: folder of the evaluation that it was played in; that of the checkpoint before it was played.
        role: as in the evaluation.
        checkpoint: where it was loaded from.
        identity: what tells it from other policies; None where the records do not hold it.
        env_id: the environment.
        conditions: what else fixes how an episode starts: realism preset, camera.
        stopped_when_decided: whether the data decided how many episodes were played.
        episodes: seed -> result, without its actions.
    """

    name: str
    source: str
    role: str
    checkpoint: str
    identity: tuple[str, ...] | None
    env_id: str
    conditions: Mapping[str, Any]
    stopped_when_decided: bool
    episodes: Mapping[int, EpisodeResult]

    @property
    def pending(self) -> bool:
        """Whether it is a checkpoint that is still to be played: its episodes hold no outcomes yet."""
        return self.source == self.checkpoint

    @property
    def place(self) -> str:
        """Its name with its folder, for messages."""
        return self.name if self.source in self.name else f"{self.name} ({self.source})"

    def results(self, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Return the results of `seeds`, in their order."""
        return [self.episodes[seed] for seed in seeds]


def is_checkpoint(folder: Path) -> bool:
    """Return whether FOLDER, or that of FOLDER@N, holds a checkpoint.

    Raises ConfigError where it holds no finished evaluation either.
    """
    if (AskedCheckpoint.read(folder).folder / MANIFEST_FILE).is_file():
        return True
    if (folder / RESULTS_FILE).is_file():
        return False
    if (folder / RUN_FILE).is_file():
        raise ConfigError(f"{folder} holds an evaluation that was stopped: give its 'evaluate' command again first")
    kind = "holds neither a checkpoint nor a finished evaluation" if folder.exists() else "does not exist"
    raise ConfigError(f"{folder} {kind}: name a folder that 'train', 'distill' or 'evaluate' has written")


def read_evaluation(folder: Path) -> list[Contestant]:
    """Return the policies of a finished evaluation with the episodes of its first realism preset.

    Raises ConfigError where its files are damaged.
    """
    try:
        results = json.loads((folder / RESULTS_FILE).read_text(encoding="utf-8"))
        file = folder / RUN_FILE
        run = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
        return _contestants(folder, results, run)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise ConfigError(
            f"{folder / RESULTS_FILE} cannot be read as an evaluation's ({type(error).__name__}: {error}): give its "
            "'evaluate' command again, or leave the folder out"
        ) from error


def _contestants(folder: Path, results: Mapping[str, Any], run: Mapping[str, Any]) -> list[Contestant]:
    presets = results["realism"]["presets"] if "realism" in results else [CLEAN]
    identities: Mapping[str, tuple[str, ...]] = {
        name: (place if place == CONTROL else "", digest, evaluations_asked(name))
        for name, place, digest in run.get("policies", ())
        if digest
    }
    return [
        Contestant(
            policy["name"],
            str(folder),
            policy["role"],
            policy["checkpoint"],
            identities.get(policy["name"]),
            results["env_id"],
            conditions(presets[0], run),
            "until_decided" in results,
            {e["seed"]: EpisodeResult.from_summary(e) for e in policy["episodes"]},
        )
        for policy in results["policies"]
    ]


def evaluations_asked(name: str) -> str:
    """Return the N of a policy called CHECKPOINT@N, "" of any other: one digest, and another policy."""
    number = name.split(",", 1)[0].rpartition("@")[2]  # "CHECKPOINT@N, one step" is the control
    return number if number.isdecimal() and "@" in name else ""


def conditions(preset: str, run: Mapping[str, Any]) -> dict[str, Any]:
    """Return what fixes how an episode starts beside environment and seed.

    Args:
        preset: name of the realism preset.
        run: what identifies the evaluation in its folder.
    """
    plain = json.loads(json.dumps({key: run.get(key) for key in ("realism", "camera")}))
    ranges = None if plain["realism"] is None else plain["realism"][0][1]
    return {"realism preset": preset, "ranges of the realism preset": ranges, "camera": plain["camera"]}


def with_distinct_names(contestants: Sequence[Contestant]) -> list[Contestant]:
    """Return the policies, those of one name with the folder of their evaluation behind it."""
    names = [c.name for c in contestants]
    return [c if names.count(c.name) == 1 else replace(c, name=f"{c.name} ({c.source})") for c in contestants]


def without_twins(contestants: Sequence[Contestant]) -> tuple[list[Contestant], list[str]]:
    """Leave out policies that stand there already with the same outcomes, as the teacher of two students does.

    Returns the others, and a remark for each that was left out.
    """
    kept: list[Contestant] = []
    remarks = []
    for contestant in contestants:
        twin = next((c for c in kept if _same(c, contestant)), None)
        if twin is None:
            kept.append(contestant)
        else:
            remarks.append(f"{contestant.name} of {contestant.source} is that of {twin.source}, and shown once.")
    return kept, remarks


def _same(a: Contestant, b: Contestant) -> bool:
    common = a.episodes.keys() & b.episodes.keys()
    alike = a.identity is not None and (a.identity, a.env_id, a.conditions) == (b.identity, b.env_id, b.conditions)
    return alike and len(common) > 0 and all(a.episodes[seed] == b.episodes[seed] for seed in common)


def common_seeds(contestants: Sequence[Contestant]) -> list[int]:
    """Return the seeds from which every policy started, in order.

    Raises NotComparableError, which says what differs, where the policies were not played from the same start states:
    another environment, another realism preset or camera, no common seed, or other first states on a common seed.
    """
    first = contestants[0]
    for other in contestants[1:]:
        _require_alike(first, other)
    seeds = sorted(set(first.episodes).intersection(*(c.episodes for c in contestants[1:])))
    if not seeds:
        told = "; ".join(f"{c.source}: {min(c.episodes)} to {max(c.episodes)}" for c in contestants)
        raise NotComparableError(f"no seed was played by all of them ({told}): evaluate them with the same --seed")
    return seeds


def _require_alike(first: Contestant, other: Contestant) -> None:
    here, there = first.place, other.place
    again = "evaluate both alike"
    if first.env_id != other.env_id:
        raise NotComparableError(f"{here} was played on {first.env_id}, {there} on {other.env_id}: {again}")
    for what, value in first.conditions.items():
        if value != other.conditions[what]:
            values = [c.conditions[what] for c in (first, other)]
            told = f" ({values[0]}, {values[1]})" if all(isinstance(v, str) for v in values) else ""
            raise NotComparableError(f"{here} and {there} were played under another {what}{told}: {again}")
    if differing := states_differ(first.episodes, other.episodes):
        raise NotComparableError(
            f"{here} and {there} started from other states on {len(differing)} common seeds ({differing[0]} is the "
            "first), by the digests in their records: play them on one machine, with one version and backend"
        )


def states_known(contestants: Sequence[Contestant], seeds: Sequence[int]) -> bool:
    """Return whether every policy's records hold the digest of the first state of each seed that did not crash."""
    return all(e.start_state is not None or e.crashed is not None for c in contestants for e in c.results(seeds))
