"""The paper's tables with our figures beside the printed ones: main table, DDIM steps, prediction type, real world.

python scripts/reproduce_tables.py --scale cpu                       # many hours; the same command goes on
python scripts/reproduce_tables.py --scale smoke --only main ddim    # a minute: shows that everything runs
python scripts/reproduce_tables.py --results runs/bench runs/tables  # plays nothing: prints from finished runs

It plans and prints: the work is that of `manicm-ms benchmark` and of scripts/reproduce_real_world_table.py. What was
not run, and what the paper does not print, is an en dash. Everything lies in --out: grid/, prediction/, real_world/,
tables.json and tables.md.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import tyro
from rich.console import Console

from manicm_ms.benchmark.methods import parse_methods
from manicm_ms.benchmark.plan import Plan, parse_envs
from manicm_ms.benchmark.run import benchmark
from manicm_ms.envs.backends import default_num_envs
from manicm_ms.errors import ManicmError, UnknownNameError
from manicm_ms.evaluation.plots import Panel, curves_plot
from manicm_ms.machine.devices import resolve_device
from manicm_ms.paths import write_json, write_text

sys.path.insert(0, str(Path(__file__).resolve().parent / "results"))
from paper_tables import (
    CONTROL,
    curves,
    ddim_rows,
    document,
    prediction_methods,
    read_results,
    real_world,
    stored,
)

Table = Literal["main", "ddim", "prediction", "real"]


@dataclass(frozen=True)
class Scale:
    """How much is run.

    Attributes:
        preset: of all trainings.
        seeds: of the trainings.
        episodes: held-out seeds of each trained policy.
        demos: demonstrations of a task.
        colors: with coloured clouds.
        teacher: of the DDIM table and of the prediction types.
        methods: of the main table; one that this version lacks is missing in it.
        envs: of the main table: ids and tags.
        few_envs: of the DDIM table and of the prediction types: tasks that leave room.
        evaluations: during each training of a prediction type.
        evaluation_episodes: of each of those.
        real: tasks of the real-world table.
        real_episodes: of each of them.
    """

    preset: str
    seeds: tuple[int, ...]
    episodes: int
    demos: int
    colors: bool
    teacher: str
    methods: tuple[str, ...]
    envs: tuple[str, ...]
    few_envs: tuple[str, ...]
    evaluations: int
    evaluation_episodes: int
    real: tuple[str, ...]
    real_episodes: int


_REAL = ("slide_block", "stack_cube", "transfer_piece")
_FEW = ("adroit/door", "adroit/pen", "metaworld/soccer", "metaworld/pick-place", "metaworld/shelf-place")
SCALES = {
    "smoke": Scale(
        "smoke", (0,), 1, 1, False, "simple_dp3", ("simple_dp3", CONTROL, "manicm"), ("metaworld/button-press",),
        ("metaworld/button-press",), 5, 1, _REAL[:1], 1,
    ),
    "cpu": Scale(
        "quick", (0,), 50, 10, True, "simple_dp3", ("simple_dp3", "simple_dp3_4", CONTROL, "manicm", "manicm_4"),
        ("benchmark31",), _FEW, 8, 10, _REAL, 100,
    ),
    "paper": Scale(
        "paper", (0, 1, 2), 50, 10, False, "dp3",
        ("dp", "image_manicm", "voxel_dp", "voxel_manicm", "bc_gmm_3d", "bc_rnn_3d", "dp3", "simple_dp3", "dp3_4",
         "simple_dp3_4", "manicm:dp3", "manicm_4:dp3", f"{CONTROL}:dp3"),
        ("benchmark31",), _FEW, 20, 20, _REAL, 100,
    ),
}  # fmt: skip


# ---- what is run ----------------------------------------------------------------------------------------------------


def known(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names that are methods of this version."""
    return tuple(name for name in names if _is_known(name))


def _is_known(name: str) -> bool:
    try:
        return bool(parse_methods([name]))
    except UnknownNameError:
        return False


def plans(scale: Scale, out: Path, only: Sequence[str], device: str) -> dict[str, Plan]:
    """Return table -> plan; main table and DDIM steps share a folder, and so their trainings."""
    common = Plan(
        env_ids=parse_envs(",".join(scale.envs)), methods=known(scale.methods), seeds=scale.seeds, preset=scale.preset,
        out=out / "grid", data=out / "data", demos=scale.demos, colors=scale.colors, episodes=scale.episodes,
        device=device,
    )  # fmt: skip
    few = parse_envs(",".join(scale.few_envs))
    steps = tuple(known(names)[0] for names in ddim_rows(scale.teacher).values())
    found = {
        "main": common,
        "ddim": replace(common, env_ids=few, methods=steps),
        "prediction": replace(
            common, env_ids=few, methods=prediction_methods(scale.teacher), out=out / "prediction",
            evaluations=scale.evaluations, evaluation_episodes=scale.evaluation_episodes,
        ),
    }  # fmt: skip
    return {name: plan for name, plan in found.items() if name in only}


def run(
    scale: Scale, out: Path, only: Sequence[str], processes: int, device: str, command: str, console: Console
) -> dict[str, Any]:
    """Do what is not done yet of the tables asked for; return table -> results, JSON values."""
    found: dict[str, Any] = {
        name: benchmark(plan, processes=processes, command=command, console=console)
        for name, plan in plans(scale, out, only, device).items()
    }
    if "real" in only:
        real = real_world()
        real.main(scale.real, scale.real_episodes, scale.real_episodes, out=out / "real_world")
        found["real"] = json.loads((out / "real_world" / "real_world.json").read_text())
    return found


def main(
    scale: Literal["smoke", "cpu", "paper"] = "cpu",
    only: tuple[Table, ...] = ("main", "ddim", "prediction", "real"),
    results: tuple[Path, ...] = (),
    envs: str = "",
    out: Path = Path("runs/tables"),
    processes: int | None = None,
    device: str = "cpu",
) -> int:
    """Run what is missing of the tables, and print them; or print them from finished runs.

    Args:
        scale: smoke shows that everything runs; cpu is what two cores can do: the preset quick, one training seed, 50
            episodes; paper is the preset paper with three seeds.
        only: tables.
        results: finished runs to print from: folders of this script, of 'manicm-ms benchmark', of the real-world table.
        envs: tasks in place of the scale's, ids and tags separated by commas.
        out: folder of everything; another one for each scale.
        processes: that work at once; by default one a core, 0 works in this one.
        device: torch device of trainings and policies.
    """
    chosen, command = SCALES[scale], shlex.join(["python", "scripts/reproduce_tables.py", *sys.argv[1:]])
    if envs:
        chosen = replace(chosen, envs=(envs,), few_envs=(envs,))
    if results:
        found = read_results(results)
    else:
        resolve_device(device)  # before anything is collected
        count = default_num_envs() if processes is None else processes
        found = run(chosen, out, only, count, device, command, Console(stderr=True))
    text = document(found, only, chosen.teacher, command)
    print(text)
    if not results:
        before = stored(out) if (out / "tables.json").is_file() else {}
        write_json(out / "tables.json", before | found)
        write_text(out / "tables.md", text)
        if "prediction" in found and (lines := curves(found["prediction"])):
            whose = {"teacher": False, "student": True}
            panels = [
                Panel(f"{role}, success, %", {n: v for n, v in lines.items() if n.startswith("manicm") == is_student})
                for role, is_student in whose.items()
            ]
            write_text(out / "learning_curves.svg", curves_plot(panels, "Success over the steps of the training"))
    return 1 if any(part.get("missing") for part in found.values()) else 0


if __name__ == "__main__":
    try:
        sys.exit(tyro.cli(main, description=__doc__))
    except ManicmError as error:
        print(f"reproduce_tables.py: {error}", file=sys.stderr)
        sys.exit(2)
