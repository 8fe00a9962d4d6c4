"""The whole evaluation on a real, small env: numbers derive from records, reports hold them, kills do no harm."""

import dataclasses
import io
import json
import re

import pytest
from point_mass import SPEC, PointMass, Proportional
from rich.console import Console

from manicm_ms.cli.evaluating import evaluate_command
from manicm_ms.errors import ConfigError, OutputExistsError, SpecMismatchError
from manicm_ms.evaluation.evaluate import evaluate_policies
from manicm_ms.evaluation.intervals import rate_interval
from manicm_ms.evaluation.origins import Origin
from manicm_ms.evaluation.play import EnvMaker
from manicm_ms.evaluation.policies import require_made_for
from manicm_ms.evaluation.protocol import CONTROL, STUDENT, TEACHER, EvaluatedPolicy, Protocol
from manicm_ms.evaluation.records import EpisodeLog
from manicm_ms.evaluation.report import render_markdown
from manicm_ms.evaluation.results import without_rate
from manicm_ms.evaluation.screen import show
from manicm_ms.evaluation.statistics import compare_paired

SEEDS = tuple(range(100, 124))
COMMAND = "manicm-ms evaluate teacher student --env toy/point-mass --episodes 24 --seed 100 --out report"


def policies():
    return [
        EvaluatedPolicy("teacher", TEACHER, "runs/teacher", Proportional(gain=2.0, noise_scale=0.6)),
        EvaluatedPolicy("teacher, one step", CONTROL, "runs/teacher", Proportional(gain=0.5)),
        EvaluatedPolicy("student", STUDENT, "runs/student", Proportional(gain=2.5, noise_scale=0.7)),
    ]


def run(out, *, request=None, crash_at=None, made=None, videos=2, seeds=SEEDS, film_env=PointMass):
    def for_policy(policy, n, preset):
        env = PointMass(n, policy.chunk, crash_at=crash_at)
        if made is not None:
            made.append(env)
        return env

    protocol = Protocol(SPEC.env_id, seeds, num_envs=4, repetitions=3, videos=videos)
    envs = EnvMaker(for_policy, lambda n, preset: film_env(n, chunk=None))
    console = Console(file=io.StringIO(), width=160)
    results = evaluate_policies(policies(), protocol, envs, out, request or {"seed": 100}, COMMAND, console)
    show(results, out, console)
    return results, console.file.getvalue()


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    out = tmp_path_factory.mktemp("evaluate") / "report"
    results, printed = run(out, crash_at={103: 2})
    return out, results, printed


def test_results_json_is_strict_and_has_the_documented_keys(report):
    out, results, _ = report
    stored = json.loads((out / "results.json").read_text(), parse_constant=lambda c: pytest.fail(f"{c} in JSON"))
    assert stored == json.loads(json.dumps(results))
    assert {"env_id", "seeds", "command", "versions", "policies", "paired"} <= stored.keys()
    assert [p["name"] for p in stored["policies"]] == ["teacher", "teacher, one step", "student"]
    keys = {
        "name",
        "checkpoint",
        "nfe",
        "n",
        "successes",
        "success_rate",
        "ci95",
        "latency_ms",
        "device",
        "threads",
        "dtype",
    }
    assert all(keys <= p.keys() and {"median", "p95"} <= p["latency_ms"].keys() for p in stored["policies"])
    pair_keys = {"both", "only_first", "only_second", "neither", "difference", "difference_ci95", "mcnemar_p"}
    assert pair_keys <= stored["paired"].keys()
    assert stored["seeds"] == list(SEEDS)


def test_every_number_derives_from_the_episode_records(report):
    out, results, _ = report
    outcomes = {}
    for policy, file in zip(results["policies"], ["teacher", "teacher-one-step", "student"], strict=True):
        with EpisodeLog(out / "episodes" / f"{file}.jsonl") as log:
            episodes = [log[s] for s in SEEDS]
        outcomes[policy["name"]] = [e.success for e in episodes]
        assert policy["successes"] == sum(outcomes[policy["name"]])
        assert policy["n"] == len(SEEDS)
        assert policy["success_rate"] == policy["successes"] / len(SEEDS)
        assert policy["ci95"] == list(rate_interval(policy["successes"], len(SEEDS)))
        assert policy["crashed"] == 1
        assert policy["episodes"] == [e.summary() for e in episodes]
    pair = compare_paired(outcomes["teacher"], outcomes["student"])
    assert {k: results["paired"][k] for k in pair.counts._fields} == pair.counts._asdict()
    assert results["paired"]["difference"] == pair.difference
    assert results["paired"]["mcnemar_p"] == pair.mcnemar_p


def test_a_crashed_episode_stays_in_the_denominator_and_is_shown(report):
    out, results, _ = report
    assert all(p["n"] == 24 and not p["episodes"][3]["success"] for p in results["policies"])
    assert "seed 103: solver diverged" in (out / "report.md").read_text()
    assert "seed 103: solver diverged" in (out / "report.html").read_text()


def test_the_html_is_self_contained_and_holds_table_plots_videos_and_command(report):
    out, results, printed = report
    html = (out / "report.html").read_text()
    loaded = re.findall(r"""(?:src|href)\s*=\s*["']([^"']+)""", html)
    assert loaded
    assert all(link.startswith(("data:", "#")) for link in loaded), "loads something from elsewhere"
    assert "@import" not in html
    assert html.count("<svg") == 2
    assert html.count("data:video/mp4;base64,") == len(results["videos"]) == 4
    assert "177.6" in html
    assert "17.3" in html
    for policy in results["policies"]:
        share = f"{policy['successes']}/{policy['n']} = {100 * policy['success_rate']:.1f} %"
        assert share in html
        assert share in (out / "report.md").read_text()
        assert share in printed
    assert COMMAND in html
    assert str(out / "report.html") in printed


def test_videos_are_of_the_same_seeds_for_both_policies(report):
    _, results, _ = report
    by_policy = {}
    for video in results["videos"]:
        by_policy.setdefault(video["policy"], []).append(video["seed"])
    assert by_policy["teacher"] == by_policy["student"]
    assert set(by_policy) == {"teacher", "student"}


def test_the_same_call_plays_nothing_again_and_tells_the_same(report):
    out, results, _ = report
    made = []
    again, _ = run(out, crash_at={103: 2}, made=made)
    assert made == []
    assert again == results


def test_a_run_stopped_midway_goes_on_with_the_missing_episodes_only(tmp_path, report):
    out = tmp_path / "report"
    run(out, crash_at={103: 2})
    log = out / "episodes" / "student.jsonl"
    lines = log.read_bytes().splitlines(keepends=True)
    log.write_bytes(b"".join(lines[:10]) + lines[10][:40])
    (out / "results.json").unlink()
    made = []
    resumed, _ = run(out, crash_at={103: 2}, made=made)
    kept = {json.loads(line)["seed"] for line in lines[:10]}
    assert sorted(made[0].played) == sorted(set(SEEDS) - kept)
    assert [p["episodes"] for p in resumed["policies"]] == [p["episodes"] for p in report[1]["policies"]]
    assert resumed["paired"] == report[1]["paired"]


def test_another_evaluation_does_not_touch_the_folder(report):
    out, _, _ = report
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    with pytest.raises(OutputExistsError, match="another evaluation"):
        run(out, request={"seed": 7})
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


@pytest.mark.parametrize("content", ["{", "[]", '{"teacher": 3}', '{"teacher": {"median_ms": 1}}'])
def test_a_damaged_file_of_latencies_is_named_with_the_remedy(tmp_path, content):
    out = tmp_path / "report"
    run(out, seeds=SEEDS[:2], videos=0)
    (out / "latency.json").write_text(content)
    with pytest.raises(OutputExistsError, match=r"latency\.json is damaged: delete it"):
        run(out, seeds=SEEDS[:2], videos=0)


class Blind(PointMass):
    """Has lost its renderer."""

    failure: type[BaseException] = RuntimeError

    def render_video_frames(self):
        raise self.failure("vk::DeviceLost [device 0]")


def test_a_renderer_that_fails_costs_the_videos_alone(tmp_path):
    results, printed = run(tmp_path / "report", seeds=SEEDS[:4], film_env=Blind)
    assert "RuntimeError: vk::DeviceLost [device 0]" in printed
    assert results["videos"] == []
    assert json.loads((tmp_path / "report" / "results.json").read_text()) == json.loads(json.dumps(results))


def test_ctrl_c_while_filming_leaves_results_and_report(tmp_path, monkeypatch):
    monkeypatch.setattr(Blind, "failure", KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "report", seeds=SEEDS[:4], film_env=Blind)
    stored = json.loads((tmp_path / "report" / "results.json").read_text())
    assert [p["n"] for p in stored["policies"]] == [4, 4, 4]
    assert (tmp_path / "report" / "report.html").exists()


def test_a_policy_alone_is_evaluated_without_a_pair(tmp_path):
    protocol = Protocol(SPEC.env_id, SEEDS[:4], num_envs=2, repetitions=1, videos=0)
    envs = EnvMaker(lambda policy, n, _: PointMass(n, policy.chunk), lambda n, _: PointMass(n, chunk=None))
    results = evaluate_policies(
        policies()[:1], protocol, envs, tmp_path / "r", {}, COMMAND, Console(file=io.StringIO())
    )
    assert results["paired"] is None
    assert "On the same" not in render_markdown(results)


def test_where_every_episode_crashed_there_is_no_rate(tmp_path, monkeypatch):
    seeds, out = SEEDS[:3], tmp_path / "report"
    results, printed = run(out, seeds=seeds, crash_at=dict.fromkeys(seeds, 1), videos=1)
    for policy in results["policies"]:
        assert (policy["n"], policy["crashed"], policy["successes"]) == (3, 3, 0)
        assert policy["success_rate"] is policy["ci95"] is policy["success_once"] is policy["success_at_end"] is None
    assert results["paired"] is None
    assert without_rate(results) == ["teacher", "teacher, one step", "student"]
    assert "student: every episode crashed, so there is no success rate." in printed
    for text in (printed, (out / "report.md").read_text(), (out / "report.html").read_text()):
        assert "3 = -" in text
        assert "0.0 %" not in text
    monkeypatch.setattr("manicm_ms.evaluation.evaluate.evaluate", lambda *args, **options: results)
    assert evaluate_command((out,), env=SPEC.env_id, out=out) == 1, "the exit status"
    mixed, _ = run(tmp_path / "mixed", seeds=seeds, crash_at=dict.fromkeys(seeds[:2], 1), videos=0)
    assert without_rate(mixed) == []
    monkeypatch.setattr("manicm_ms.evaluation.evaluate.evaluate", lambda *args, **options: mixed)
    assert evaluate_command((out,), env=SPEC.env_id, out=out) == 0


def test_success_at_some_step_and_at_the_last_stand_in_every_report(tmp_path):
    out = tmp_path / "report"

    def for_policy(policy, n, preset):
        return PointMass(n, policy.chunk, goes_on=True)

    protocol = Protocol(SPEC.env_id, SEEDS, num_envs=4, repetitions=1, videos=0)
    envs, console = EnvMaker(for_policy, lambda n, _: PointMass(n, chunk=None)), Console(file=io.StringIO(), width=160)
    restless = [EvaluatedPolicy("restless", TEACHER, "runs/teacher", Proportional(gain=2.0, noise_scale=0.9))]
    results = evaluate_policies(restless, protocol, envs, out, {}, COMMAND, console)
    show(results, out, console)
    (policy,) = results["policies"]
    once, at_end = policy["success_once"], policy["success_at_end"]
    assert once["successes"] == policy["successes"] > at_end["successes"]
    assert at_end["ci95"] == list(rate_interval(at_end["successes"], len(SEEDS)))
    assert at_end["successes"] == sum(e["success_at_end"] for e in policy["episodes"])
    markdown = (out / "report.md").read_text()
    assert f"| {once['successes']}/24 | {at_end['successes']}/24 |" in markdown
    assert f"<td>{once['successes']}/24</td><td>{at_end['successes']}/24</td>" in (out / "report.html").read_text()
    assert f"restless {once['successes']}/24, {at_end['successes']}/24" in console.file.getvalue()


def test_what_a_checkpoint_was_made_for_and_has_seen_is_told_everywhere(tmp_path):
    out = tmp_path / "report"
    origin = Origin.read("toy/b", {"data": {"env_id": SPEC.env_id, "demo_seeds": list(SEEDS[:2])}})
    stranger = dataclasses.replace(policies()[2], origin=origin)
    protocol = Protocol(SPEC.env_id, SEEDS[:4], num_envs=2, repetitions=1, videos=0)
    envs = EnvMaker(lambda policy, n, _: PointMass(n, policy.chunk), lambda n, _: PointMass(n, chunk=None))
    console = Console(file=io.StringIO(), width=80)
    results = evaluate_policies([policies()[0], stranger], protocol, envs, out, {}, COMMAND, console)
    assert results["seen_seeds"] == {"student": 2}
    seen, other = results["remarks"]
    assert "2 of the 4 seeds are those of its own demonstrations" in seen
    assert "student was trained for toy/b and is evaluated on toy/point-mass" in other
    assert [p["trained_for"] for p in results["policies"]] == [[], ["toy/b", "toy/point-mass"]]
    for name in ("report.md", "report.html"):
        text = (out / name).read_text()
        assert seen in text
        assert other in text
        assert "held-out seeds" not in text.split("Results")[0].split("|")[0].replace(seen, "")
    assert other in " ".join(console.file.getvalue().split())


def test_names_cannot_break_the_page(tmp_path):
    hostile = dataclasses.replace(policies()[0], name="<script>alert(1)</script>")
    protocol = Protocol(SPEC.env_id, SEEDS[:2], num_envs=2, repetitions=1, videos=1)
    envs = EnvMaker(lambda policy, n, _: PointMass(n, policy.chunk), lambda n, _: PointMass(n, chunk=None))
    evaluate_policies([hostile], protocol, envs, tmp_path / "r", {}, COMMAND, Console(file=io.StringIO()))
    assert "<script>" not in (tmp_path / "r" / "report.html").read_text()


def test_a_senseless_protocol_is_refused():
    with pytest.raises(ConfigError, match="at least one episode"):
        Protocol(SPEC.env_id, (), num_envs=1)
    with pytest.raises(ConfigError, match="num_envs"):
        Protocol(SPEC.env_id, (1,), num_envs=0)
    with pytest.raises(ConfigError, match="seed must not be negative, got -3"):
        Protocol(SPEC.env_id, (-3, -2), num_envs=1)
    with pytest.raises(ConfigError, match=r"end at 4294967295, and these run from 99999999999 to 99999999999"):
        Protocol(SPEC.env_id, (99_999_999_999,), num_envs=1)
    assert Protocol(SPEC.env_id, (2**32 - 1,), num_envs=1)
    assert Protocol(SPEC.env_id, (99_999_999_999,), num_envs=1, seed_limit=2**63)


def test_a_policy_of_the_dp3_preset_is_told_the_option_that_it_needs():
    theirs = dataclasses.replace(SPEC, obs=dataclasses.replace(SPEC.obs, frame="dp3"))
    evaluated = EvaluatedPolicy("student", STUDENT, "runs/student", Proportional(spec=theirs))
    with pytest.raises(SpecMismatchError, match=r"runs/student learnt from clouds .* add --obs-preset dp3"):
        require_made_for(SPEC, [evaluated])
    require_made_for(theirs, [evaluated])
