"""An evaluation that stops when it is decided: on a real, small env, sealed, resumed, and refused where it must be."""

import io
import json
import shutil

import pytest
from point_mass import SPEC, PointMass, Proportional
from rich.console import Console

from manicm_ms.cli import main
from manicm_ms.errors import ConfigError, OutputExistsError
from manicm_ms.evaluation.anytime import decide
from manicm_ms.evaluation.decided import PLAN_FILE, StoppingRule
from manicm_ms.evaluation.evaluate import evaluate_policies
from manicm_ms.evaluation.play import EnvMaker
from manicm_ms.evaluation.protocol import STUDENT, TEACHER, EvaluatedPolicy, Protocol
from manicm_ms.evaluation.records import EpisodeLog
from manicm_ms.evaluation.screen import show

SEEDS = tuple(range(200, 260))
GOOD, POOR = {"gain": 3.0, "noise_scale": 0.1}, {"gain": 0.2, "noise_scale": 0.1}


def run(out, student, *, margin=0.3, seeds=SEEDS, made=None, middle=False, request=None, realism=("clean",), **env):
    def for_policy(policy, n, preset):
        made_now = PointMass(n, policy.chunk, **env)
        if made is not None:
            made.append(made_now)
        return made_now

    policies = [EvaluatedPolicy("teacher", TEACHER, "runs/teacher", Proportional(**GOOD))]
    policies += [EvaluatedPolicy("between", STUDENT, "runs/between", Proportional(**GOOD))] if middle else []
    policies += [EvaluatedPolicy("student", STUDENT, "runs/student", Proportional(**student))]
    rule = StoppingRule(margin)
    protocol = Protocol(SPEC.env_id, seeds, num_envs=4, repetitions=1, videos=0, realism=realism)
    envs = EnvMaker(for_policy, lambda n, _: PointMass(n, chunk=None))
    console = Console(file=io.StringIO(), width=200)
    request = {"seed": seeds[0], **(request or {}), **rule.identity()}
    results = evaluate_policies(policies, protocol, envs, out, request, "the command", console, rule)
    show(results, out, console)
    return results, console.file.getvalue()


@pytest.fixture(scope="module")
def agreeing(tmp_path_factory):
    out = tmp_path_factory.mktemp("decided") / "report"
    results, printed = run(out, GOOD, middle=True)
    return out, results, printed


def test_it_stops_after_the_block_in_which_it_was_decided_and_all_policies_have_played_it(agreeing):
    out, results, printed = agreeing
    n = len(results["seeds"])
    assert n % 10 == 0
    assert n < len(SEEDS)
    assert [p["n"] for p in results["policies"]] == [n, n, n]
    found = results["until_decided"]
    assert (found["verdict"], found["pairs"], found["left_out"]) == ("not worse", n, 0)
    differences = []
    with (
        EpisodeLog(out / "episodes" / "teacher.jsonl") as first,
        EpisodeLog(out / "episodes" / "student.jsonl") as last,
    ):
        assert len(first) == len(last) == n
        differences = [float(last[s].success) - float(first[s].success) for s in results["seeds"]]
    assert decide(differences, 0.3).shows_not_worse
    assert not decide(differences[:-10], 0.3).shows_not_worse
    assert f"Stopped after {n} pairs: student is not worse than teacher by more than 30 points." in printed
    for name in ("report.md", "report.html"):
        assert f"Stopped after {n} pairs" in (out / name).read_text()
    assert json.loads((out / "results.json").read_text()) == json.loads(json.dumps(results))


def test_the_plan_is_sealed_before_the_first_episode(tmp_path):
    out = tmp_path / "r"

    class Stopped(PointMass):
        def reset(self, **kwargs):
            raise KeyboardInterrupt

    rule, request = StoppingRule(0.1), {"seed": 200}
    policies = [EvaluatedPolicy(n, TEACHER, f"runs/{n}", Proportional(**GOOD)) for n in ("a", "b")]
    envs = EnvMaker(lambda policy, n, _: Stopped(n, policy.chunk), lambda n, _: None)
    protocol = Protocol(SPEC.env_id, SEEDS, num_envs=2, repetitions=1)
    with pytest.raises(KeyboardInterrupt):
        evaluate_policies(policies, protocol, envs, out, request, "", Console(file=io.StringIO()), rule)
    plan = json.loads((out / PLAN_FILE).read_text())
    assert (plan["margin"], plan["alpha"], plan["alpha_each"], plan["seeds"]) == (0.1, 0.05, 0.025, [200, 259])
    assert "1 / alpha_each" in plan["rule"]
    assert len(plan["sha256"]) == 64
    assert not list((out / "episodes").glob("*.jsonl")) or not (out / "episodes" / "a.jsonl").read_text()


def test_a_run_stopped_midway_goes_on_and_ends_at_the_same_pair(tmp_path, agreeing):
    out = tmp_path / "report"
    _, results, _ = agreeing
    shutil.copytree(agreeing[0], out)
    log = out / "episodes" / "student.jsonl"
    log.write_bytes(b"".join(log.read_bytes().splitlines(keepends=True)[:13]))
    (out / "results.json").unlink()
    made = []
    again, _ = run(out, GOOD, middle=True, made=made)
    assert len(made) == 1
    assert len(made[0].played) < len(results["seeds"])
    for key in ("until_decided", "paired", "seeds"):
        assert again[key] == results[key]


def test_a_student_that_is_worse_stops_it_too_and_an_open_question_ends_at_the_last_seed(tmp_path):
    results, printed = run(tmp_path / "worse", POOR, margin=0.05)
    assert results["until_decided"]["verdict"] == "worse"
    assert len(results["seeds"]) < len(SEEDS)
    assert "student is worse than teacher by more than 5 points" in printed
    results, printed = run(tmp_path / "open", GOOD, margin=0.05, seeds=SEEDS[:25])
    found = results["until_decided"]
    assert (found["verdict"], found["pairs"], found["pairs_that_would_do"]) == ("underpowered", 25, 110)
    assert "Stopped after 25 pairs: underpowered" in printed
    assert "about 110 pairs would do" in printed


def test_crashed_pairs_and_repeated_start_states_do_not_count(tmp_path):
    results, printed = run(tmp_path / "r", GOOD, crash_at={203: 1, 207: 1})
    found = results["until_decided"]
    assert found["left_out"] == 2
    assert found["pairs"] == len(results["seeds"]) - 2
    assert "Left out of the decision: 2 pairs with a crash" in printed


def test_another_margin_and_a_changed_plan_are_refused(tmp_path):
    out = tmp_path / "r"
    run(out, POOR)
    before = (out / "results.json").read_bytes()
    with pytest.raises(OutputExistsError, match=r"margin differ; margin there: 0\.3, asked: 0\.2"):
        run(out, POOR, margin=0.2)
    plan = json.loads((out / PLAN_FILE).read_text())
    (out / PLAN_FILE).write_text(json.dumps({**plan, "alpha_each": 0.2}))
    with pytest.raises(OutputExistsError, match="is not the plan that this evaluation began with"):
        run(out, POOR)
    (out / PLAN_FILE).write_text("{")
    with pytest.raises(OutputExistsError, match="is not the plan"):
        run(out, POOR)
    assert (out / "results.json").read_bytes() == before


def test_several_presets_and_a_policy_alone_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ConfigError, match=r"--realism names 2 \(clean, d435i\): give each an evaluation of its own"):
        run(tmp_path / "r", GOOD, realism=("clean", "d435i"))
    alone = [EvaluatedPolicy("a", TEACHER, "runs/a", Proportional())]
    with pytest.raises(ConfigError, match="name at least two"):
        StoppingRule(0.05).require_possible(alone, Protocol(SPEC.env_id, (1,), num_envs=1))
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--until-decided", "--margin", "0"], "must lie between 0 and 100, both excluded, got 0"),
        (["--until-decided", "--margin", "150"], "both excluded, got 150"),
        (["--until-decided", "--margin", "nan"], "both excluded, got nan"),
        (["--margin", "3"], "--margin belongs to --until-decided"),
    ],
)
def test_a_senseless_margin_is_refused_by_the_command(tmp_path, capsys, options, words):
    out = tmp_path / "r"
    with pytest.raises(SystemExit) as stop:
        main(["evaluate", str(tmp_path), "--env", "ur3e/slide-block", "--out", str(out), *options])
    assert stop.value.code == 2
    assert words in capsys.readouterr().err
    assert not out.exists()
