"""The script that plays the paper's real-world table: two episodes for real, the page, and what it refuses."""

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
    """What two episodes of Slide Block with the shipped pair left behind."""
    out = tmp_path_factory.mktemp("real_world")
    script.main(tasks=("slide_block",), episodes=2, out=out)
    return json.loads((out / "real_world.json").read_text())


def test_the_shipped_pair_is_played_on_fresh_seeds(script, played):
    results = played["tasks"]["slide_block"]
    assert results["seeds"] == [200_000, 200_001]
    assert [(p["role"], p["nfe"], p["n"], p["crashed"]) for p in results["policies"]] == [
        ("teacher", 10, 2, 0),
        ("student", 1, 2, 0),
    ]
    assert all(policy["latency_ms"]["median"] > 0 for policy in results["policies"])
    lines = script.table(played).splitlines()
    assert len(lines) == 4
    assert "| Slide Block | DP3 (teacher) | 90 % | 177.2 ms | " in lines[2]
    assert "| Slide Block | ManiCM (student) | 80 % | 16.9 ms | " in lines[3]


def test_the_page_shows_all_tasks_and_what_differs(script, played):
    data = played | {"tasks": dict.fromkeys(script.TASKS, played["tasks"]["slide_block"])}
    page = script.page(data)
    for task in script.TASKS.values():
        assert page.count(f"| {task.title} |") == 2
        assert f"- {task.title}: student minus teacher" in page
    assert "2.98 M parameters" in page
    assert "simulation" in page
    assert "44 to\n  97 %" in page  # Clopper and Pearson's interval of 8 in 10
    assert "Clopper-Pearson" in page
    assert "Tango" in page


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
