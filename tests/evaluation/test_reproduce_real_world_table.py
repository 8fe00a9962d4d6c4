"""The script that plays the paper's real-world table: one episode for real, the page, and what it refuses."""

import importlib.util
import json
import shutil
import sys
from pathlib import Path

import pytest

from manicm_ms.errors import CheckpointError, ConfigError, UnknownNameError

REPO = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script():
    path = REPO / "scripts" / "reproduce_real_world_table.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def played(script, tmp_path_factory):
    """What one episode of Slide Block with the shipped pair, and a second one of the student, left behind."""
    out = tmp_path_factory.mktemp("real_world")
    script.main(tasks=("slide_block",), episodes=1, student_episodes=2, out=out)
    return json.loads((out / "real_world.json").read_text())


def test_pair_and_control_are_played_on_held_out_seeds_under_every_preset(script, played):
    results = played["tasks"]["slide_block"]
    assert results["seeds"] == [200_000, 200_000]
    assert [(p["role"], p["nfe"], p["n"], p["crashed"]) for p in results["policies"]] == [
        ("teacher", 10, 1, 0),
        ("control", 1, 1, 0),
        ("student", 1, 1, 0),
    ]
    assert all(policy["latency_ms"]["median"] > 0 for policy in results["policies"])
    rows = results["realism"]["rows"]
    assert [(row["preset"], row["role"]) for row in rows] == [
        (preset, role) for preset in ("clean", "d435i", "d435i+dr") for role in ("teacher", "control", "student")
    ]
    assert all(len(row["failed_seeds"]) == row["n"] - row["successes"] for row in rows)
    assert [row["n"] for row in rows] == [1, 1, 2] * 3
    assert all(set(row["failed_seeds"]) <= set(range(200_000, 200_000 + row["n"])) for row in rows)
    lines = script.table(played).splitlines()
    assert len(lines) == 5
    assert all(line.count("|") == lines[0].count("|") for line in lines)
    assert "| Slide Block | DP3 (teacher) | 10 | 90 % | 177.2 ms | " in lines[2]
    assert "| Slide Block | DP3 in one step (control) | 1 | - | - | " in lines[3]
    assert "| Slide Block | ManiCM (student) | 1 | 80 % | 16.9 ms | " in lines[4]


def test_the_page_shows_all_tasks_and_what_differs(script, played):
    data = played | {"tasks": dict.fromkeys(script.TASKS, played["tasks"]["slide_block"])}
    page = script.page(data)
    for task in script.TASKS.values():
        assert page.count(f"| {task.title} |") == 6  # three methods, and the differences under three presets
        assert f"- {task.title}: the student decides" in page
    assert "2.98 M parameters" in page
    assert "simulation" in page
    assert "44 to\n  97 %" in page  # Clopper and Pearson's interval of 8 in 10
    assert "Clopper-Pearson" in page
    assert "Tango" in page


def row(preset, role, failed, n=10):
    """A row of the realism table as the script keeps it."""
    rate = (n - len(failed)) / n
    return {"preset": preset, "role": role, "n": n, "success_rate": rate, "failed_seeds": failed}


def test_differences_pair_the_seeds_and_name_the_lowest_student(script):
    teacher, control = [1, 2], [1, 2, 3, 4, 5, 6, 7]
    by_preset = {"clean": [], "d435i": [2], "d435i+dr": [2, 8]}
    rows = [
        row(preset, role, failed)
        for preset, students in by_preset.items()
        for role, failed in (("teacher", teacher), ("control", control), ("student", students))
    ]
    medians = {"teacher": 20.0, "control": 2.0, "student": 2.0}
    policies = [{"role": role, "latency_ms": {"median": value}} for role, value in medians.items()]
    data = {"tasks": {"stack_cube": {"realism": {"rows": rows}, "policies": policies, "seeds": [1, 10]}}}
    lines = script.differences(data).splitlines()
    assert lines[2].startswith("| Stack Cube | clean | +20.0 (")
    assert lines[4].startswith("| Stack Cube | d435i+dr | +0.0 (")  # one each: 1 lost by the teacher, 8 by the student
    assert "p = 1)" in lines[4]
    assert "| +70.0 (" in lines[2]
    assert "p = 0.016)" in lines[2]  # 2 * 0.5^7: seven seeds that only the student solved
    said = script.sentences(data)
    assert "lowest success rate of a student is 80.0 %: Stack Cube under `d435i+dr`" in said
    assert "decides 10.0 times as fast" in said


def test_a_missing_pair_is_named_before_anything_is_played(script, tmp_path):
    shutil.copytree(REPO / "checkpoints" / "slide_block", tmp_path / "shipped" / "slide_block")
    with pytest.raises(CheckpointError, match=r"stack_cube/teacher and .*stack_cube/student.* are there: slide_block"):
        script.main(tasks=("slide_block", "stack_cube"), checkpoints=tmp_path / "shipped", out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_unknown_tasks_and_a_page_without_all_tasks_are_refused(script, tmp_path):
    with pytest.raises(UnknownNameError, match="did you mean 'slide_block'"):
        script.main(tasks=("slide_blok",), out=tmp_path)
    with pytest.raises(ConfigError, match="want every task"):
        script.main(tasks=("slide_block",), write=True, out=tmp_path)
