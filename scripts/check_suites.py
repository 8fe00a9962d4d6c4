"""Checks the promises of `VecEnv` on every environment of a tag, and measures what a frame costs there, CPU time.

python scripts/check_suites.py --tag benchmark31 --write      # -> docs/results/suites.md, between its marks
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from manicm_ms.envs.conformance import check_vec_env
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.spec import AGENT_POS, POINT_CLOUD

PAGE = Path(__file__).resolve().parents[1] / "docs" / "results" / "suites.md"
BEGIN, END = "<!-- table: scripts/check_suites.py -->", "<!-- end of table -->"
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
    """Return what became of the promises of an environment."""
    results = check_vec_env(env_id, "cpu")
    broken = [f"{r.name}: {r.detail}" for r in results if not r.passed]
    group = ", ".join(sorted(ENVS.tags(env_id) - {"benchmark31", "metaworld"}))
    return {"env_id": env_id, "group": group, "promises": len(results), "broken": broken}


def table(rows: list[Row]) -> str:
    """Return the rows as Markdown."""
    lines = [
        "| env id | group | promises kept | distinct points of 512 | step, ms | render, ms | cloud, ms |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        kept = f"{row['promises'] - len(row['broken'])} of {row['promises']}"
        times = ("{:.1f} ({:.1f})".format(*row[f"{name}_cpu_ms"]) for name in ("step", "render", "cloud"))
        lines.append(f"| {row['env_id']} | {row['group']} | {kept} | {row['points']} | {' | '.join(times)} |")
    return "\n".join(lines)


def main() -> None:
    """Examine the environments one after the other, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tag", default="benchmark31")
    parser.add_argument("--write", action="store_true", help=f"put the table into {PAGE.name}")
    parser.add_argument("--records", type=Path, help="a JSON-lines file that keeps finished rows between runs")
    args = parser.parse_args()
    lines = args.records.read_text().splitlines() if args.records and args.records.is_file() else []
    done = {row["env_id"]: row for row in map(json.loads, lines)}
    for env_id in ENVS.names(args.tag):
        row = done.get(env_id) or examine(env_id)
        done[env_id] = row if "render_cpu_ms" in row else row | measure(env_id)
        if args.records and done[env_id] is not row:
            with args.records.open("a") as records:
                records.write(json.dumps(done[env_id]) + "\n")
        print(f"{env_id}: {len(row['broken'])} of {row['promises']} promises broken {row['broken']}", flush=True)
    text = table([done[env_id] for env_id in ENVS.names(args.tag)])
    print(text)
    if args.write:
        before, _, rest = PAGE.read_text().partition(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}\n\n{text}\n\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
