"""The GPU kit's families of methods: the same size, batch and steps for each, in the faster way, whatever fails."""

import os
import re
import sys
import zipfile
from argparse import Namespace
from concurrent.futures import BrokenExecutor
from pathlib import Path

import kit
import part_families
import part_training
import pytest
import report
import run
from kit_runs import arguments, lines_of, pack_store, stored_bytes
from test_other_observations import seen_store

from manicm_ms.policies.checkpoint import load_checkpoint


def test_a_checkpoint_of_each_family_may_come_back():
    assert len(part_families.COME_BACK) + len({"results.jsonl", "log.txt"}) <= kit.FILES_BACK
    for method in sorted({*part_families.COME_BACK} - {"manicm"}):  # which is its teacher's size
        assert 12_000_000 < stored_bytes(method) < kit.FILE_BACK_BYTES - 500_000


class InPlace(part_families.Processes):
    """Processes that are none: what they are told to run runs here."""

    def __init__(self, methods):
        self._executors = {}

    submit = staticmethod(part_families.here)


@pytest.fixture(scope="module")
def families(tmp_path_factory):
    """Those that go different ways, and one that does not exist."""
    tmp_path = tmp_path_factory.mktemp("families")
    words = arguments(tmp_path, "--budget", "280", "--device", "cpu", "--processes")
    pack_store(seen_store(tmp_path / "reach.zarr", ("voxel_grid",)), tmp_path / "load")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(part_families, "TASK", "test/reach")
        patch.setattr(part_families, "FAMILIES", ("no_such_method", "simple_dp3", "manicm", "voxel_dp"))
        patch.setattr(part_families, "Processes", InPlace)
        patch.setattr(part_training, "SNAPSHOTS", 0)
        patch.setattr(sys, "argv", ["part_families.py", *words])
        status = part_families.main()
    return tmp_path / "out", status


def test_families_are_trained_for_as_many_steps_each_and_all_but_voxels_come_back(families, tmp_path):
    out, status = families
    made = {line["method"]: line for line in lines_of(out) if line["name"] == "trained"}
    assert made.keys() == {"simple_dp3", "manicm", "voxel_dp"}
    assert {line["steps"] for line in made.values()} == {part_training.SMOKE_STEPS[1]}
    assert "archive" not in made["voxel_dp"]
    for method in ("simple_dp3", "manicm"):
        with zipfile.ZipFile(out / made[method]["archive"]) as archive:
            archive.extractall(tmp_path)
        assert load_checkpoint(tmp_path / f"test_reach_{method}").name == method
    (failed,) = [line for line in lines_of(out) if "failed" in line]
    assert failed["method"] == "no_such_method"
    assert status == 1


def test_the_faster_way_is_measured_and_taken(families):
    lines = lines_of(families[0])
    speeds = [line["steps_per_s"] for line in lines if line["name"] == "speed" and "failed" not in line]
    (way,) = [line for line in lines if line["name"] == "way"]
    rounds = way["steps_of_all_per_s"]
    assert rounds["one_after_another"] == pytest.approx(1 / sum(1 / speed for speed in speeds), rel=0.05)
    assert way["used"] == max(rounds, key=rounds.get)
    at_once = {line["at_once"] for line in lines if line["name"] == "trained"}
    assert at_once == {way["used"] == "at_once"}


def test_the_report_shows_families(families):
    rounds = {"one_after_another": 10.0, "at_once": 25.0}
    way = {"part": "families", "name": "way", "steps_of_all_per_s": rounds, "used": "at_once"}
    lines = [line for line in lines_of(families[0]) if line["name"] != "way"]
    page = report.report([*lines, way])
    assert "takes 100 ms one after another, 40 at once" in page
    assert re.search(r"\| voxel_dp \| 4 \|.*\| - \|\n", page)
    assert "| manicm | 4 |" in page
    assert "- families speed no_such_method: UnknownNameError" in page


def test_a_call_for_families_fits_beside_the_one_for_learning():
    assert run.LIMIT_S["learning"] + run.LIMIT_S["families"] < 15 * 60


def test_voxel_grids_are_learnt_from_with_the_same_unet_as_clouds(tmp_path):
    args = Namespace(smoke=False, device="cpu")
    changes = part_families.CHANGES["voxel_dp"]
    voxels = part_training.of_demonstrations("voxel_dp", tmp_path, args, changes).preset
    clouds = part_training.of_demonstrations("simple_dp3", tmp_path, args).preset
    backbone = {"name": "unet1d", "down_dims": (128, 256, 384), "resnets_per_stage": 1, "mid_blocks": 1}
    assert voxels.configuration("voxel_dp")["backbone"] == clouds.configuration("simple_dp3")["backbone"]
    assert backbone.items() <= voxels.configuration("voxel_dp")["backbone"].items()
    assert (voxels.batch_size, voxels.size) == (clouds.batch_size, clouds.size) == (128, "paper")


def test_a_student_waits_for_its_teacher_and_gets_its_checkpoint():
    methods = ("manicm", "drift", "simple_dp3")
    begun = []

    def start(method, teacher):
        begun.append((method, teacher))
        return part_families.here(method, lambda: (Path(method), None))

    done = [method for method, _ in part_families.results_in_turn(methods, 2, start)]
    assert sorted(done) == sorted(methods)
    assert begun == [("drift", None), ("simple_dp3", None), ("manicm", Path("simple_dp3"))]


def test_a_process_that_dies_costs_its_own_method_alone(monkeypatch):
    monkeypatch.setattr(part_families, "awake", os.getpid)  # needs no torch
    processes = part_families.Processes(("drift", "meanflow"))
    try:
        pids = [processes.submit(method, os.getpid).result() for method in ("drift", "drift", "meanflow")]
        assert pids[0] == pids[1] != pids[2] != os.getpid()
        with pytest.raises(BrokenExecutor):
            processes.submit("drift", os._exit, 1).result(60)
        assert processes.submit("meanflow", os.getpid).result() == pids[2]
    finally:
        processes.close()
