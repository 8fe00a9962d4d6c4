"""Collecting: an expert plays seeds in parallel and the episodes it solves are kept, in the order of their seeds.

What is kept depends on the environment, the expert and the first seed alone: seeds are tried in
order, an episode is kept where its own seed was solved, and episodes are committed in the order of
their seeds, so neither the number of environments nor an interruption changes the data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from manicm_ms.demos.attempts import Attempt, Collector
from manicm_ms.demos.collection_plan import CollectionPlan
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.layout import OPTIONAL_FIELDS, Episode, frame_shapes
from manicm_ms.demos.origin import collect_command, require_same_origin
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.env_request import EnvRequest
from manicm_ms.errors import ConfigError, ManicmError, OutputExistsError
from manicm_ms.paths import require_free_space
from manicm_ms.progress import progress_bars
from manicm_ms.provenance import package_versions
from manicm_ms.sensing.realism import Realism
from manicm_ms.spec import VOXEL_SIZE, EnvSpec

# Beyond these failures an expert is broken, not unlucky.
_FAILURES_PER_EPISODE, _FAILURES_FREE = 10, 50


@dataclass(frozen=True)
class Collected:
    """What a collection came to.

    Attributes:
        path: the store.
        episodes: episodes in it.
        attempts: seeds tried for them, those of earlier runs of the same command included.
        added: episodes that this run added.
    """

    path: Path
    episodes: int
    attempts: int
    added: int


def collect(
    env_id: str,
    episodes: int,
    out: Path,
    *,
    num_envs: int = 1,
    seed: int = 0,
    style: str | None = None,
    backend: str = "auto",
    colors: bool = False,
    extras: Iterable[str] = (),
    voxel_size: int = VOXEL_SIZE,
    tail_steps: int | None = None,
    realism: str | Realism = "clean",
    camera: Path | None = None,
    obs_preset: str = "manicm_ms",
    console: Console | None = None,
) -> Collected:
    """Collect demonstrations of the registered expert of `env_id` into a store, with a progress bar.

    A store that this call began earlier, and did not finish, is continued; one with enough episodes
    is left as it is; one with fewer is extended.

    Args:
        env_id: for example "ur3e/slide-block".
        episodes: solved episodes that the store is to hold.
        out: the store, made if need be.
        num_envs: environments that play at once; the data does not depend on it.
        seed: seeds tried are seed, seed + 1, ...
        style: the expert's style, its default one if None.
        backend: "cpu", "gpu" or "auto", as in `make_vec`.
        colors: store rgb beside xyz.
        extras: optional fields of `Episode` to store, from `OPTIONAL_FIELDS`.
        voxel_size: cells along each side of voxel grids, where `extras` names them.
        tail_steps: control steps kept after the first success where the task goes on after it; None: the task's own.
        realism: preset or ranges, as in `make_vec`; what it draws is stored with every episode.
        camera: YAML file of the cell's depth camera, as in `make_vec`.
        obs_preset: as in `make_vec`.
        console: where progress is shown; standard output by default.

    Raises StoreError where `out` holds other data or has a writer already, NoSpaceError, CameraError,
    UnknownNameError for the id, the style or the preset, ManicmError where the expert fails far too often.
    """
    env_asked = EnvRequest(env_id, backend, colors=colors, realism=realism, camera=camera, obs_preset=obs_preset)
    plan = CollectionPlan(env_asked, num_envs, seed, style, tuple(extras), tail_steps, voxel_size)
    _require_some(episodes)
    out = Path(out)
    if out.is_file():
        raise OutputExistsError(f"{out} is a file: choose a folder for --out")
    exists = out.exists() and not (out.is_dir() and not any(out.iterdir()))
    if exists and (finished := _finished(out, episodes, plan)):
        return finished
    with ExitStack() as stack:
        # The lock is taken before the environment is made, so that a second writer is refused at once.
        store = stack.enter_context(DemoStore.open(out, "a")) if exists else None
        collector = stack.enter_context(plan.collector())
        expert, env = collector.expert, collector.env
        asked = plan.asked() | {"expert": expert.name, "style": expert.style, "backend": env.backend}
        command = collect_command(asked, episodes, plan.extras, plan.env)
        if store is None:
            collector.begin(seed)  # a simulator that does not run leaves no empty store behind
            provenance = asked | {"command": command, "versions": package_versions()}
            store = stack.enter_context(_create(out, env.env_spec, provenance, episodes, collector.conditions(seed)))
        require_same_origin(store, asked, env.env_spec)
        with _progress_bar(env_id, episodes, len(store), console) as report:
            added = fill(store, collector, episodes, seed, report)
        store.note(command=command)
        return Collected(out, len(store), store.attempts, added)


def collect_episodes(
    env_id: str,
    episodes: int,
    *,
    num_envs: int = 1,
    seed: int = 0,
    style: str | None = None,
    backend: str = "auto",
    colors: bool = False,
    extras: Iterable[str] = (),
    voxel_size: int = VOXEL_SIZE,
    tail_steps: int | None = None,
    realism: str | Realism = "clean",
    camera: Path | None = None,
    obs_preset: str = "manicm_ms",
) -> list[Episode]:
    """Collect demonstrations into memory: the episodes that `collect` stores for the same arguments.

    Raises ConfigError, UnknownNameError, ManicmError as `collect`. An interruption loses them: for many, use `collect`.
    """
    env_asked = EnvRequest(env_id, backend, colors=colors, realism=realism, camera=camera, obs_preset=obs_preset)
    plan = CollectionPlan(env_asked, num_envs, seed, style, tuple(extras), tail_steps, voxel_size)
    _require_some(episodes)
    kept: list[Episode] = []
    with plan.collector() as collector, _progress_bar(env_id, episodes, 0) as report:
        for tried, attempt in enumerate(collector.attempts(seed, episodes), start=1):
            if attempt.episode is not None:
                kept.append(attempt.episode)
            report(len(kept), tried)
            _require_successes(attempt, len(kept), tried, episodes, " are dropped")
    return kept


def fill(
    store: DemoStore,
    collector: Collector,
    episodes: int,
    first_seed: int,
    report: Callable[[int, int], None] = lambda kept, attempts: None,
) -> int:
    """Append solved episodes to `store` until it holds `episodes`; return how many were added.

    Args:
        store: open for appending; what it holds must come from the same seeds and expert.
        collector: plays the seeds that are still to be tried.
        episodes: number of episodes that the store is to hold.
        first_seed: seed of the very first attempt.
        report: called with (episodes kept, attempts) after each attempt.

    Raises ManicmError where far more attempts fail than a working expert's would.
    """
    kept = before = len(store)
    tried = attempts_so_far(store, first_seed)
    if kept >= episodes:
        return 0
    for attempt in collector.attempts(first_seed + tried, episodes - kept):
        tried += 1
        if attempt.episode is not None:
            store.append(attempt.episode)
            kept += 1
        # After the commit, so that a kill between the two can only make this number too small.
        store.note(attempts=tried)
        report(kept, tried)
        _require_successes(attempt, kept, tried, episodes, f" are kept in {store.path}")
    return kept - before


def _require_successes(attempt: Attempt, kept: int, tried: int, wanted: int, fate: str) -> None:
    """Raise ManicmError where far more attempts failed than a working expert's would; `fate` of the solved ones."""
    if tried - kept > _FAILURES_PER_EPISODE * wanted + _FAILURES_FREE:
        raise ManicmError(
            f"{tried - kept} of {tried} attempts failed (seed {attempt.seed}: {attempt.reason}): gave up; the "
            f"{kept} solved episodes{fate}. Try another style or mend the expert of the task"
        )


def _require_some(episodes: int) -> None:
    """Raise ConfigError where no episode is asked for."""
    if episodes < 1:
        raise ConfigError(f"episodes must be at least 1, got {episodes}")


def attempts_so_far(store: DemoStore, first_seed: int) -> int:
    """Return how many seeds from `first_seed` on need not be tried again.

    The number noted in the store may lag behind its last episode by one, after a kill.
    """
    seeds = store.seeds
    last = int(seeds[-1]) - first_seed + 1 if len(seeds) else 0
    return max(store.attempts, last)


def _finished(out: Path, episodes: int, plan: CollectionPlan) -> Collected | None:
    """Return what `out` holds where that is all that is asked for, without starting an environment.

    Raises StoreError where it is no store, or holds other data than is asked for.
    """
    asked = plan.asked()
    with DemoStore.open(out) as store:
        if store.provenance.get("env_id") == asked["env_id"]:  # else the expert would not fit the specs
            expert = EXPERTS.get(plan.env.env_id)(store.spec, 1, torch.device("cpu"), plan.style)
            asked |= {"expert": expert.name, "style": expert.style}
        if plan.env.backend != "auto":
            asked |= {"backend": plan.env.backend}
        require_same_origin(store, asked)
        if len(store) < episodes:
            return None
        kept, tried = len(store), attempts_so_far(store, asked["seed"])
        noted = store.attempts
    if noted < tried:  # the run that committed the last episode was killed before it noted the attempt
        with DemoStore.open(out, "a") as store:
            store.note(attempts=tried)
    return Collected(out, kept, tried, 0)


def _create(out: Path, spec: EnvSpec, provenance: Mapping[str, Any], episodes: int, drawn: Iterable[str]) -> DemoStore:
    shapes = frame_shapes(spec)
    frame_bytes = sum(int(np.prod(shapes[f][0])) * shapes[f][1].itemsize for f in provenance["fields"])
    # A solved episode takes about half the steps that it may take.
    require_free_space(out, frame_bytes * episodes * spec.max_episode_steps // 2)
    extras = [f for f in provenance["fields"] if f in OPTIONAL_FIELDS]
    return DemoStore.create(out, spec, provenance, extras=extras, realism=drawn)


@contextmanager
def _progress_bar(
    env_id: str, episodes: int, kept: int, console: Console | None = None
) -> Iterator[Callable[[int, int], None]]:
    """Show the episodes kept and how many were tried for them; yield what reports both numbers."""
    with progress_bars(console or Console(), "kept{task.fields[tried]}") as shown:
        bar = shown.add_task(f"collect {env_id}", total=episodes, completed=kept, tried="")

        def report(kept: int, attempts: int) -> None:
            shown.update(bar, completed=kept, tried=f", {attempts} tried")

        yield report
