"""What other tools read of an evaluation: LeRobot's keys, counted anew from the records, and a line an episode."""

import io
import json

import pytest
from point_mass import SPEC, PointMass, Proportional
from rich.console import Console

from manicm_ms.evaluation.eval_info import episode_lines, eval_info
from manicm_ms.evaluation.evaluate import evaluate_policies
from manicm_ms.evaluation.play import EnvMaker
from manicm_ms.evaluation.protocol import STUDENT, TEACHER, EvaluatedPolicy, Protocol
from manicm_ms.evaluation.records import EpisodeLog

SEEDS = tuple(range(400, 408))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("info") / "report"
    policies = [
        EvaluatedPolicy("teacher", TEACHER, "runs/t", Proportional(gain=2.0, noise_scale=0.9)),
        EvaluatedPolicy("student, fast", STUDENT, "runs/s", Proportional(gain=0.3)),
    ]
    protocol = Protocol(SPEC.env_id, SEEDS, num_envs=4, repetitions=1, videos=1)

    def for_policy(policy, n, _):
        return PointMass(n, policy.chunk, goes_on=True, crash_at={402: 3})

    envs = EnvMaker(for_policy, lambda n, _: PointMass(n, chunk=None))
    evaluate_policies(policies, protocol, envs, out, {}, "the command", Console(file=io.StringIO()))
    return out


def played(folder, file):
    with EpisodeLog(folder / "episodes" / file) as log:
        return [log[seed] for seed in SEEDS]


def test_the_numbers_of_a_policy_are_those_of_its_records_under_lerobots_keys(folder):
    info = json.loads((folder / "eval_info" / "teacher.json").read_text())
    episodes = played(folder, "teacher.jsonl")
    once = [bool(e.success_once) for e in episodes]
    assert 0 < sum(once) < len(SEEDS)
    assert info["overall"] == {
        "avg_sum_reward": pytest.approx(sum(e.total_return for e in episodes) / 8),
        "pc_success": 100 * sum(once) / 8,
        "n_episodes": 8,
        "video_paths": [f"videos/{path.name}" for path in (folder / "videos").glob("*teacher*")],
    }
    assert info["per_group"] == {SPEC.env_id: info["overall"]}
    (task,) = info["per_task"]
    assert (task["task_group"], task["task_id"]) == (SPEC.env_id, 0)
    assert task["metrics"]["successes"] == once
    assert task["metrics"]["sum_rewards"] == [e.total_return for e in episodes]
    assert info["aggregated"]["pc_success"] == info["overall"]["pc_success"]
    assert [(e["episode_ix"], e["seed"], e["success"]) for e in info["per_episode"]] == [
        (i, seed, won) for i, (seed, won) in enumerate(zip(SEEDS, once, strict=True))
    ]
    assert [e["crashed"] for e in info["per_episode"]].count("solver diverged") == 1


def test_the_file_of_the_folder_is_that_of_the_last_policy(folder):
    own = (folder / "eval_info" / "student-fast.json").read_text()
    assert (folder / "eval_info.json").read_text() == own
    assert json.loads(own)["policy"] == "student, fast"


def test_nothing_that_was_not_measured_is_invented(folder):
    text = (folder / "eval_info.json").read_text()
    assert not any(key in text for key in ("max_reward", "eval_s", "eval_ep_s", "predicted_video_paths", "NaN"))


def test_every_episode_has_a_line_with_its_policy(folder):
    lines = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    expected = [
        {"env_id": SPEC.env_id, "realism_preset": "clean", "policy": name, **e.summary()}
        for name, file in (("teacher", "teacher.jsonl"), ("student, fast", "student-fast.jsonl"))
        for e in played(folder, file)
    ]
    assert lines == expected


def test_presets_are_told_apart_and_a_policy_that_always_crashed_has_no_rate():
    episode = {"seed": 1, "success": False, "return": 0.0, "crashed": "x"}
    rows = [{"preset": preset, "policy": "a", "episodes": [episode]} for preset in ("clean", "d435i")]
    results = {"env_id": "toy/b", "realism": {"presets": ["clean", "d435i"], "rows": rows}, "videos": []}
    assert [line["realism_preset"] for line in episode_lines(results)] == ["clean", "d435i"]
    info = eval_info(results, {"name": "a", "success_rate": None, "episodes": [episode]})
    assert (info["overall"]["pc_success"], info["overall"]["avg_sum_reward"]) == (None, None)
