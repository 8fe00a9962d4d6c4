"""Plays the paper's real-world table in simulation: DP3 and ManiCM on Slide Block, Stack Cube and Transfer Piece.

Every policy plays the same seeds under three realism presets; the teacher in one step stands beside them as control.

python scripts/reproduce_real_world_table.py --write     # 100 held-out seeds a task, 200 for the student; resumes
python scripts/reproduce_real_world_table.py --tasks slide_block --episodes 20

Reads checkpoints/TASK/{teacher,student}; reports and records go to runs/real_world/TASK.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from manicm_ms.errors import CheckpointError, ConfigError, ManicmError, UnknownNameError
from manicm_ms.evaluation.intervals import PairedCounts, paired_difference_interval, rate_interval
from manicm_ms.evaluation.statistics import mcnemar_exact
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
PAIR = ("teacher", "student")
METHODS = {"teacher": "DP3 (teacher)", "control": "DP3 in one step (control)", "student": "ManiCM (student)"}
PRESETS = ("clean", "d435i", "d435i+dr")


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
    pair = [checkpoints / task / role for role in PAIR]
    missing = [str(folder) for folder in pair if not (folder / "manifest.json").is_file()]
    if missing:
        there = sorted(folder.parent.name for folder in checkpoints.glob("*/student") if folder.parent.name in TASKS)
        raise CheckpointError(
            f"no checkpoint at {' and '.join(missing)}: put the trained pair there (scripts/ship_pair.py does), or "
            f"choose --tasks among those that are there: {' '.join(there) or 'none'}"
        )
    return pair


@dataclass(frozen=True)
class Amount:
    """How much is played of a task under each preset.

    Attributes:
        episodes: held-out seeds of teacher, control and student.
        student_episodes: those of the student, which plays what is missing alone.
        seed: first of them.
    """

    episodes: int
    student_episodes: int
    seed: int


def play(task: str, pair: list[Path], amount: Amount, out: Path, command: str) -> dict[str, Any]:
    """Evaluate a task's pair and control under each preset; return what the page needs of it, JSON values."""
    from manicm_ms.evaluation.evaluate import evaluate

    named = [folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder for folder in pair]
    env_id, presets = TASKS[task].env_id, ",".join(PRESETS)
    results = evaluate(
        named, env_id, amount.episodes, amount.seed, out / task, realism=presets, videos=0, command=command
    )
    shared = {key: results[key] for key in ("env_id", "machine", "versions", "intervals")}
    rows = [_without_episodes(row) for row in results["realism"]["rows"]]
    if (more := amount.student_episodes - amount.episodes) > 0:
        first = amount.seed + amount.episodes
        alone = evaluate(
            named[1:], env_id, more, first, out / f"{task}_student", realism=presets, videos=0, repetitions=1,
            command=command,
        )["realism"]["rows"]  # fmt: skip
        rows = [_joined(row, _without_episodes(alone.pop(0))) if row["role"] == "student" else row for row in rows]
    return shared | {
        "seeds": [results["seeds"][0], results["seeds"][-1]],
        "policies": [{key: policy[key] for key in _KEPT} for policy in results["policies"]],
        "realism": {**results["realism"], "rows": rows},
    }


def _without_episodes(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row with the seeds that failed in place of all its episodes: they tell every outcome."""
    kept = {key: value for key, value in row.items() if key != "episodes"}
    return {**kept, "failed_seeds": [episode["seed"] for episode in row["episodes"] if not episode["success"]]}


def _joined(row: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a policy that played more seeds under the same preset, all its rates over both."""
    from manicm_ms.evaluation.results import renewed

    assert (row["preset"], row["role"]) == (more["preset"], more["role"])
    together = {**row, **_summed(row, more, ("n", "successes", "crashed"))}
    for rate in ("success_once", "success_at_end"):
        both = _summed(row[rate], more[rate], ("n", "successes"))
        low, high = rate_interval(both["successes"], both["n"])
        together[rate] = {**both, "success_rate": both["successes"] / both["n"], "ci95": [low, high]}
    if row["against_reference"] is not None:
        together["against_reference"] = _summed(
            row["against_reference"], more["against_reference"], PairedCounts._fields
        )
    together["failed_seeds"] = [*row["failed_seeds"], *more["failed_seeds"]]
    return renewed({"realism": {"rows": [together]}})["realism"]["rows"][0]


def _summed(first: dict[str, Any], second: dict[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    return {key: first[key] + second[key] for key in keys}


# ---- the page -------------------------------------------------------------------------------------------------------


def table(data: dict[str, Any]) -> str:
    """Return the paper's table with our simulation beside it, Markdown: a task a block, a method a row."""
    lines = [
        "| task | method | NFE | real robot, paper: success | decision | simulation, here: "
        + " | ".join(PRESETS)
        + " | decision, median (p95) |",
        "|---" * (6 + len(PRESETS)) + "|",
    ]
    for name, results in data["tasks"].items():
        lines += [_row(TASKS[name], policy, results["realism"]["rows"]) for policy in results["policies"]]
    return "\n".join(lines)


def _row(task: Task, policy: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    paper = task.paper.get(policy["role"])
    latency = policy["latency_ms"]
    rates = {row["preset"]: row for row in rows if row["role"] == policy["role"]}
    cells = [
        task.title,
        METHODS[policy["role"]],
        str(policy["nfe"]),
        *(("-", "-") if paper is None else (f"{paper.success:.0f} %", f"{paper.runtime_ms:.1f} ms")),
        *(f"{success_text(rates[preset])} ({interval_text(rates[preset]['ci95'])})" for preset in PRESETS),
        f"{latency['median']:.1f} ms ({latency['p95']:.1f})",
    ]
    return f"| {' | '.join(cells)} |"


def differences(data: dict[str, Any]) -> str:
    """Return the paired differences of the student, Markdown: a task and a preset a row."""
    lines = ["| task | preset | student minus teacher | student minus control |", "|---|---|---|---|"]
    for name, results in data["tasks"].items():
        for preset in PRESETS:
            rows = {row["role"]: row for row in results["realism"]["rows"] if row["preset"] == preset}
            cells = [_difference(rows[other], rows["student"], results["seeds"]) for other in ("teacher", "control")]
            lines.append(f"| {TASKS[name].title} | {preset} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _difference(first: dict[str, Any], second: dict[str, Any], seeds: list[int]) -> str:
    """Return the paired difference of two rows on the seeds that both played, second minus first, in points."""
    played = range(seeds[0], seeds[1] + 1)
    lost, missed = ({seed for seed in row["failed_seeds"] if seed in played} for row in (first, second))
    neither = len(lost & missed)
    counts = PairedCounts(len(played) - len(lost | missed), len(missed) - neither, len(lost) - neither, neither)
    low, high = (100 * bound for bound in paired_difference_interval(counts))
    p = mcnemar_exact(counts)
    return f"{100 * counts.difference:+.1f} ({low:+.1f} to {high:+.1f}; p = {p:.2g})"


def sentences(data: dict[str, Any]) -> str:
    """Return what the table says, a Markdown list: the lowest rate of a student, and each pair's speed."""
    students = [
        (row["success_rate"], TASKS[name].title, row["preset"])
        for name, results in data["tasks"].items()
        for row in results["realism"]["rows"]
        if row["role"] == "student" and row["success_rate"] is not None
    ]
    lines = []
    if students:
        rate, title, preset = min(students)
        lines.append(f"- The lowest success rate of a student is {100 * rate:.1f} %: {title} under `{preset}`.")
    for name, results in data["tasks"].items():
        by_role = {policy["role"]: policy["latency_ms"]["median"] for policy in results["policies"]}
        paper = TASKS[name].paper
        lines.append(
            f"- {TASKS[name].title}: the student decides {by_role['teacher'] / by_role['student']:.1f} times as fast "
            f"as its teacher (paper: {paper['teacher'].runtime_ms / paper['student'].runtime_ms:.1f} times)."
        )
    return "\n".join(lines)


def page(data: dict[str, Any]) -> str:
    """Return docs/results/real_world.md."""
    first = next(iter(data["tasks"].values()))
    low, high = rate_interval(8, PAPER_TRIALS)
    sizes = sorted({policy["parameters"] for results in data["tasks"].values() for policy in results["policies"]})
    return f"""# The paper's real-world table, in simulation

Left the paper's figures ({SOURCE}: {PAPER_TRIALS} trials on a UR3e with an AG-95 and a D435i, decisions on an RTX
4090), right those of the pairs in `checkpoints/`, as committed, in the simulated task: as many seeds as the cells say,
from {first["seeds"][0]} on, far from those of the demonstrations; teacher and control play the first of the student's.
All play under three presets ([guide](../guides/realism.md)): the ideal camera (`clean`), the errors of a depth camera
(`d435i`), and these in a randomised cell (`d435i+dr`), under which most demonstrations were collected. How the pairs
were trained: [robust_pairs.md](robust_pairs.md).

{table(data)}

{sentences(data)}

Paired differences of the student on the seeds that all three played, in points, with Tango's 95 % score interval and
the p value of McNemar's exact test. The p values are not corrected for their number.

{differences(data)}

**What differs, so that the two halves are not one experiment:**

- Ours is a simulation: the tasks' sizes, masses, randomisation and tests of success are this package's (the paper gives
  none), the camera is modelled, and nothing here says how these policies would fare on a real robot.
- Our networks are small: {" and ".join(f"{size / 1e6:.2f} M" for size in sizes)} parameters (Simple DP3 with a narrow
  U-Net), to be trained on a CPU; the paper's real-robot policies are full DP3 and ManiCM.
- Decisions are timed on {first["policies"][0]["device"]} with {first["policies"][0]["threads"]} torch thread(s),
  batch 1, not on an RTX 4090: the ratio of the two rows may be compared, the milliseconds may not.
- {PAPER_TRIALS} trials tell little: the 95 % interval of 8 successes in {PAPER_TRIALS} is {100 * low:.0f} to
  {100 * high:.0f} %.

Intervals in brackets behind a rate are Clopper-Pearson's, 95 %. They speak of these networks: one training seed each.
All three tasks end an episode at its success, so that success at some step and at the last one are the same. NFE is the
number of network evaluations of a decision; "one step" is the control, the teacher's network evaluated once without
distillation. Machine: {_machine(first["machine"])}.

Made by `{data["command"]}`; the figures are in [data/real_world.json](data/real_world.json).
"""


def _machine(machine: dict[str, Any]) -> str:
    return ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in machine.items() if value not in (None, ""))


def main(
    tasks: tuple[str, ...] = tuple(TASKS),
    episodes: int = 100,
    student_episodes: int = 200,
    seed: int = SEED,
    checkpoints: Path = REPO / "checkpoints",
    out: Path = REPO / "runs" / "real_world",
    write: bool = False,
) -> None:
    """Evaluate the shipped pairs and print the table.

    Args:
        tasks: folders of checkpoints to evaluate.
        episodes: held-out seeds of a task, played by teacher, control and student.
        student_episodes: seeds of the student, which plays those beyond the first `episodes` alone.
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
    amount = Amount(episodes, student_episodes, seed)
    data: dict[str, Any] = {"command": command, "paper": SOURCE, "tasks": {}}
    for task, pair in pairs.items():
        data["tasks"][task] = play(task, pair, amount, out, command)
    print(f"\n{table(data)}\n\n{sentences(data)}\n\n{differences(data)}")
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
