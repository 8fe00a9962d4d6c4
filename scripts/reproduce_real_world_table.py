"""Plays the paper's real-world table in simulation: DP3 and ManiCM on Slide Block, Stack Cube and Transfer Piece.

python scripts/reproduce_real_world_table.py --write                # 200 fresh seeds a task; goes on where it stopped
python scripts/reproduce_real_world_table.py --tasks slide_block --episodes 20

Reads checkpoints/TASK/{teacher,student}; reports and records go to runs/real_world/TASK.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from manicm_ms.errors import CheckpointError, ConfigError, ManicmError, UnknownNameError
from manicm_ms.evaluation.intervals import rate_interval
from manicm_ms.evaluation.text import interval_text, success_text
from manicm_ms.paths import write_json, write_text

REPO = Path(__file__).resolve().parents[1]
RESULTS = REPO / "docs" / "results"
PAGE, DATA = RESULTS / "real_world.md", RESULTS / "data" / "real_world.json"
SEED = 200_000
SOURCE = 'ManiCM, arXiv:2406.01586, table "Real World Experiment Results"'
PAPER_TRIALS = 10
_KEPT = (
    "role", "checkpoint", "nfe", "n", "successes", "success_rate", "ci95", "success_once", "success_at_end", "crashed",
    "latency_ms", "device", "threads", "dtype", "parameters",
)  # fmt: skip
ROLES = {"teacher": "DP3", "student": "ManiCM"}


@dataclass(frozen=True)
class PaperCell:
    """What the paper gives for one method on one task.

    Attributes:
        success: per cent of 10 trials.
        runtime_ms: of one decision, milliseconds, on an RTX 4090.
    """

    success: float
    runtime_ms: float


@dataclass(frozen=True)
class Task:
    """One column of the table.

    Attributes:
        title: its name in the paper.
        env_id: ours.
        paper: role of our policy -> the paper's figures.
    """

    title: str
    env_id: str
    paper: dict[str, PaperCell]


def _task(title: str, env_id: str, dp3: tuple[float, float], manicm: tuple[float, float]) -> Task:
    return Task(title, env_id, {"teacher": PaperCell(*dp3), "student": PaperCell(*manicm)})


TASKS = {
    "slide_block": _task("Slide Block", "ur3e/slide-block", (90, 177.2), (80, 16.9)),
    "stack_cube": _task("Stack Cube", "ur3e/stack-cube", (80, 181.3), (80, 17.2)),
    "transfer_piece": _task("Transfer Piece", "ur3e/transfer-piece", (70, 172.4), (80, 16.8)),
}


def pair_of(task: str, checkpoints: Path) -> list[Path]:
    """Return the folders of a task's teacher and student; raise CheckpointError where one is missing."""
    pair = [checkpoints / task / role for role in ROLES]
    missing = [str(folder) for folder in pair if not (folder / "manifest.json").is_file()]
    if missing:
        there = sorted(folder.parent.name for folder in checkpoints.glob("*/student") if folder.parent.name in TASKS)
        raise CheckpointError(
            f"no checkpoint at {' and '.join(missing)}: put the trained pair there (scripts/ship_pair.py does), or "
            f"choose --tasks among those that are there: {' '.join(there) or 'none'}"
        )
    return pair


def play(task: str, pair: list[Path], episodes: int, seed: int, out: Path, command: str) -> dict[str, Any]:
    """Judge a task's pair on fresh seeds; return what the table needs of its results, JSON values."""
    from manicm_ms.evaluation.evaluate import evaluate

    named = [folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder for folder in pair]
    results = evaluate(named, TASKS[task].env_id, episodes, seed, out / task, control=False, videos=0, command=command)
    policies = [{key: policy[key] for key in _KEPT} for policy in results["policies"]]
    shared = {key: results[key] for key in ("env_id", "paired", "machine", "versions")}
    return shared | {"seeds": [results["seeds"][0], results["seeds"][-1]], "policies": policies}


# ---- the page -------------------------------------------------------------------------------------------------------


def table(data: dict[str, Any]) -> str:
    """Return the paper's table with our simulation beside it, Markdown: a task a block, a method a row."""
    lines = [
        "| task | method | real robot, paper: success | decision | simulation, here: success | 95 % interval "
        "| at some step, at the last | decision, median (p95) | NFE |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, results in data["tasks"].items():
        lines += [_row(TASKS[name], policy) for policy in results["policies"]]
    return "\n".join(lines)


def _row(task: Task, policy: dict[str, Any]) -> str:
    paper = task.paper[policy["role"]]
    latency = policy["latency_ms"]
    counts = (policy[kind] for kind in ("success_once", "success_at_end"))
    cells = [
        task.title,
        f"{ROLES[policy['role']]} ({policy['role']})",
        f"{paper.success:.0f} %",
        f"{paper.runtime_ms:.1f} ms",
        success_text(policy),
        interval_text(policy["ci95"]),
        ", ".join("-" if entry is None else str(entry["successes"]) for entry in counts),
        f"{latency['median']:.1f} ms ({latency['p95']:.1f})",
        str(policy["nfe"]),
    ]
    return f"| {' | '.join(cells)} |"


def sentences(data: dict[str, Any]) -> str:
    """Return what the pairs say, a Markdown list: difference in success and in speed."""
    lines = []
    for name, results in data["tasks"].items():
        pair, (teacher, student) = results["paired"], results["policies"]
        if pair is None:
            lines.append(f"- {TASKS[name].title}: no comparison, every episode of a policy crashed.")
            continue
        low, high = (100 * bound for bound in pair["difference_ci95"])
        faster = teacher["latency_ms"]["median"] / student["latency_ms"]["median"]
        paper = TASKS[name].paper
        lines.append(
            f"- {TASKS[name].title}: student minus teacher {100 * pair['difference']:+.1f} points (95 % interval "
            f"{low:+.1f} to {high:+.1f}, McNemar's exact test p = {pair['mcnemar_p']:.2g}); it decides {faster:.1f} "
            f"times as fast (paper: {paper['teacher'].runtime_ms / paper['student'].runtime_ms:.1f} times)."
        )
    return "\n".join(lines)


def page(data: dict[str, Any]) -> str:
    """Return docs/results/real_world.md."""
    first = next(iter(data["tasks"].values()))
    low, high = rate_interval(8, PAPER_TRIALS)
    sizes = sorted({policy["parameters"] for results in data["tasks"].values() for policy in results["policies"]})
    return f"""# The paper's real-world table, in simulation

Left the paper's figures ({SOURCE}: {PAPER_TRIALS} trials on a UR3e with an AG-95 and a D435i, decisions on an RTX
4090), right ours: seeds {first["seeds"][0]} to {first["seeds"][1]} of the simulated task, far from those of the
demonstrations, both policies on the same ones.

{table(data)}

{sentences(data)}

**What differs, so that the two halves are not one experiment:**

- Ours is a simulation: the tasks' sizes, masses, randomisation and tests of success are this package's (the paper gives
  none), the camera is ideal, and nothing here says how these policies would fare on a real robot.
- Our networks are small: {" and ".join(f"{size / 1e6:.2f} M" for size in sizes)} parameters (Simple DP3 with a narrow
  U-Net), to be trained on a CPU; the paper's real-robot policies are full DP3 and ManiCM.
- Decisions are timed on {first["policies"][0]["device"]} with {first["policies"][0]["threads"]} torch thread(s),
  batch 1, not on an RTX 4090: the ratio of the two rows may be compared, the milliseconds may not.
- {PAPER_TRIALS} trials tell little: the 95 % interval of 8 successes in {PAPER_TRIALS} is {100 * low:.0f} to
  {100 * high:.0f} %.

Intervals are Clopper-Pearson's for rates and Tango's score interval for differences. All three tasks end an episode at
its success, so that success at some step and at the last one are the same. NFE is the number of network evaluations a
decision. Machine: {_machine(first["machine"])}.

Made by `{data["command"]}`; the figures are in [data/real_world.json](data/real_world.json).
"""


def _machine(machine: dict[str, Any]) -> str:
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in machine.items() if value not in (None, ""))


def main(
    tasks: tuple[str, ...] = tuple(TASKS),
    episodes: int = 200,
    seed: int = SEED,
    checkpoints: Path = REPO / "checkpoints",
    out: Path = REPO / "runs" / "real_world",
    write: bool = False,
) -> None:
    """Judge the shipped pairs and print the table.

    Args:
        tasks: folders of checkpoints to judge.
        episodes: fresh seeds a task.
        seed: first of them.
        checkpoints: folder that holds TASK/teacher and TASK/student.
        out: folder of reports and records.
        write: keep the page and its data in docs/results; asks for all tasks.
    """
    for task in tasks:
        if task not in TASKS:
            raise UnknownNameError("task", task, TASKS)
    if not tasks or (write and set(tasks) != set(TASKS)):
        raise ConfigError(f"--write and the table want every task: leave --tasks out, or name {' '.join(TASKS)}")
    pairs = {task: pair_of(task, checkpoints) for task in tasks}  # before an hour is spent on the first
    command = shlex.join(["python", "scripts/reproduce_real_world_table.py", *sys.argv[1:]])
    data: dict[str, Any] = {"command": command, "paper": SOURCE, "tasks": {}}
    for task, pair in pairs.items():
        data["tasks"][task] = play(task, pair, episodes, seed, out, command)
    print(f"\n{table(data)}\n\n{sentences(data)}")
    write_json(out / "real_world.json", data)
    if write:
        write_json(DATA, data)
        write_text(PAGE, page(data))
        print(f"\n{PAGE.relative_to(REPO)} and {DATA.relative_to(REPO)} are written")


if __name__ == "__main__":
    try:
        tyro.cli(main, description=__doc__)
    except ManicmError as error:
        print(f"reproduce_real_world_table.py: {error}", file=sys.stderr)
        sys.exit(2)
