"""The guide on adding a task: its code blocks are a file that works outside the repository, check to evaluation."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from manicm_ms.errors import ConfigError
from manicm_ms.registry import outside_folders

GUIDE = Path(__file__).parents[1] / "docs" / "guides" / "add_a_task.md"

# One process for all commands: importing the simulator takes longer than most of them. Of the conformance checks, which
# `manicm-ms check` runs, some that need few environments.
SCRIPT = """
import sys
from manicm_ms.cli import main
from manicm_ms.envs.conformance import _Checks

def run(*words):
    try:
        main(list(words))
    except SystemExit as end:
        assert end.code in (0, None), (words, end.code)

env = "ur3e/push-cube"
checks = _Checks(env, "cpu")
for promise in ("plays", "same_seed_same_episode", "partial_reset_leaves_others"):
    getattr(checks, promise)()
run("list", "envs", "--tag", "ur3e")
run("collect", env, "--episodes", "3", "--out", "demos.zarr", "--num-envs", "1", "--backend", "cpu")
tiny = "--steps 6 --warmup-steps 2 --batch-size 4 --down-dims 8 16 --points 8 --save-every 50 --log-every 1"
run("train", "simple_dp3", "--data", "demos.zarr", "--out", "teacher", "--device", "cpu", *tiny.split())
run("evaluate", "teacher", "--env", env, "--episodes", "2", "--out", "report", "--num-envs", "1", "--videos", "0",
    "--no-control", "--backend", "cpu")
"""


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", GUIDE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def task_folder(tmp_path_factory):
    """A folder outside the repository that holds the task as the guide gives it."""
    folder = tmp_path_factory.mktemp("my_tasks")
    (folder / "push_cube.py").write_text("".join(blocks("python")), encoding="utf-8")
    (folder / "half_done.py").write_text("import no_such_module\n", encoding="utf-8")  # its neighbours do not mind
    return folder


def test_the_blocks_are_a_clean_file(task_folder):
    root = GUIDE.parents[2]
    done = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--config", root / "pyproject.toml", "--ignore", "E302,E305,I001",
         task_folder / "push_cube.py"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_task_outside_the_repository_goes_from_check_to_evaluation(task_folder, tmp_path):
    environment = os.environ | {"MANICM_MS_TASKS": str(task_folder), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "ur3e/push-cube" in done.stdout
    assert done.stderr.count("half_done.py, line 1: ModuleNotFoundError: No module named 'no_such_module'") == 1
    assert "3 episodes from 3 attempts" in " ".join(done.stdout.split()), done.stdout
    results = json.loads((tmp_path / "report" / "results.json").read_text())
    assert results["env_id"] == "ur3e/push-cube"
    (policy,) = results["policies"]
    assert (policy["n"], policy["crashed"]) == (2, 0)


def test_the_guide_names_only_commands_that_exist():
    from manicm_ms.cli import PLAIN, WITH_PRESET

    named = re.findall(r"^manicm-ms (\S+)", "\n".join(blocks("console")), re.MULTILINE)
    assert {"check", "collect", "train", "evaluate"} <= set(named)
    assert set(named) <= {*PLAIN, *WITH_PRESET}


def test_no_folder_is_named_where_the_variable_is_unset(monkeypatch):
    monkeypatch.delenv("SOME_TASKS", raising=False)
    assert outside_folders("SOME_TASKS", []) == []
    monkeypatch.setenv("SOME_TASKS", "")
    assert outside_folders("SOME_TASKS", []) == []


def test_several_folders(monkeypatch, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("SOME_TASKS", os.pathsep.join([str(tmp_path / "a"), str(tmp_path / "b")]))
    assert outside_folders("SOME_TASKS", []) == [str(tmp_path / "a"), str(tmp_path / "b")]


def test_a_missing_folder_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("SOME_TASKS", str(tmp_path / "gone"))
    with pytest.raises(ConfigError, match=r"SOME_TASKS names .*gone, which is no folder"):
        outside_folders("SOME_TASKS", [])


def test_a_name_that_is_taken_is_refused(monkeypatch, tmp_path):
    """Else the file would silently never be imported."""
    shipped = tmp_path / "shipped"
    shipped.mkdir()
    (shipped / "slide_block.py").touch()
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "slide_block.py").touch()
    monkeypatch.setenv("SOME_TASKS", str(mine))
    with pytest.raises(ConfigError, match=r"mine holds slide_block\.py, and so does .*shipped"):
        outside_folders("SOME_TASKS", [str(shipped)])
