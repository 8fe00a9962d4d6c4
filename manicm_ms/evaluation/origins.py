"""What a checkpoint says of its making, and what follows: seeds that it has seen, tasks that it was not made for."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from manicm_ms.errors import ConfigError

if TYPE_CHECKING:
    from manicm_ms.evaluation.protocol import EvaluatedPolicy

ATTEMPTS_PER_DEMO = 2
"""Where a checkpoint holds only the first seed of its demonstrations: seeds a demonstration that count as seen, as the
expert may have failed on some."""


@dataclass(frozen=True)
class Origin:
    """Where a checkpoint comes from.

    Attributes:
        tasks: environment ids of its spec, of its demonstrations and of its teacher's, each once.
        demo_seeds: environment id -> seeds of the demonstrations it learnt from, its teacher's included; none where
            it learnt from some whose seeds are not known, as those of other people's stores.
        run: fingerprint of the training that made it.
        teacher_run: that of its teacher's training, where it was distilled.
    """

    tasks: tuple[str, ...] = ()
    demo_seeds: Mapping[str, Collection[int]] = field(default_factory=dict)
    run: str | None = None
    teacher_run: str | None = None

    @classmethod
    def read(cls, env_id: str, provenance: Mapping[str, Any]) -> Origin:
        """Return the origin of a checkpoint for `env_id`; `provenance` may be of any version and lack anything."""
        tasks: dict[str, None] = {env_id: None}
        seeds: dict[str, set[int]] = {}
        for data in _data_of(provenance):
            if task := data.get("env_id"):
                tasks[task] = None
                seeds[task] = {*seeds.get(task, ()), *_seeds_of(data)}
        teacher_run = _teacher_of(provenance).get("run")
        return cls(tuple(tasks), seeds, provenance.get("run"), teacher_run)

    def seen(self, env_id: str, seeds: Sequence[int]) -> list[int]:
        """Return those of `seeds` on which it was shown how to solve `env_id`."""
        shown = self.demo_seeds.get(env_id, ())
        return [seed for seed in seeds if seed in shown]


UNKNOWN = Origin()


def _data_of(provenance: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield what is recorded of the demonstrations of a checkpoint, then of those of its teacher."""
    if isinstance(data := provenance.get("data"), Mapping):
        yield data
    if teacher := _teacher_of(provenance):
        yield from _data_of(teacher)


def _teacher_of(provenance: Mapping[str, Any]) -> Mapping[str, Any]:
    teacher = provenance.get("teacher")
    found = teacher.get("provenance") if isinstance(teacher, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def _seeds_of(data: Mapping[str, Any]) -> Collection[int]:
    """Return the seeds of demonstrations; negative ones stand for seeds that are not known and are left out."""
    if (listed := data.get("demo_seeds")) is not None:
        return {int(seed) for seed in listed if seed >= 0}
    collection = data.get("collection")
    first = collection.get("seed") if isinstance(collection, Mapping) else None
    if not isinstance(first, int) or first < 0 or not isinstance(data.get("episodes"), int):
        return ()
    return range(first, first + ATTEMPTS_PER_DEMO * data["episodes"])


def require_unseen(policies: Sequence[EvaluatedPolicy], env_id: str, seeds: Sequence[int]) -> None:
    """Raise ConfigError where a policy would be evaluated on seeds of its own demonstrations."""
    for evaluated in policies:
        if not (seen := evaluated.origin.seen(env_id, seeds)):
            continue
        beyond = max(evaluated.origin.demo_seeds[env_id]) + 1
        raise ConfigError(
            f"{len(seen)} of the {len(seeds)} seeds ({seen[0]} is the first) are those of the demonstrations that "
            f"checkpoint {evaluated.checkpoint} learnt from: choose --seed {beyond} or more, or add "
            "--allow-seen-seeds if you mean it"
        )


def seen_counts(policies: Sequence[EvaluatedPolicy], env_id: str, seeds: Sequence[int]) -> dict[str, int]:
    """Return policy -> how many of `seeds` are those of its own demonstrations, where there are any."""
    counts = {c.name: len(c.origin.seen(env_id, seeds)) for c in policies}
    return {name: count for name, count in counts.items() if count}


def remarks(policies: Sequence[EvaluatedPolicy], env_id: str, seeds: Sequence[int]) -> list[str]:
    """Return what a reader of the results must know of where the policies come from, a sentence each."""
    distinct = list({c.checkpoint: c for c in reversed(policies)}.values())[::-1]  # the control is its teacher's
    lines = [
        f"{name}: {count} of the {len(seeds)} seeds are those of its own demonstrations: not a rate on held-out seeds."
        for name, count in seen_counts(distinct, env_id, seeds).items()
    ]
    lines += [
        f"{c.name}: the seeds of its demonstrations are not known, so that some of these may be among them."
        for c in distinct
        if env_id in c.origin.demo_seeds and not c.origin.demo_seeds[env_id]
    ]
    for evaluated in distinct:
        if others := [task for task in evaluated.origin.tasks if task != env_id]:
            lines.append(f"{evaluated.name} was trained for {' and '.join(others)} and is evaluated on {env_id}.")
    teachers = {c.origin.run: c.name for c in distinct if c.origin.teacher_run is None and c.origin.run is not None}
    for evaluated in distinct:
        source = evaluated.origin.teacher_run
        if source is not None and teachers and source not in teachers:
            lines.append(f"{evaluated.name} was distilled from another training than {' or '.join(teachers.values())}.")
    return lines
