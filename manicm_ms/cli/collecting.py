"""What `manicm-ms collect` and `manicm-ms experts` do beside collecting and fetching: paths, many tasks, tables."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from manicm_ms.cli.listing import Listing, console, show
from manicm_ms.demos.collect import Collected, collect
from manicm_ms.demos.expert_files import EXPERT_FILES, fetch
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.layout import store_path
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import ConfigError, ManicmError, UnknownNameError
from manicm_ms.paths import is_disk_full
from manicm_ms.progress import progress_bars
from manicm_ms.wording import counted

DATA = Path("data")


def collect_one(env_id: str, out: Path | None, episodes: int, options: Mapping[str, Any]) -> Collected:
    """Collect in one environment and say what came of it; `out` None takes its place under data."""
    done = collect(env_id, episodes, out or store_path(DATA, env_id), **options)
    came = f"{counted(done.episodes, 'episode')} from {counted(done.attempts, 'attempt')}"
    print(f"{done.path}: {came}, {done.added} new")
    return done


def collect_tagged(tag: str, out: Path | None, episodes: int, options: Mapping[str, Any]) -> None:
    """Collect in every environment with a tag, one after another, into `out`/ENV_ID.zarr; print a table.

    Raises:
        UnknownNameError: no environment carries the tag.
        ConfigError: an option that only one environment can have.
        ManicmError: some of them could not be collected; the others were.
    """
    if options["style"] is not None:
        raise ConfigError("--style belongs to one environment: collect that one by its id")
    names = tagged(tag)
    rows: list[tuple[str, ...]] = []
    failed: dict[str, str] = {}
    for number, env_id in enumerate(names, start=1):
        print(f"{number} of {len(names)}: {env_id}", flush=True)
        began = time.perf_counter()
        try:
            done = collect_one(env_id, store_path(out or DATA, env_id), episodes, options)
        except (ManicmError, OSError) as error:  # the others may fare better
            if is_disk_full(error):
                raise
            failed[env_id] = str(error)
            print(f"{env_id}: {error}", flush=True)
            continue
        with DemoStore.open(done.path) as store:
            length = f"{store.lengths.mean():.0f}"
        seconds = f"{time.perf_counter() - began:.0f}"
        rows.append((env_id, str(done.attempts), str(done.episodes), length, seconds))
    show(Listing(("env id", "attempts", "kept", "mean length", "seconds"), rows), console())
    if failed:
        first = next(iter(failed))
        raise ManicmError(f"{len(failed)} of {len(names)} were not collected: {', '.join(failed)}; {failed[first]}")


def tagged(tag: str) -> tuple[str, ...]:
    """Return the environments that carry `tag` and have an expert; raise UnknownNameError where there are none."""
    names = tuple(name for name in ENVS.names(tag) if name in EXPERTS.names())
    if not names:
        raise UnknownNameError("tag", tag, {t for name in EXPERTS.names() for t in ENVS.tags(name)})
    return names


def experts(action: str, names: tuple[str, ...], source: Path | None) -> None:
    """Fetch or list the expert files called `names`, all of them where there are none."""
    chosen = names or EXPERT_FILES.names()
    if action == "fetch":
        _fetch(chosen, source)
        return
    if source is not None:
        raise ConfigError("--from goes with 'experts fetch': drop it")
    files = [EXPERT_FILES.get(name) for name in chosen]
    rows = [(f.name, str(f.path) if f.path.is_file() else "not fetched", f.licence, f.url) for f in files]
    show(Listing(("expert", "kept at", "licence", "source"), rows), console())


def _fetch(names: Sequence[str], source: Path | None) -> None:
    with progress_bars(console()) as shown:
        bar = shown.add_task("fetch experts", total=len(names))

        def report(line: str) -> None:
            shown.console.print(line, markup=False, highlight=False, soft_wrap=True)
            shown.advance(bar)

        fetch(names, source, report)
