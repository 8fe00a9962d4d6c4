"""Evaluation under several realism presets: same seeds, each against the ideal world, in every report."""

import io
import json
import re
import shutil

import pytest
from point_mass import SPEC, PointMass, Proportional
from rich.console import Console

from manicm_ms.errors import ConfigError, OutputExistsError, UnknownNameError
from manicm_ms.evaluation.evaluate import evaluate, evaluate_policies
from manicm_ms.evaluation.intervals import rate_interval
from manicm_ms.evaluation.play import EnvMaker, log_file
from manicm_ms.evaluation.protocol import STUDENT, TEACHER, EvaluatedPolicy, Protocol
from manicm_ms.evaluation.records import EpisodeLog
from manicm_ms.evaluation.screen import show
from manicm_ms.evaluation.statistics import compare_paired
from manicm_ms.sensing.realism import REALISM

SEEDS = tuple(range(200, 216))
PRESETS = ("clean", "d435i")
CRASHED = dict.fromkeys(SEEDS[:5], 1)  # under the harder preset


def conditions(preset, seed):
    return REALISM.get(preset).sample(seed, ("ball",))


def run(out, *, presets=PRESETS, made=None, request=None):
    def for_policy(policy, n, preset):
        env = PointMass(n, policy.chunk, crash_at=CRASHED if preset == "d435i" else None)
        if made is not None:
            made.append((preset, env))
        return env

    policies = [
        EvaluatedPolicy("teacher", TEACHER, "runs/teacher", Proportional(gain=2.0, noise_scale=0.6)),
        EvaluatedPolicy("student", STUDENT, "runs/student", Proportional(gain=2.5, noise_scale=0.7)),
    ]
    protocol = Protocol(SPEC.env_id, SEEDS, num_envs=4, repetitions=1, videos=0, realism=presets)
    envs = EnvMaker(for_policy, lambda n, preset: PointMass(n, chunk=None), conditions)
    console = Console(file=io.StringIO(), width=200)
    results = evaluate_policies(policies, protocol, envs, out, request or {"seed": 200}, "the command", console)
    show(results, out, console)
    return results, console.file.getvalue()


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    out = tmp_path_factory.mktemp("realism") / "report"
    return out, *run(out)


def test_every_policy_plays_the_same_seeds_under_every_preset(report):
    _, results, _ = report
    rows = results["realism"]["rows"]
    assert [(row["preset"], row["policy"]) for row in rows] == [
        ("clean", "teacher"), ("clean", "student"), ("d435i", "teacher"), ("d435i", "student")
    ]  # fmt: skip
    assert all([e["seed"] for e in row["episodes"]] == list(SEEDS) for row in rows)
    assert [p["episodes"] for p in results["policies"]] == [row["episodes"] for row in rows[:2]]


def test_rates_and_differences_derive_from_the_records(report):
    out, results, _ = report
    assert results["realism"]["reference"] == "clean"
    for row in results["realism"]["rows"]:
        with EpisodeLog(log_file(out, row["preset"], row["policy"])) as log:
            success = [log[seed].success for seed in SEEDS]
        with EpisodeLog(log_file(out, "clean", row["policy"])) as log:
            ideal = [log[seed].success for seed in SEEDS]
        assert (row["n"], row["successes"]) == (len(SEEDS), sum(success))
        assert row["ci95"] == list(rate_interval(sum(success), len(SEEDS)))
        if row["preset"] == "clean":
            assert row["against_reference"] is None
            continue
        pair = compare_paired(ideal, success)
        assert row["against_reference"]["difference"] == pair.difference < 0
        assert row["against_reference"]["mcnemar_p"] == pair.mcnemar_p
        assert row["crashed"] == len(CRASHED)


def test_every_episode_records_what_was_drawn_for_it(report):
    _, results, _ = report
    for row in results["realism"]["rows"]:
        for episode in row["episodes"]:
            drawn = conditions(row["preset"], episode["seed"])
            assert episode.get("realism", {}) == drawn
            assert bool(drawn) == (row["preset"] == "d435i")


def test_the_table_is_in_every_report(report):
    out, results, printed = report
    markdown, html = (out / "report.md").read_text(), (out / "report.html").read_text()
    for row in results["realism"]["rows"]:
        share = f"{row['successes']}/{row['n']} = {100 * row['success_rate']:.1f} %"
        assert re.search(rf"\| {re.escape(row['preset'])} \| {row['policy']} \| {re.escape(share)} \|", markdown)
        assert re.search(rf"<td>{row['preset']}</td><td>{row['policy']}</td><td>{re.escape(share)}</td>", html)
        assert share in printed
    difference = results["realism"]["rows"][2]["against_reference"]["difference"]
    assert all(f"{100 * difference:+.1f} points" in text for text in (markdown, html, printed))
    assert "teacher under d435i, seed 200: solver diverged" in markdown
    stored = json.loads((out / "results.json").read_text())
    assert stored == json.loads(json.dumps(results))


def test_a_run_stopped_midway_goes_on_with_the_missing_episodes_of_that_preset(tmp_path, report):
    out = tmp_path / "report"
    shutil.copytree(report[0], out)
    log = log_file(out, "d435i", "teacher")
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(lines[:10]) + lines[10][:30])
    made = []
    again, _ = run(out, made=made)
    ((preset, env),) = made
    assert preset == "d435i"
    assert sorted(env.played) == sorted(set(SEEDS) - {json.loads(line)["seed"] for line in lines[:10]})
    assert again["realism"] == report[1]["realism"]


def test_the_ideal_world_alone_is_told_as_ever(tmp_path):
    results, printed = run(tmp_path / "report", presets=("clean",))
    assert "realism" not in results
    assert all("realism" not in episode for policy in results["policies"] for episode in policy["episodes"])
    text = printed + (tmp_path / "report" / "report.md").read_text() + (tmp_path / "report" / "report.html").read_text()
    assert "realism" not in text.lower()


def test_one_harder_preset_alone_is_named(tmp_path):
    results, _ = run(tmp_path / "report", presets=("d435i",))
    markdown = (tmp_path / "report" / "report.md").read_text()
    assert "Realism preset of these episodes: d435i." in markdown
    assert "under each realism preset" not in markdown
    assert results["realism"]["rows"][0]["against_reference"] is None
    assert results["policies"][0]["episodes"][0]["realism"] == conditions("d435i", SEEDS[0])


@pytest.mark.parametrize(
    ("realism", "error", "message"),
    [
        ("clean,d435", UnknownNameError, "did you mean 'd435i'"),
        ("clean,clean", ConfigError, "name each realism preset once"),
        (",", ConfigError, "name each realism preset once"),
    ],
)
def test_bad_presets_are_refused_before_anything_is_written(tmp_path, realism, error, message):
    with pytest.raises(error, match=message):
        evaluate([tmp_path / "none"], "ur3e/slide-block", 2, 0, tmp_path / "out", realism=realism)
    assert not (tmp_path / "out").exists()


def test_other_presets_do_not_touch_the_folder(report):
    out, _, _ = report
    with pytest.raises(OutputExistsError, match="another evaluation"):
        run(out, request={"seed": 200, "realism": [["d435i+dr", {}]]})
