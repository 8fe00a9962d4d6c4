"""`manicm-ms bench overfit` on a small store: what it prints and writes, and what it refuses."""

import json
import sys
from pathlib import Path

import pytest

from manicm_ms.bench.overfit import extras_of, teacher_of
from manicm_ms.cli import main
from manicm_ms.errors import ConfigError
from manicm_ms.policies.methods import METHODS, Method
from manicm_ms.spec import ChunkSpec

sys.path.insert(0, str(Path(__file__).parents[1] / "training"))

from reach_demos import make_store


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """Run it at the size smoke; return its status, what it wrote and the folder."""
    folder = tmp_path_factory.mktemp("overfit")
    data = make_store(folder / "reach.zarr", episodes=2)

    def run(method, *words):
        with pytest.raises(SystemExit) as end:
            main(["bench", "overfit", method, "--size", "smoke", "--data", str(data), "--folder", str(folder), *words])
        path = folder / f"{method}-smoke.json"
        return end.value.code, json.loads(path.read_text()) if path.exists() else None, folder

    return run


@pytest.mark.parametrize(("method", "teacher"), [("bc_gmm_3d", None), ("manicm", "simple_dp3")])
def test_it_tells_what_a_method_costs_and_leaves_no_checkpoint(told, capsys, method, teacher):
    status, found, folder = told(method, "--steps", "3", *([] if teacher is None else ["--teacher", teacher]))
    assert status == 0
    assert (found["steps"], found["teacher"], found["equal_actions"], found["action_error"]) == (3, teacher, True, 0.0)
    assert sum(n for part, n in found["parameters"].items() if part != "total") == found["parameters"]["total"]
    assert found["seconds_per_step"] > 0 < found["peak_memory_mb"]
    assert found["loss_first"] != found["loss_last"]
    printed = capsys.readouterr().out
    assert f"| parameters | {found['parameters']['total']:,} (" in printed
    assert "| saved and loaded | equal actions |" in printed
    assert not [path for path in folder.iterdir() if path.name.startswith("tmp")]


def test_a_student_is_distilled_from_what_has_its_network():
    chosen = METHODS.get(teacher_of("manicm", "paper")).configuration()
    student = METHODS.get("manicm").configuration()
    assert chosen["backbone"] == student["backbone"]
    assert teacher_of("manicm", "paper", "pocket_dp3") == "pocket_dp3"


def test_a_student_without_such_a_teacher_is_refused():
    row = Method(
        sentence="", reference="", encoder={"name": "dp3", "point_features": 7}, backbone="mixer", head="consistency",
        objective="consistency", nfe=1, chunk=ChunkSpec(2, 4, 3),
    )  # fmt: skip
    METHODS.add("lonely", row)
    try:
        with pytest.raises(ConfigError, match="no teacher has the encoder and the backbone of lonely: name one by"):
            teacher_of("lonely", "paper")
    finally:
        METHODS._remove("lonely")


def test_what_reads_clouds_needs_nothing_else_of_a_store():
    assert extras_of("simple_dp3") == ()


def test_unknown_names_are_refused_before_anything_is_made(told, capsys, tmp_path):
    for words in (
        ["nonsense"],
        ["manicm", "--teacher", "bc_gmm_3d"],
        ["dp3", "--size", "huge"],
        ["dp3", "--teacher", "simple_dp3"],
        ["dp3", "--data", str(tmp_path / "no.zarr")],
    ):
        with pytest.raises(SystemExit) as end:
            main(["bench", "overfit", *words, "--folder", str(tmp_path / "x")])
        assert end.value.code == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "x").exists()
