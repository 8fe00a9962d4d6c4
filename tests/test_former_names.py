"""Modules that moved are found under their former names for one release, as the same modules, with a line of notice."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from manicm_ms.former_names import MOVED, present_name

REPO = Path(__file__).parents[1]


@pytest.mark.parametrize("former", sorted(MOVED))
def test_a_former_name_gives_the_present_module_and_says_so(former):
    present = importlib.import_module(f"manicm_ms.{MOVED[former]}")
    spec = present.__spec__
    sys.modules.pop(f"manicm_ms.{former}", None)
    with pytest.warns(FutureWarning, match=rf"manicm_ms\.{former} is manicm_ms\.{MOVED[former]} now"):
        found = importlib.import_module(f"manicm_ms.{former}")
    assert found is present
    assert present.__spec__ is spec
    assert present.__name__ == f"manicm_ms.{MOVED[former]}"


def test_a_module_of_a_moved_package_is_found_too():
    assert present_name("manicm_ms.calibration.board") == "manicm_ms.sensing.calibration.board"
    present = importlib.import_module("manicm_ms.sensing.calibration.board")
    sys.modules.pop("manicm_ms.calibration.board", None)
    with pytest.warns(FutureWarning, match="sensing"):
        assert importlib.import_module("manicm_ms.calibration.board") is present


def test_other_names_are_not_ours():
    assert present_name("types") is None
    assert present_name("manicm_ms.nothing") is None
    with pytest.raises(ModuleNotFoundError, match="nothing"):
        importlib.import_module("manicm_ms.nothing")


def test_no_module_has_a_former_name_and_all_present_ones_exist():
    for former, present in MOVED.items():
        for name, there in ((former, False), (present, True)):
            place = REPO / "manicm_ms" / Path(*name.split("."))
            assert (place.with_suffix(".py").is_file() or (place / "__init__.py").is_file()) == there, name


def test_nothing_of_ours_uses_a_former_name():
    """Neither the package nor its pages send anybody to them."""
    for path in (*REPO.glob("manicm_ms/**/*.py"), *REPO.glob("tasks/*.py"), *REPO.glob("scripts/**/*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not [name for name in names if present_name(name)], path


SHOWN = """
from manicm_ms import check_vec_env, make_vec
from manicm_ms.benchmark.plan import Plan, parse_envs
from manicm_ms.benchmark.run import benchmark
from manicm_ms.camera_model import depth_to_cloud, read_camera
from manicm_ms.demos.collect import collect, collect_episodes
from manicm_ms.demos.convert import convert
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.store import DemoStore
from manicm_ms.demos.waypoints import Motion, Waypoint, WaypointExpert, over
from manicm_ms.envs.maniskill import ManiSkillSimulator, register_env, workspace_of
from manicm_ms.envs.simulator import ENVS, EnvEntry, SimulatorConfig
from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.realism import Realism
from manicm_ms.robots.limits import quat_from_yaw
from manicm_ms.types import EnvSpec, ChunkSpec
"""
"""What the pages and the README of 0.1.0 showed."""


def test_what_the_pages_of_0_1_0_imported_still_works():
    command = [sys.executable, "-W", "default", "-c", SHOWN]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("FutureWarning") == 3  # camera_model, realism, types: one line each
