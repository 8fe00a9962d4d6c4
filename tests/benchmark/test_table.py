"""The numbers of the table, from results that were made by hand."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from manicm_ms.benchmark.jobs import EvaluateJob
from manicm_ms.benchmark.plan import Plan
from manicm_ms.benchmark.report import (
    all_tables,
    end_table,
    highest_table,
    interval_lines,
    main_table,
    paired_lines,
    paired_table,
    paper_table,
    training_table,
    write_benchmark,
)
from manicm_ms.benchmark.summary import SCHEMA_VERSION, summarised
from manicm_ms.benchmark.table import compile_table
from manicm_ms.paths import write_json

ENVS = ("adroit/door", "metaworld/reach", "metaworld/soccer")


DOCS = Path(__file__).parents[2] / "docs" / "results"


def write_results(plan, env_id, seed, method, wins, evaluations=(), **at_end):
    """What an evaluate job leaves: the first `wins` of its seeds were solved, the first `at_end` at the last step."""

    def outcomes(k):
        known = {} if not at_end else {"success_at_end": None if at_end["at_end"] is None else k < at_end["at_end"]}
        return {"success": k < wins, **({"success_once": k < wins} if known else {}), **known}

    job = EvaluateJob(plan, env_id, seed, next(m for m in plan.parsed_methods if m.name == method))
    job.stem.parent.mkdir(parents=True, exist_ok=True)
    write_json(
        job.result_file,
        {
            "nfe": 10 if method == "simple_dp3" else 1,
            "episodes": [
                {"seed": s, **outcomes(k), "steps": 10, "decisions": 4, "return": 0.0, "crashed": None}
                for k, s in enumerate(plan.fresh_seeds)
            ],
            "evaluations": [{"step": k, "n": 20, "successes": won} for k, won in enumerate(evaluations)],
        },
    )


def plan_in(folder):
    return Plan(
        env_ids=ENVS, methods=("simple_dp3", "manicm"), seeds=(0, 1), preset="quick", out=folder, data=Path("data"),
        episodes=10,
    )  # fmt: skip


@pytest.fixture
def plan(tmp_path):
    return plan_in(tmp_path / "bench")


WINS = {
    ("adroit/door", "simple_dp3"): (10, 8), ("adroit/door", "manicm"): (9, 9),
    ("metaworld/reach", "simple_dp3"): (5, 5), ("metaworld/reach", "manicm"): (6, 4),
    ("metaworld/soccer", "simple_dp3"): (2, 0), ("metaworld/soccer", "manicm"): (1, 1),
}  # fmt: skip


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    plan = plan_in(tmp_path_factory.mktemp("table") / "bench")
    for (env_id, method), both in WINS.items():
        for seed, wins in zip(plan.seeds, both, strict=True):
            write_results(plan, env_id, seed, method, wins, evaluations=(20, 0, 10, 10, 10, 10, 5))
    return compile_table(plan, "manicm-ms benchmark")


def row(results, method):
    return next(r for r in results["rows"] if r["method"] == method)


def test_groups_stand_in_the_papers_order_whichever_file_of_tasks_is_imported_first():
    code = (
        "import manicm_ms.tasks.metaworld\n"
        "from manicm_ms.envs.simulator import ENVS\n"
        "from manicm_ms.benchmark import summary\n"
        "assert [n for n in ENVS.names() if '/' in n][0].startswith('metaworld')\n"
        "ids = ('metaworld/reach', 'adroit/door', 'ur3e/slide-block', 'metaworld/soccer')\n"
        "print(*sorted((summary.group_of(i) for i in ids), key=lambda g: summary._order({'group': g})))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["adroit", "easy", "medium", "ur3e"]


def test_groups_and_average_are_means_over_tasks(results):
    teacher = row(results, "simple_dp3")
    assert list(teacher["groups"]) == ["adroit", "easy", "medium"]
    assert teacher["groups"]["adroit"]["success_rate"] == pytest.approx(0.9)
    assert teacher["average"]["success_rate"] == pytest.approx((0.9 + 0.5 + 0.1) / 3)
    assert teacher["average"]["tasks"] == 3
    by_seed = [(1.0 + 0.5 + 0.2) / 3, (0.8 + 0.5 + 0.0) / 3]
    assert list(teacher["average"]["by_seed"].values()) == pytest.approx(by_seed)
    assert teacher["average"]["range"] == pytest.approx([min(by_seed), max(by_seed)])
    assert teacher["average"]["speaks_of"] == "these networks"
    table = training_table(results)
    assert table.headers == ("method", "training 0", "training 1", "mean", "range", "95 % interval of the mean")
    assert table.rows[0][:5] == ("simple_dp3", "56.7", "43.3", "50.0", "43.3 to 56.7")


def test_the_papers_score_is_the_mean_of_the_five_highest_of_each_training(results):
    expected = (20 + 10 + 10 + 10 + 10) / 5 / 20
    assert row(results, "manicm")["average"]["mean_of_5_highest"] == pytest.approx(expected)
    assert "60.0" in highest_table(results).rows[1]


def test_fewer_than_five_evaluations_give_no_such_score(plan):
    write_results(plan, "adroit/door", 0, "manicm", 5, evaluations=(20, 20, 20, 20))
    results = compile_table(plan, "x")
    assert row(results, "manicm")["average"]["mean_of_5_highest"] is None
    assert highest_table(results) is None


def test_pairs_meet_on_task_training_seed_and_start_state_and_are_tested_one_by_one(results):
    (pair,) = results["paired"]
    assert (pair["first"], pair["second"], pair["tasks"], pair["start_states"]) == ("simple_dp3", "manicm", 3, 30)
    for entry in pair["by_task"]:
        teacher, student = (WINS[entry["env_id"], m] for m in ("simple_dp3", "manicm"))
        # Wins are the first seeds of each list, so the larger number minus the smaller are one's alone.
        assert entry["both"] == sum(map(min, teacher, student))
        assert entry["both"] + entry["only_first"] == sum(teacher)
        assert entry["both"] + entry["only_second"] == sum(student)
        alone = [abs(a - b) for a, b in zip(teacher, student, strict=True)]
        assert list(entry["mcnemar_p"].values()) == pytest.approx([min(1, 2 * 0.5**k) for k in alone])
    assert "mcnemar_p" not in pair, "trainings replay the start states and tasks differ: nothing is pooled"
    assert (pair["tests"], pair["smallest_p"], pair["smallest_p_holm"]) == (6, 1.0, 1.0)
    wins = {m: np.array([WINS[t, m] for t in ENVS]).sum(axis=0) / 30 for m in ("simple_dp3", "manicm")}
    assert list(pair["by_seed"].values()) == pytest.approx(list(wins["manicm"] - wins["simple_dp3"]))
    (line,) = paired_lines(results)
    assert "mean of 3 tasks on the same 30 start states: +0.0 points (by training -3.3, +3.3" in line
    assert "the smallest p of 6 is 1, 1 after Holm's correction" in line
    assert len(paired_table(pair).rows) == 3


def test_trainings_that_replay_one_another_do_not_narrow_the_interval(plan):
    few, many = [], []
    for seeds, found in (((0,), few), ((0, 1, 2, 3), many)):
        wide = dataclasses.replace(plan, seeds=seeds, episodes=50, out=plan.out / str(len(seeds)))
        for env_id in ENVS:
            for seed in seeds:
                write_results(wide, env_id, seed, "simple_dp3", 30)
        found += row(compile_table(wide, "x"), "simple_dp3")["average"]["ci95"]
    assert many == pytest.approx(few)


def test_from_five_trainings_on_the_table_speaks_of_the_recipe(plan):
    wide = dataclasses.replace(plan, seeds=tuple(range(5)), episodes=20)
    for env_id in ENVS:
        for seed, wins in enumerate((20, 0, 20, 0, 20)):
            write_results(wide, env_id, seed, "simple_dp3", wins)
    average = row(compile_table(wide, "x"), "simple_dp3")["average"]
    assert average["speaks_of"] == "the recipe"
    assert average["ci95"][1] - average["ci95"][0] > 0.4, "start states alone would say 0.6 and nothing else"


def test_success_at_some_step_and_at_the_last_stand_side_by_side(plan, results):
    assert end_table(results) is None, "results of earlier versions do not know"
    write_results(plan, "adroit/door", 0, "simple_dp3", 7, at_end=4)
    write_results(plan, "adroit/door", 1, "simple_dp3", 9, at_end=9)
    write_results(plan, "metaworld/reach", 0, "manicm", 5, at_end=None)
    found = compile_table(plan, "x")
    assert next(c for c in found["cells"] if c["env_id"] == "adroit/door")["success_at_end"]["0"].count(True) == 4
    assert end_table(found).rows[:2] == [("adroit/door", "16/20, 13/20", "-"), ("metaworld/reach", "-", "5/10, -")]


@pytest.mark.parametrize("name", ["six", "14", "highest"])
def test_the_page_of_results_is_what_the_kept_outcomes_give(name):
    page = (DOCS / "benchmark.md").read_text()
    kept = json.loads((DOCS / "data" / f"benchmark_{name}.json").read_text())
    found = summarised(kept)
    assert kept["schema_version"] == SCHEMA_VERSION, "scripts/results/renew_results.py brings it up to date"
    tables = [main_table(found), highest_table(found)] if name == "highest" else [
        table for table in all_tables(found) if table.title != paper_table(found).title
    ]  # fmt: skip
    for table in tables:
        for line in (table.headers, *table.rows):
            assert f"| {' | '.join(line)} |" in page
    if name != "highest":
        assert all(f"- {sentence}\n" in page for sentence in paired_lines(found))
        assert all(note in page for note in interval_lines(found))


def test_where_every_episode_crashed_there_is_no_rate_and_the_job_is_named(plan):
    write_results(plan, "adroit/door", 0, "simple_dp3", 5)
    job = EvaluateJob(plan, "adroit/door", 1, plan.parsed_methods[0])
    episodes = [{"seed": s, "success": False, "steps": 0, "crashed": "no device"} for s in plan.fresh_seeds]
    job.stem.parent.mkdir(parents=True)
    write_json(job.result_file, {"nfe": 10, "episodes": episodes, "evaluations": []})
    results = compile_table(plan, "x")
    assert row(results, "simple_dp3")["average"]["by_seed"] == {"0": 0.5}
    (reason,) = [m["reason"] for m in results["missing"] if m["job"] == job.name]
    assert "every episode crashed, seed 100000 with: no device" in reason


def test_a_cell_that_is_not_done_is_named_and_left_out(plan):
    write_results(plan, "adroit/door", 0, "simple_dp3", 5)
    results = compile_table(plan, "x")
    assert len(results["missing"]) == 3 * 2 * 2 - 1
    assert {m["reason"] for m in results["missing"]} == {"not done yet"}
    assert row(results, "simple_dp3")["average"]["n"] == 10
    assert row(results, "manicm")["average"] is None
    assert "[1 of 3 tasks]" in main_table(results).rows[0][-2], "no match for an average of all"
    assert results["paired"] == []
    write_benchmark(results, plan.out)  # of whatever is there


def test_the_papers_figures_stand_beside_with_their_own_groups(results):
    table = paper_table(results)
    assert table.headers == ("method", "adroit", "easy", "medium", "average", "one decision")
    assert table.rows[0] == ("simple_dp3", "73.0", "90.4", "47.3", "75.8", "120.6 ms")
    assert "90.0" in main_table(results).rows[0][2]
