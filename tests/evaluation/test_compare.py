"""Finished evaluations compared from their records: numbers, names, refusals with nothing written, printed words."""

import io
import json
import shutil
from dataclasses import replace

import pytest
from point_mass import SPEC, PointMass, Proportional
from rich.console import Console

from manicm_ms.cli import main
from manicm_ms.errors import ConfigError, NotComparableError, OutputExistsError, UnknownNameError
from manicm_ms.evaluation.compare import Playing, compare
from manicm_ms.evaluation.contestants import is_checkpoint
from manicm_ms.evaluation.evaluate import evaluate_policies
from manicm_ms.evaluation.play import EnvMaker
from manicm_ms.evaluation.protocol import CONTROL, STUDENT, TEACHER, EvaluatedPolicy, Protocol
from manicm_ms.evaluation.statistics import compare_paired, holm

SEEDS = tuple(range(300, 340))
POLICIES = {
    "teacher": EvaluatedPolicy("teacher", TEACHER, "runs/t", Proportional(gain=3.0, noise_scale=0.1), digest="tt"),
    "once": EvaluatedPolicy("once", CONTROL, "runs/t", Proportional(gain=0.2), digest="tt"),
    "alike": EvaluatedPolicy("alike", STUDENT, "runs/s", Proportional(gain=2.5, noise_scale=0.1), digest="ss"),
    "weak": EvaluatedPolicy("weak", STUDENT, "runs/w", Proportional(gain=2.0, noise_scale=0.9), digest="ww"),
}


def evaluated(out, *names, **env):
    """Evaluate policies into `out` as the command does; return the folder."""
    chosen = [POLICIES[name] for name in names]
    protocol = Protocol(SPEC.env_id, SEEDS, num_envs=8, repetitions=1, videos=0)
    envs = EnvMaker(lambda policy, n, _: PointMass(n, policy.chunk, **env), lambda n, _: None)
    identity = {"policies": [[p.name, p.role, p.digest] for p in chosen]}
    evaluate_policies(chosen, protocol, envs, out, identity, "the command", Console(file=io.StringIO()))
    return out


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    evaluated(folder / "pair", "teacher", "once", "alike")
    evaluated(folder / "weak", "teacher", "weak", crash_at={305: 1})
    return folder


def outcomes(folder, name):
    policies = json.loads((folder / "results.json").read_text())["policies"]
    return next([e["success"] for e in p["episodes"]] for p in policies if p["name"] == name)


def test_numbers_are_those_of_the_records_and_every_p_value_is_corrected(runs, tmp_path):
    out = tmp_path / "out"
    found = compare([runs / "pair"], out, margin=0.3, console=Console(file=io.StringIO()))
    assert json.loads((out / "compare.json").read_text()) == json.loads(json.dumps(found))
    assert (found["start_states"], found["seeds"]) == ("digest", list(SEEDS))
    assert [(p["name"], p["n"]) for p in found["policies"]] == [(n, 40) for n in ("teacher", "once", "alike")]
    teacher = outcomes(runs / "pair", "teacher")
    own = [compare_paired(teacher, outcomes(runs / "pair", name)) for name in ("once", "alike")]
    for pair, expected in zip(found["pairs"], own, strict=True):
        assert [pair[k] for k in expected.counts._fields] == list(expected.counts)
        assert pair["difference_ci95"] == list(expected.difference_ci95)
        assert pair["mcnemar_p"] == expected.mcnemar_p
    assert [p["corrected_p"] for p in found["pairs"]] == holm([o.mcnemar_p for o in own])
    assert [p["verdict"] for p in found["pairs"]] == ["worse", "not worse"]
    page = (out / "compare.md").read_text()
    assert all(pair["sentence"] in page for pair in found["pairs"])
    assert "corrected together by Holm (2 p values)" in page
    assert "| once | control | 0/40 = 0.0 % |" in page


def test_baseline_all_pairs_and_names(runs, tmp_path):
    quiet = Console(file=io.StringIO())
    folders = [runs / "pair", runs / "weak"]
    found = compare(folders, tmp_path / "all", baseline="alike", all_pairs=True, console=quiet)
    first = [(p["first"], p["second"]) for p in found["pairs"]]
    weak = runs / "weak"
    # The weak one's teacher lost an episode to a crash, so that it is not the same row.
    names = [f"teacher ({runs / 'pair'})", "once", "alike", f"teacher ({weak})", "weak"]
    assert [p["name"] for p in found["policies"]] == names
    assert len(first) == 10
    assert {a for a, _ in first[:4]} == {"alike"}
    pair = next(p for p in found["pairs"] if p["second"] == "weak" and p["first"] == "alike")
    assert (pair["start_states"], pair["left_out"], pair["crashed_second"], pair["crashed_first"]) == (39, 1, 1, 0)
    with pytest.raises(UnknownNameError, match=r"unknown baseline 'alke'.*did you mean 'alike'"):
        compare(folders, tmp_path / "no", baseline="alke", console=quiet)
    assert not (tmp_path / "no").exists()


def test_the_same_teacher_of_two_students_is_shown_once(runs, tmp_path):
    def rename(results):
        results["policies"][2]["name"] = "another student"

    other = changed(runs / "pair", tmp_path / "other", rename)
    found = compare([runs / "pair", other], tmp_path / "out", console=Console(file=io.StringIO()))
    assert [p["name"] for p in found["policies"]] == ["teacher", "once", "alike", "another student"]
    assert any("teacher of" in remark and "shown once" in remark for remark in found["remarks"])


def test_one_checkpoint_evaluated_otherwise_is_no_twin_whatever_its_outcomes(tmp_path):
    """Under a sparse reward two failing policies have equal records; their network evaluations tell them apart."""
    quiet, policy = Console(file=io.StringIO()), POLICIES["once"]
    protocol = Protocol(SPEC.env_id, SEEDS, num_envs=8, repetitions=1, videos=0)
    envs = EnvMaker(lambda policy, n, _: PointMass(n, policy.chunk), lambda n, _: None)
    for name in ("teacher", "teacher@4"):
        played = [replace(policy, name=name, role=TEACHER)]
        identity = {"policies": [[name, TEACHER, "tt"]]}
        evaluate_policies(played, protocol, envs, tmp_path / name, identity, "the command", quiet)
    found = compare([tmp_path / "teacher", tmp_path / "teacher@4"], tmp_path / "out", console=quiet)
    assert [p["name"] for p in found["policies"]] == ["teacher", "teacher@4"]


def test_a_checkpoint_may_be_named_with_its_network_evaluations(tmp_path):
    (tmp_path / "manifest.json").write_text("{}")
    assert is_checkpoint(tmp_path.with_name(f"{tmp_path.name}@4"))
    with pytest.raises(ConfigError, match="does not exist"):
        is_checkpoint(tmp_path / "none@4")


def test_more_episodes_than_anybody_plays_are_refused_before_they_are_listed():
    with pytest.raises(ConfigError, match="--episodes must be at most 1000000, got 100000000000"):
        _ = Playing("e", episodes=10**11).seeds


def test_common_seeds_alone_are_compared_and_it_is_said(runs, tmp_path):
    def shorten(results):
        results["policies"] = [{**results["policies"][1], "episodes": results["policies"][1]["episodes"][20:]}]

    fewer = changed(runs / "weak", tmp_path / "fewer", shorten)
    found = compare([runs / "pair", fewer], tmp_path / "out", console=Console(file=io.StringIO()))
    assert found["seeds"] == list(range(320, 340))
    assert [p["n"] for p in found["policies"]] == [20] * 4
    assert "alike: 20 further episodes that not all of the others played are left out." in found["remarks"]


def changed(source, out, change):
    """Copy an evaluation with `change` applied to its results."""
    shutil.copytree(source, out)
    results = json.loads((out / "results.json").read_text())
    change(results)
    (out / "results.json").write_text(json.dumps(results))
    return out


def test_records_of_earlier_versions_are_paired_by_seed_and_it_is_said(runs, tmp_path):
    def forget(results):
        for policy in results["policies"]:
            for episode in policy["episodes"]:
                del episode["start_state"]

    old = changed(runs / "weak", tmp_path / "old", forget)
    found = compare([runs / "pair", old], tmp_path / "out", console=Console(file=io.StringIO()))
    assert found["start_states"] == "seed"
    assert any("taken for the same by environment, realism preset, camera and seed" in r for r in found["remarks"])


def elsewhere(results):
    results["env_id"] = "toy/other"


def shifted(results):
    results["policies"][0]["episodes"][7]["start_state"] = "0" * 16


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (elsewhere, r"was played on toy/point-mass, .* on toy/other: evaluate both alike"),
        (shifted, r"started from other states on 1 common seeds \(307 is the first\)"),
        (lambda r: r.update(realism={"presets": ["d435i"], "rows": []}), r"another realism preset \(clean, d435i\)"),
        (
            lambda r: [e.update(seed=e["seed"] + 100) for p in r["policies"] for e in p["episodes"]],
            "no seed was played",
        ),
    ],
)
def test_what_is_not_comparable_is_refused_in_one_line_with_nothing_written(runs, tmp_path, capsys, change, words):
    other = changed(runs / "weak", tmp_path / "other", change)
    with pytest.raises(NotComparableError, match=f"^not comparable: .*{words}") as error:
        compare([runs / "pair", other], tmp_path / "out")
    assert "\n" not in str(error.value)
    with pytest.raises(SystemExit) as stop:
        main(["compare", str(runs / "pair"), str(other), "--out", str(tmp_path / "out")])
    assert stop.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_another_camera_is_another_start(runs, tmp_path):
    other = changed(runs / "weak", tmp_path / "other", lambda r: None)
    run = json.loads((other / "run.json").read_text())
    (other / "run.json").write_text(json.dumps({**run, "camera": {"fx": 3.0}}))
    with pytest.raises(NotComparableError, match="under another camera"):
        compare([runs / "pair", other], tmp_path / "out")


def test_folders_that_hold_nothing_to_compare_are_refused(runs, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(ConfigError, match="nowhere does not exist"):
        compare([runs / "pair", tmp_path / "nowhere"], out)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="empty holds neither a checkpoint nor a finished evaluation"):
        compare([tmp_path / "empty"], out)
    (tmp_path / "empty" / "run.json").write_text("{}")
    with pytest.raises(ConfigError, match="holds an evaluation that was stopped"):
        compare([tmp_path / "empty"], out)
    (tmp_path / "empty" / "results.json").write_text('{"policies": [{}]}')
    with pytest.raises(ConfigError, match=r"cannot be read as an evaluation's \(KeyError"):
        compare([tmp_path / "empty"], out)
    alone = changed(runs / "weak", tmp_path / "alone", lambda r: r["policies"].pop())
    with pytest.raises(ConfigError, match="at least two policies"):
        compare([alone, alone], out)
    with pytest.raises(ConfigError, match="--margin"):
        compare([runs / "pair"], out, margin=1.0)
    assert not out.exists()


def test_another_comparison_does_not_touch_the_folder_and_the_same_goes_on(runs, tmp_path):
    out, quiet = tmp_path / "out", Console(file=io.StringIO())
    found = compare([runs / "pair"], out, console=quiet)
    assert compare([runs / "pair"], out, console=quiet) == found
    with pytest.raises(OutputExistsError, match=r"another comparison \(margin differ"):
        compare([runs / "pair"], out, margin=0.1, console=quiet)


def test_the_command_prints_table_verdicts_and_notes(runs, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        main(["compare", str(runs / "pair"), str(runs / "weak"), "--margin", "30", "--out", str(tmp_path / "out")])
    assert stop.value.code == 0
    printed = capsys.readouterr().out
    assert "toy/point-mass, 40 start states, seeds 300 to 339" in printed
    assert "NOT WORSE: alike is not worse than" in printed
    assert "by more than 30 points" in printed
    assert "corrected for 4 comparisons" in printed
    assert "weak: 1 episode crashed, counted as failed in its rate." in printed
    assert "1 pair left out, for the simulation crashed" in printed


def test_where_every_episode_crashed_nothing_is_said_and_the_status_is_1(runs, tmp_path, capsys):
    def crash(results):
        for episode in (e for p in results["policies"] for e in p["episodes"]):
            episode.update(success=False, crashed="solver diverged")

    dead = changed(runs / "weak", tmp_path / "dead", crash)
    with pytest.raises(SystemExit) as stop:
        main(["compare", str(dead), "--out", str(tmp_path / "out")])
    assert stop.value.code == 1
    assert "Nothing can be said about weak and teacher" in " ".join(capsys.readouterr().out.split())


def test_an_evaluation_that_stopped_when_decided_is_marked(runs, tmp_path):
    other = changed(runs / "weak", tmp_path / "other", lambda r: r.update(until_decided={}))
    found = compare([other], tmp_path / "out", console=Console(file=io.StringIO()))
    assert any("so that its number of episodes was not planned" in remark for remark in found["remarks"])
