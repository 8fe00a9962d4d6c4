"""Runs the conformance checks on every environment of a tag, and measures what a frame costs there, CPU time."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manicm_ms.bench.pages import results_page
from manicm_ms.envs.conformance import check_vec_env
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.errors import UnknownNameError
from manicm_ms.paths import write_text
from manicm_ms.spec import AGENT_POS, POINT_CLOUD

PAGE = "suites.md"
BEGIN, END = "<!-- table: manicm-ms bench suites -->", "<!-- end of table -->"
SEED, STEPS, WARM_UP = 1, 60, 5
Row = dict[str, Any]


def timed(times: list[float], call: Callable[..., Any], *arguments: Any) -> Any:
    """Append the CPU time that `call` took to `times`, milliseconds, and return what it returned."""
    start = time.process_time()  # not the clock on the wall: other programs may want the cores
    returned = call(*arguments)
    times.append((time.process_time() - start) * 1e3)
    return returned


def measure(env_id: str) -> Row:
    """Return what stepping, rendering and making the cloud of one row cost: best and median of 55 frames, ms."""
    torch.set_num_threads(1)
    entry, config = ENVS.get(env_id), SimulatorConfig(obs=(POINT_CLOUD, AGENT_POS))
    simulator: Any = entry.build(config.specialise(entry.spec), config)
    costs: dict[str, list[float]] = {"step": [], "render": [], "cloud": []}
    actions = torch.rand(STEPS, 1, entry.spec.action.dim, generator=torch.Generator().manual_seed(0)) * 2 - 1
    try:
        simulator.reset(torch.zeros(1, dtype=torch.int64), [SEED])
        for action in actions:
            timed(costs["step"], simulator.step, action)
            picture = timed(costs["render"], simulator._shoot, config.image_size)
            cloud = timed(costs["cloud"], simulator._cloud, picture)
    finally:
        simulator.close()
    row: Row = {"points": len(np.unique(cloud, axis=0))}
    for name, times in costs.items():
        row[f"{name}_cpu_ms"] = [min(times[WARM_UP:]), float(np.median(times[WARM_UP:]))]
    return row


def examine(env_id: str) -> Row:
    """Return what the conformance checks of an environment found."""
    results = check_vec_env(env_id, "cpu")
    broken = [f"{r.name}: {r.detail}" for r in results if not r.passed]
    group = ", ".join(sorted(ENVS.tags(env_id) - {"benchmark31", "metaworld"}))
    return {"env_id": env_id, "group": group, "checks": len(results), "broken": broken}


def table(rows: list[Row]) -> str:
    """Return the rows as Markdown."""
    lines = [
        "| env id | group | checks passed | distinct points of 512 | step, ms | render, ms | cloud, ms |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        kept = f"{row['checks'] - len(row['broken'])} of {row['checks']}"
        times = ("{:.1f} ({:.1f})".format(*row[f"{name}_cpu_ms"]) for name in ("step", "render", "cloud"))
        lines.append(f"| {row['env_id']} | {row['group']} | {kept} | {row['points']} | {' | '.join(times)} |")
    return "\n".join(lines)


def bench(tag: str, write: bool, records: Path | None) -> None:
    """Examine the environments of `tag` one after the other, print the table, and keep it in docs/results if asked.

    Args:
        tag: of environments.
        write: whether to put the table between its marks in docs/results.
        records: a JSON-lines file that keeps finished rows between runs.
    """
    env_ids, page = tagged(tag), results_page(PAGE) if write else None
    lines = records.read_text().splitlines() if records and records.is_file() else []
    done = {row["env_id"]: row for row in map(json.loads, lines) if "checks" in row}  # others are of an older version
    for env_id in env_ids:
        row = done.get(env_id) or examine(env_id)
        done[env_id] = row if "render_cpu_ms" in row else row | measure(env_id)
        if records and done[env_id] is not row:
            with records.open("a") as file:
                file.write(json.dumps(done[env_id]) + "\n")
        print(f"{env_id}: {len(row['broken'])} of {row['checks']} checks failed {row['broken']}", flush=True)
    text = table([done[env_id] for env_id in env_ids])
    print(text)
    if page is not None:
        write_text(page, between_marks(page.read_text(encoding="utf-8"), text))


def tagged(tag: str) -> tuple[str, ...]:
    """Return the environments that carry `tag`; raise UnknownNameError where there are none."""
    env_ids = ENVS.names(tag)
    if not env_ids:
        raise UnknownNameError("tag", tag, {tag for name in ENVS.names() for tag in ENVS.tags(name)})
    return env_ids


def between_marks(page: str, text: str) -> str:
    """Return `page` with the table `text` between its marks."""
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}\n\n{text}\n\n{END}{rest.partition(END)[2]}"
