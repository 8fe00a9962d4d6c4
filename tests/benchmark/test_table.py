"""The numbers of the table, from results that were made by hand."""

from pathlib import Path

import numpy as np
import pytest

from manicm_ms.benchmark.jobs import JudgeJob
from manicm_ms.benchmark.plan import Plan
from manicm_ms.benchmark.report import highest_table, main_table, paired_lines, paper_table, write_benchmark
from manicm_ms.benchmark.table import compile_table
from manicm_ms.paths import write_json

ENVS = ("adroit/door", "metaworld/reach", "metaworld/soccer")


def write_results(plan, env_id, seed, method, wins, evaluations=()):
    """What a judge job leaves: the first `wins` of its fresh seeds were solved."""
    job = JudgeJob(plan, env_id, seed, next(m for m in plan.parsed_methods if m.name == method))
    job.stem.parent.mkdir(parents=True, exist_ok=True)
    write_json(
        job.result_file,
        {
            "nfe": 10 if method == "simple_dp3" else 1,
            "episodes": [
                {"seed": s, "success": k < wins, "steps": 10, "decisions": 4, "return": 0.0, "crashed": None}
                for k, s in enumerate(plan.fresh_seeds)
            ],
            "evaluations": [{"step": k, "n": 20, "successes": won} for k, won in enumerate(evaluations)],
        },
    )


@pytest.fixture
def plan(tmp_path):
    return Plan(
        env_ids=ENVS, methods=("simple_dp3", "manicm"), seeds=(0, 1), preset="quick", out=tmp_path / "bench",
        data=Path("data"), episodes=10,
    )  # fmt: skip


WINS = {
    ("adroit/door", "simple_dp3"): (10, 8), ("adroit/door", "manicm"): (9, 9),
    ("metaworld/reach", "simple_dp3"): (5, 5), ("metaworld/reach", "manicm"): (6, 4),
    ("metaworld/soccer", "simple_dp3"): (2, 0), ("metaworld/soccer", "manicm"): (1, 1),
}  # fmt: skip


@pytest.fixture
def results(plan):
    for (env_id, method), both in WINS.items():
        for seed, wins in zip(plan.seeds, both, strict=True):
            write_results(plan, env_id, seed, method, wins, evaluations=(20, 0, 10, 10, 10, 10, 5))
    return compile_table(plan, "manicm-ms benchmark")


def row(results, method):
    return next(r for r in results["rows"] if r["method"] == method)


def test_groups_and_average_are_means_over_tasks(results):
    teacher = row(results, "simple_dp3")
    assert list(teacher["groups"]) == ["adroit", "easy", "medium"]
    assert teacher["groups"]["adroit"]["success_rate"] == pytest.approx(0.9)
    assert teacher["average"]["success_rate"] == pytest.approx((0.9 + 0.5 + 0.1) / 3)
    assert teacher["average"]["tasks"] == 3
    by_seed = [(1.0 + 0.5 + 0.2) / 3, (0.8 + 0.5 + 0.0) / 3]
    assert teacher["average"]["sd_over_seeds"] == pytest.approx(np.std(by_seed, ddof=1))


def test_the_papers_score_is_the_mean_of_the_five_highest_of_each_training(results):
    expected = (20 + 10 + 10 + 10 + 10) / 5 / 20
    assert row(results, "manicm")["average"]["mean_of_5_highest"] == pytest.approx(expected)
    assert "60.0" in highest_table(results).rows[1]


def test_fewer_than_five_evaluations_give_no_such_score(plan):
    write_results(plan, "adroit/door", 0, "manicm", 5, evaluations=(20, 20, 20, 20))
    results = compile_table(plan, "x")
    assert row(results, "manicm")["average"]["mean_of_5_highest"] is None
    assert highest_table(results) is None


def test_pairs_meet_on_task_training_seed_and_fresh_seed(results):
    (pair,) = results["paired"]
    assert (pair["first"], pair["second"], pair["tasks"]) == ("simple_dp3", "manicm", 3)
    # Wins are the first seeds of each list, so of every pair the larger number minus the smaller are one's alone.
    both = sum(min(a, b) for t in ENVS for a, b in zip(WINS[t, "simple_dp3"], WINS[t, "manicm"], strict=True))
    assert pair["both"] == both
    assert pair["both"] + pair["only_first"] == sum(sum(WINS[t, "simple_dp3"]) for t in ENVS)
    assert pair["both"] + pair["only_second"] == sum(sum(WINS[t, "manicm"]) for t in ENVS)
    assert "paired on the same 60 episodes of 3 tasks" in paired_lines(results)[0]
    wins = {m: np.array([WINS[t, m] for t in ENVS]).sum(axis=0) / 30 for m in ("simple_dp3", "manicm")}
    assert list(pair["difference_by_seed"].values()) == pytest.approx(list(wins["manicm"] - wins["simple_dp3"]))


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
