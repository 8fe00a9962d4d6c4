"""The GPU kit fits what travels and the time it is given, survives failing parts, and every part runs on a CPU."""

import re
import subprocess
import sys
import tarfile
import time
import zipfile
from pathlib import Path

import kit
import part_latency
import part_simulation
import part_training
import prepare
import pytest
import report
import run
import torch
from kit_runs import arguments, lines_of, pack_store, stored_bytes
from reach_demos import make_store

from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest, save_checkpoint
from manicm_ms.policies.methods import make_policy
from manicm_ms.training.interrupt import stop_requests
from manicm_ms.training.presets import TEACHER_PRESETS
from manicm_ms.training.run_folder import snapshot_folder


def page_sizes(load):
    """Return path -> bytes and the sum as docs/gpu_kit.md has them."""
    text = prepare.PAGE.read_text(encoding="utf-8")
    block = text.split(f"<!-- {load}: begin -->")[1].split(f"<!-- {load}: end -->")[0]
    found = {path: int(size) for path, size in re.findall(r"^\| (\S.*?) \| (\d+) \|$", block, re.MULTILINE)}
    return found, int(re.search(r"\*\*together\*\* \| \*\*(\d+)\*\*", block)[1])


# ---- limits -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("load", prepare.LOADS)
def test_what_the_page_lists_fits_beside_the_tree(load):
    sizes, together = page_sizes(load)
    assert sum(sizes.values()) == together <= kit.TRAVELS_BYTES
    tree = [size for path, size in sizes.items() if path.startswith("the tree")]
    assert tree == [kit.TREE_BYTES]


def test_the_tree_keeps_to_what_is_set_aside_for_it():
    try:
        tracked = kit.tracked_bytes()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    assert 1_000_000 < tracked <= kit.TREE_BYTES


@pytest.mark.parametrize("load", prepare.LOADS)
def test_the_page_lists_what_is_gathered_in_the_pinned_versions(load):
    asked = prepare.LOADS[load]
    wheels = {
        prepare.pinned(name).lower().replace("-", "_").replace("==", "-") for name in (*asked.wheels, *asked.stripped)
    }
    listed = [Path(path).name for path in page_sizes(load)[0]]
    assert wheels == {"-".join(n.split("-")[:2]).lower() for n in listed if n.endswith(".whl")}
    assert set(asked.debs) == {name.split("_")[0] for name in listed if name.endswith(".deb")}
    assert {f"{env_id}.zip" for env_id in asked.stores} == {
        path.split("/stores/")[1] for path in page_sizes(load)[0] if path.endswith(".zip")
    }


def test_the_parts_of_a_call_end_within_its_limit():
    for load, parts in run.LOADS.items():
        assert run.UNPACKING_S + sum(part.seconds for part in parts) <= run.LIMIT_S[load] < kit.COMMAND_S
    assert run.LIMIT_S == {"learning": 480, "simulation": 240, "families": 300}
    assert 2 * sum(part_training.SECONDS.values()) == 240
    training = next(part.seconds for part in run.LOADS["learning"] if part.name == "training")
    assert training > 240 + 4 * part_training.OVERHEAD_S


def test_four_checkpoints_of_the_preset_may_come_back():
    names = {part_training.archive_name(task, kind) for task in part_training.TASKS for kind in part_training.SECONDS}
    assert len(names) + len({"results.jsonl", "log.txt"}) <= kit.FILES_BACK
    assert 14_000_000 < stored_bytes(part_training.POLICY) < kit.FILE_BACK_BYTES - 500_000


def test_an_archive_too_large_to_come_back_is_refused(tmp_path, monkeypatch):
    policy = make_policy("simple_dp3", part_latency.door_spec(), part_latency.CHUNK, part_latency.TINY, seed=0)
    save_checkpoint(policy, tmp_path / "whole", {})
    monkeypatch.setattr(part_training, "FILE_BACK_BYTES", 100_000)
    with pytest.raises(ValueError, match="100000 may come back"):
        part_training.pack(tmp_path / "whole", tmp_path / "half.zip", tmp_path)
    assert not (tmp_path / "half.zip").exists()


# ---- the runner ---------------------------------------------------------------------------------------------------

PARTS = {
    "hangs.py": """
import subprocess, sys, time
out = sys.argv[sys.argv.index('--out') + 1]
open(out + '/child', 'w').write(str(subprocess.Popen(['sleep', '60']).pid))
time.sleep(60)
""",
    "fails.py": "raise SystemExit('no such device')",
    "works.py": """
import sys, manicm_ms.tasks
from manicm_ms.paths import asset
out = sys.argv[sys.argv.index('--out') + 1]
open(out + '/paths', 'w').write('\\n'.join([manicm_ms.tasks.__file__, str(asset('robots', 'ur3e_ag95'))]))
""",
}


def test_a_part_that_hangs_or_fails_is_a_line_and_the_next_goes_on(tmp_path, monkeypatch):
    for name, source in PARTS.items():
        (tmp_path / name).write_text(source)
    wheels = tmp_path / "load" / "wheels"
    wheels.mkdir(parents=True)
    with zipfile.ZipFile(wheels / "carried-1.0-py3-none-any.whl", "w") as wheel:
        wheel.writestr("carried/__init__.py", "")
    parts = tuple(
        run.Part(name, (f"{name}.py",), 4.0 if name == "hangs" else 60.0) for name in ("hangs", "fails", "works")
    )
    monkeypatch.setattr(run, "LOADS", {"learning": parts})
    monkeypatch.setattr(run, "HERE", tmp_path)
    words = ["run.py", "learning", *(f"--{n}={tmp_path / n}" for n in ("load", "out", "work"))]
    monkeypatch.setattr(sys, "argv", words)
    assert run.main() == 1
    told = {line["name"]: line for line in lines_of(tmp_path / "out")}
    assert told["hangs"]["failed"] == "ended after 4 s"
    assert told["hangs"]["status"] is None
    state = Path("/proc") / (tmp_path / "out" / "child").read_text() / "stat"
    assert not state.exists() or state.read_text().split()[2] == "Z", "what the part started goes on"
    assert told["fails"]["failed"] == "no such device"
    assert told["works"]["status"] == 0
    site = tmp_path / "work" / "site"
    paths = (tmp_path / "out" / "paths").read_text().splitlines()
    assert paths == [
        str(site / "manicm_ms" / "tasks" / "__init__.py"),
        str(site / "manicm_ms" / "assets/robots/ur3e_ag95"),
    ]
    assert (site / "carried" / "__init__.py").is_file()


def test_a_cut_off_last_line_does_not_spoil_the_others(tmp_path):
    results = kit.Results(tmp_path / "results.jsonl")
    results.write("latency", median_ms=1.0)
    with results.path.open("a") as file:
        file.write('{"part": "lat')
    assert kit.Results.read(results.path) == [{"part": "latency", "median_ms": 1.0}]


# ---- the parts ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def latency_lines(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("latency")
    with pytest.MonkeyPatch.context() as patch:
        for mode in part_latency.MODES:
            patch.setattr(sys, "argv", ["part_latency.py", *arguments(tmp_path, "--budget", "60", "--mode", mode)])
            part_latency.main()
    return lines_of(tmp_path / "out")


def test_the_latency_table_has_every_row_and_its_action_is_the_references(latency_lines):
    rows = [line for line in latency_lines if "median_ms" in line]
    keys = {(r["model"], r["nfe"], r["dtype"], r["batch"], r["mode"]) for r in rows}
    assert len(keys) == len(rows) == 2 * 3 * 2 * 2 * 2
    assert all(row["error"] < 1e-5 for row in rows if row["dtype"] == "float32")
    assert all(1e-5 < row["error"] < 0.1 for row in rows if row["dtype"] == "bfloat16")
    assert all(line["bandwidth_gb_s"] > 0 for line in latency_lines if "median_ms" not in line)


def test_the_floor_is_the_weights_that_a_decision_reads(latency_lines):
    one, ten = (
        next(r for r in latency_lines if r.get("nfe") == nfe and r["dtype"] == "float32" and r["model"] == "DP3")
        for nfe in (1, 10)
    )
    policy = part_latency.policies(torch.device("cpu"), smoke=True)["DP3", "float32", 1]
    unet = sum(p.numel() for p in policy.head.backbone.parameters()) * 4 / 1e6
    assert ten["weights_mb"] - one["weights_mb"] == pytest.approx(9 * unet, abs=0.02)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("training")
    words = arguments(tmp_path, "--budget", "280", "--device", "cpu")
    pack_store(make_store(tmp_path / "reach.zarr"), tmp_path / "load")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(part_training, "TASKS", ("test/missing", "test/reach"))
        patch.setattr(sys, "argv", ["part_training.py", *words])
        status = part_training.main()
    return tmp_path / "out", status


def test_teacher_and_student_come_back_in_half_precision(trained, tmp_path):
    out, _ = trained
    made = {line["kind"]: line for line in lines_of(out) if line["task"] == "test/reach"}
    for kind, policy in (("teacher", "simple_dp3"), ("student", "manicm")):
        line = made[kind]
        assert line["bytes"] == (out / line["archive"]).stat().st_size
        with zipfile.ZipFile(out / line["archive"]) as archive:
            archive.extractall(tmp_path)
        folder = tmp_path / f"test_reach_{kind}"
        assert load_checkpoint(folder).name == policy
        assert read_manifest(folder)["weights_dtype"] == "float16"
        assert line["steps"] == line["planned_steps"] == part_training.SMOKE_STEPS[1] < line["preset_steps"]


def test_a_task_without_demonstrations_costs_the_others_nothing(trained):
    out, status = trained
    missing = [line for line in lines_of(out) if line["task"] == "test/missing"]
    assert status == 1
    assert [line["kind"] for line in missing] == ["teacher", "student"]
    assert "missing.zip" in missing[0]["failed"]
    assert "no teacher" in missing[1]["failed"]


def test_a_training_that_is_late_is_ended_and_its_last_snapshot_comes_back(tmp_path):
    out = tmp_path / "teacher"
    for step in (10, 20):
        snapshot_folder(out, step).mkdir(parents=True)

    def endless():
        with stop_requests() as stop:
            while not stop.asked:
                time.sleep(0.01)
        raise KeyboardInterrupt

    assert part_training.train_until(endless, out, 0.1) == snapshot_folder(out, 20)
    with pytest.raises(TimeoutError, match="not one of"):
        part_training.train_until(endless, tmp_path / "other", 0.1)


def test_the_speed_of_steps_leaves_out_what_every_training_has(tmp_path, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(part_training.time, "perf_counter", lambda: clock[0])

    def rate(seconds_a_step):
        def train(preset, out):
            clock[0] += 0.5 + seconds_a_step * preset.steps
            return out

        return part_training.steps_per_second(train, TEACHER_PRESETS.get("paper"), tmp_path, (20, 220))

    assert rate(0.01) == pytest.approx(100)
    assert rate(0.0) == pytest.approx(
        part_training.MOST_ABOVE_WHOLE * 220 / 0.5
    )  # no plan is made of a lucky difference


def test_what_is_left_of_the_time_is_shared_as_it_was_planned():
    plan = ["teacher", "student"] * 2
    assert part_training.share_s("teacher", kit.Budget(1000), plan) == 80
    late = part_training.share_s("teacher", kit.Budget(64), plan)
    assert late == pytest.approx((64 - 4 * part_training.OVERHEAD_S) / 3, abs=0.1)


def test_a_driver_without_a_picture_in_time_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(part_simulation, "SOFTWARE_PROBE_S", 0.05)
    monkeypatch.setattr(part_simulation, "nvidia_driver", lambda: None)
    monkeypatch.setattr(sys, "argv", ["part_simulation.py", *arguments(tmp_path, "--budget", "60")])
    assert part_simulation.main() == 1
    (line,) = lines_of(tmp_path / "out")
    assert line["failed"] == "no picture within 0 s"


def test_the_gpus_own_driver_is_tried_first_and_a_carried_one_alone(tmp_path, monkeypatch):
    load, work = tmp_path / "load", tmp_path / "work"
    load.mkdir()
    monkeypatch.setattr(part_simulation, "nvidia_driver", lambda: Path("/icd/nvidia_icd.json"))
    tried = part_simulation.candidates(load, work)
    assert next(iter(tried)) == part_simulation.NVIDIA
    assert tried[part_simulation.NVIDIA]["VK_DRIVER_FILES"] == "/icd/nvidia_icd.json"
    (tmp_path / "vulkan.json").write_text("{}")
    with tarfile.open(load / "software.tar.xz", "w:xz") as archive:
        archive.add(tmp_path / "vulkan.json", "vulkan.json")
    (only,) = part_simulation.candidates(load, work).values()
    assert (Path(only["MANICM_MS_VULKAN"]) / "vulkan.json").is_file()


def test_control_steps_are_counted():
    counted = part_simulation.rate(part_simulation.TASKS[0], 1, part_simulation.SMOKE_STEPS, 1)
    assert 0 < counted["steps_per_s"] == counted["best"]


# ---- before and after ---------------------------------------------------------------------------------------------


def test_a_wheel_is_written_again_without_what_no_part_reads(tmp_path):
    with zipfile.ZipFile(tmp_path / "whole.whl", "w") as wheel:
        for name in ("mani_skill/a.py", "mani_skill/assets/info.json", "mani_skill/assets/robot.glb"):
            wheel.writestr(name, name)
    prepare.strip(tmp_path / "whole.whl", tmp_path / "less.whl", prepare.LOADS["simulation"].stripped["mani_skill"])
    with zipfile.ZipFile(tmp_path / "less.whl") as wheel:
        assert wheel.namelist() == ["mani_skill/a.py", "mani_skill/assets/info.json"]
        assert wheel.read("mani_skill/a.py") == b"mani_skill/a.py"


def test_too_much_is_refused(tmp_path, monkeypatch, capsys):
    folder = tmp_path / ".gpu_kit" / "software"
    folder.mkdir(parents=True)
    (folder / "software.tar.xz").write_bytes(b"0" * 1000)
    monkeypatch.setattr(prepare, "REPO", tmp_path)
    monkeypatch.setattr(prepare, "KIT", tmp_path / ".gpu_kit")
    monkeypatch.setattr(prepare, "tracked_bytes", lambda: kit.TRAVELS_BYTES - 999)
    monkeypatch.setattr(sys, "argv", ["prepare.py", "software"])
    assert prepare.main() == 1
    told = capsys.readouterr()
    assert "| .gpu_kit/software/software.tar.xz | 1000 |" in told.out
    assert "too much" in told.err


def test_the_report_shows_results_and_failures(latency_lines, trained):
    simulated = [
        {"part": "simulation", "name": "driver", "driver": "NVIDIA", "device": "NVIDIA H", "gpu": True},
        {"part": "simulation", "name": "rate", "workers": 4, "steps_per_s": 900.0, "best": 950.0, "device": "NVIDIA H"},
        {"part": "simulation", "name": "check", "task": "ur3e/slide-block", "passed": 16, "broken": ["FAIL x"]},
    ]
    page = report.report([*latency_lines, *lines_of(trained[0]), *simulated])
    assert page.count("| DP3 |") == 24
    assert "| test/reach | teacher | 4 |" in page
    assert "| 4 | 900.0 | 950.0 | NVIDIA H |" in page
    assert "FAIL x" in page
    assert re.search(r"- training test/missing teacher: .*missing\.zip", page)
