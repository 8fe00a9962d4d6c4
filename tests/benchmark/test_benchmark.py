"""The command on two toy tasks: what it writes, that kills and Ctrl-C cost nothing, that processes share the work."""

import json
import os
import signal
import time
from pathlib import Path

import pytest

from manicm_ms.policies.checkpoint import read_manifest

GRID = ("--envs", "toy/near,toy/far", "--methods", "simple_dp3,one_step,manicm", "--seeds", "0")
EVALUATED = (*GRID, "--evaluations", "5", "--evaluation-episodes", "2")


def finish(process):
    output, _ = process.communicate(timeout=600)
    return process.returncode, output


def results(out):
    return json.loads((out / "results.json").read_text())


def weights(out):
    """Checkpoint -> digest of its weights."""
    return {
        str(path.parent.relative_to(out)): read_manifest(path.parent)["files"]["model.safetensors"]["sha256"]
        for path in sorted(out.rglob("manifest.json"))
        if "snapshots" not in path.parts
    }


@pytest.fixture(scope="module")
def whole(tmp_path_factory, benchmark_here):
    """The grid run by two processes, uninterrupted."""
    out = tmp_path_factory.mktemp("bench") / "whole"
    code, output = benchmark_here(out, *EVALUATED, "--processes", 2)
    assert code == 0, output
    return out, output


def test_every_cell_is_there_with_its_episodes_and_evaluations(whole):
    out, output = whole
    found = results(out)
    assert {(c["env_id"], c["method"]) for c in found["cells"]} == {
        (e, m) for e in ("toy/near", "toy/far") for m in ("simple_dp3", "one_step", "manicm")
    }
    for cell in found["cells"]:
        assert cell["n"] == 4
        assert cell["successes"] == sum(sum(won) for won in cell["outcomes"].values())
        assert cell["success_once"] == cell["success_at_end"] == cell["outcomes"], "these tasks end at their success"
        assert cell["nfe"] == (10 if cell["method"] == "simple_dp3" else 1)
        assert cell["latency_ms"]["n"] > 0
        for evaluations in cell["evaluations"].values():
            assert [e["n"] for e in evaluations] == ([] if cell["method"] == "one_step" else [2] * 5)
    assert not found["missing"]
    assert {tuple(row["groups"]) for row in found["rows"]} == {("easy", "hard")}
    assert "mean of the five highest" in output
    assert "manicm minus simple_dp3" in output
    for name in ("report.md", "report.html"):
        assert "toy/near" in (out / name).read_text()


def test_the_same_seed_meets_every_method_and_no_demonstration(whole):
    out, _ = whole
    for cell in ("near", "far"):
        folder = out / "toy" / cell
        fresh = [
            [e["seed"] for e in json.loads(path.read_text())["episodes"]] for path in sorted(folder.rglob("judge.json"))
        ]
        assert len(fresh) == 3
        assert all(seeds == list(range(100_000, 100_004)) for seeds in fresh)
        assert json.loads((folder / "collect.json").read_text())["episodes"] == 3


def test_snapshots_are_removed_once_they_are_evaluated(whole):
    out, _ = whole
    assert not [p for p in out.rglob("snapshots/*") if p.is_dir()]


def test_the_same_command_again_does_nothing_twice(whole, benchmark_here):
    out, _ = whole
    before = {p: p.stat().st_mtime_ns for p in out.rglob("*.json") if p.name in ("train.json", "judge.json")}
    code, output = benchmark_here(out, *EVALUATED)
    assert code == 0, output
    assert {p: p.stat().st_mtime_ns for p in before} == before


def test_other_settings_in_the_same_folder_are_refused(whole, benchmark_here):
    out, _ = whole
    code, output = benchmark_here(out, *EVALUATED, "--demos", "4")
    assert code == 2
    assert "demos differ" in output
    assert "choose another --out" in " ".join(output.split())


def wait_for(condition, process, what):
    until = time.monotonic() + 600
    while not condition():
        assert process.poll() is None, f"ended before {what}: {process.stdout.read()}"
        assert time.monotonic() < until, f"no {what}"
        time.sleep(0.05)


def descendants(pid):
    """Every process that `pid` started, and they."""
    listed = [Path(f"/proc/{pid}/task/{task}/children") for task in os.listdir(f"/proc/{pid}/task")]
    children = [int(child) for path in listed if path.exists() for child in path.read_text().split()]
    return [*children, *(d for child in children for d in descendants(child))]


def gone(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def begun(out, pids):
    """Names of the jobs that the processes of some commands began, sorted; one begun twice comes twice."""
    logs = [path for pid in pids for path in (out / "logs").glob(f"{pid}-*")]
    lines = [line for path in logs for line in path.read_text().splitlines()]
    return sorted(line.removesuffix(": begun") for line in lines if line.endswith(": begun"))


def finished(out):
    """Names of the jobs whose result is there."""
    return {name for path in out.glob("toy/**/*.json") if (name := json.loads(path.read_text()).get("job"))}


def test_two_commands_share_the_work_and_go_on_after_both_are_stopped(whole, tmp_path, start_benchmark, benchmark_here):
    """Two begin at once; one is killed, the other gets Ctrl-C; two at once do the rest and end together."""
    out = tmp_path / "shared"
    pair = [start_benchmark(out, *EVALUATED, "--processes", count) for count in (1, 2)]
    for process in pair:
        wait_for(lambda: list(out.rglob("checkpoint.train/log.jsonl")), process, "training begun")
    children = [child for process in pair for child in descendants(process.pid)]
    assert all(len(descendants(process.pid)) >= 2 for process in pair)
    for process, stop in zip(pair, (signal.SIGKILL, signal.SIGINT), strict=True):
        process.send_signal(stop)
    for process in pair:
        finish(process)
    until = time.monotonic() + 60
    while not all(map(gone, children)):
        assert time.monotonic() < until, "workers of a run that was stopped must not live on"
        time.sleep(0.1)
    assert not (out / "results.json").exists()
    assert [path.read_text() for path in out.rglob("*.failed.json")] == [], "to be stopped is no failure"
    claims, done = begun(out, [process.pid for process in pair]), finished(out)
    assert len(claims) == len(set(claims)), "every job was begun by one of them alone"
    assert done <= set(claims)

    other = start_benchmark(out, *EVALUATED, "--processes", 1)
    for code, output in (benchmark_here(out, *EVALUATED, "--processes", 1), finish(other)):
        assert code == 0, output
    assert begun(out, [os.getpid(), other.pid]) == sorted(finished(whole[0]) - done), (
        "every other job was done by one of them alone"
    )
    assert finished(out) == finished(whole[0])
    assert len(finished(out)) == 12
    assert weights(out) == weights(whole[0]), "neither the stops nor the number of processes shows in the weights"
    assert [c["outcomes"] for c in results(out)["cells"]] == [c["outcomes"] for c in results(whole[0])["cells"]]


def test_a_task_that_fails_is_named_and_costs_the_others_nothing(tmp_path, benchmark_here):
    out = tmp_path / "broken"
    words = ("--envs", "toy/broken,toy/near", "--methods", "simple_dp3", "--seeds", "0", "--processes", "1")
    code, output = benchmark_here(out, *words)
    assert code == 1
    (missing,) = results(out)["missing"]
    assert missing["job"] == "toy/broken/seed0/simple_dp3/judge"
    assert "no device to render with" in missing["reason"]
    assert "no device to render with" in output
    near = next(c for c in results(out)["cells"] if c["env_id"] == "toy/near")
    assert near["n"] == 4
