"""Give kept results the present intervals: `python scripts/results/renew_results.py docs/results/data/*.json`.

Each file, of an evaluation, a benchmark or the real-world table, is written anew with all that follows from its counts
and outcomes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import tyro

from manicm_ms.evaluation.results import renewed
from manicm_ms.paths import write_text


def renew(results: dict[str, Any]) -> dict[str, Any]:
    """Return results of any kind with the present intervals."""
    if "cells" in results:
        from manicm_ms.benchmark.summary import summarised

        return summarised(results)
    if "tasks" in results:
        return {**results, "tasks": {name: renew(task) for name, task in results["tasks"].items()}}
    found = renewed(results)
    for entry in (*found.get("policies", ()), *found.get("realism", {"rows": ()})["rows"]):
        if ends_at_success(found["env_id"]) and entry["success_once"] is None:
            same = {name: entry[name] for name in ("n", "successes", "success_rate", "ci95")}
            entry |= {"success_once": same, "success_at_end": same}
    return found


def ends_at_success(env_id: str) -> bool:
    """Return whether an episode of this environment ends with its success: the first is then the last."""
    return env_id.startswith("ur3e/")  # decision 0007


def main(files: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """Renew the files.

    Args:
        files: results, JSON.
    """
    for file in files:
        text = file.read_text()
        second = text.splitlines()[1]
        indent = len(second) - len(second.lstrip())  # as it was, so that a difference shows what changed
        write_text(file, json.dumps(renew(json.loads(text)), indent=indent, allow_nan=False) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
