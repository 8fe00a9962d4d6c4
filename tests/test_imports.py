"""The layer rule: who may import whom, read from the source, and what an import really loads."""

import ast
import json
import os
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[1]
FOLDERS = {"manicm_ms": REPO / "manicm_ms", "manicm_ms.tasks": REPO / "tasks", "manicm_ms.assets": REPO / "assets"}
SIMULATORS = {"sapien", "mani_skill", "mujoco", "metaworld", "mplib"}
BASE = {"spec", "errors", "registry", "paths", "provenance", "seeds", "wording", "progress", "signals"}

# layer -> the parts of manicm_ms that it may import beside itself and the base
ALLOWED = {
    **{name: set() for name in BASE},
    "__init__": {"envs", "former_names", "gym_ids"},  # envs lazily: make_vec and check_vec_env
    "former_names": set(),
    "gym_ids": set(),
    "assets": set(),
    "machine": set(),
    "sensing": set(),
    "robots": {"machine"},
    "envs": {"gym_ids", "robots", "machine", "sensing"},
    "tasks": {"envs", "robots", "demos", "machine", "sensing"},
    "demos": {"envs", "sensing"},
    "policies": set(),
    "training": {"demos", "policies", "machine"},
    "evaluation": {"envs", "policies", "machine", "sensing"},
    "reports": {"policies", "training", "evaluation"},
    "bench": {"envs", "robots", "demos", "policies", "training", "evaluation", "machine", "sensing"},
    "benchmark": {"envs", "demos", "policies", "training", "evaluation", "machine"},
}
MAY_SIMULATE = {"robots", "envs", "tasks", "machine", "bench"}
UNBOUND = {"cli"}  # the command line: may import everything, nobody imports it

# module -> the layers that it names in text, for an import when somebody asks for it, beside those that it may import
NAMED = {
    "manicm_ms": {"cli"},  # the program whose signals are answered from the start
    "manicm_ms.gym_ids": {"envs", "tasks"},  # Gymnasium's entry points
    "manicm_ms.machine.mujoco_gl": {"envs"},  # a module that is run in a process of its own
    "manicm_ms.paths": {"assets"},  # a folder of files
    "manicm_ms.registry": {"tasks"},  # found at the first look-up, as users' tasks are
}


def modules() -> dict[str, Path]:
    """Dotted name -> file of every module of the tree, as it is named when installed."""
    found = {}
    for package, folder in FOLDERS.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            found[".".join([package, *parts]).removesuffix(".__init__")] = path
    return found


MODULES = modules()


def layer(name: str) -> str:
    parts = name.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def imports(name: str) -> set[str]:
    """Every dotted name that a module imports anywhere, `from a import b` as a.b where that is a module."""
    path = MODULES[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            base = ".".join([*above, *([node.module] if node.module else [])])
            found |= {f"{base}.{alias.name}" if f"{base}.{alias.name}" in MODULES else base for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("importlib.import_module", "import_module"):
            found |= {arg.value for arg in node.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str)}
    return found


def named(name: str) -> set[str]:
    """Every module of ours that a module names in a text of its own, alone or as an entry point `module:attribute`."""
    texts = (node.value for node in ast.walk(ast.parse(MODULES[name].read_text(encoding="utf-8")))
             if isinstance(node, ast.Constant) and isinstance(node.value, str))  # fmt: skip
    return {text.partition(":")[0] for text in texts} & (MODULES.keys() - {"manicm_ms"})


def test_every_part_of_the_package_has_a_rule():
    assert {layer(name) for name in MODULES} <= set(ALLOWED) | UNBOUND


@pytest.mark.parametrize("name", sorted(MODULES))
def test_a_module_imports_only_what_its_layer_may(name):
    ours = layer(name)
    if ours in UNBOUND:
        return
    theirs = {layer(other) for other in imports(name) if other.split(".")[0] == "manicm_ms" and other != "manicm_ms"}
    assert theirs <= ALLOWED[ours] | {ours} | BASE


def test_no_layer_leads_back_to_itself():
    """A circle of layers is one layer in disguise: none of them can be understood, tested or moved alone."""
    TopologicalSorter(ALLOWED).prepare()  # raises CycleError, which names the circle


@pytest.mark.parametrize("name", sorted(MODULES))
def test_a_module_names_only_what_its_layer_may_import(name):
    """A name in text is an import that comes later: by importlib, by Gymnasium, by a registry."""
    ours = layer(name)
    if ours in UNBOUND:
        return
    theirs = {layer(other) for other in named(name)} - ALLOWED[ours] - {ours} - BASE
    assert theirs == NAMED.get(name, set())


@pytest.mark.parametrize("name", sorted(MODULES))
def test_only_the_simulation_layers_import_a_simulator(name):
    loaded = {other.split(".")[0] for other in imports(name)} & SIMULATORS
    assert not loaded or layer(name) in MAY_SIMULATE | UNBOUND
    assert "mplib" not in loaded  # it crashes the process under numpy 2


def test_the_reader_of_imports_sees_every_form(tmp_path, monkeypatch):
    path = tmp_path / "probe.py"
    path.write_text(
        "import sapien.physx\nfrom manicm_ms import errors\nfrom . import store\n"
        "from .sequence_dataset import SequenceDataset\n"
        "def f():\n    import mujoco\n    importlib.import_module('metaworld')\n"
    )
    monkeypatch.setitem(MODULES, "manicm_ms.demos.probe", path)
    expected = {
        "sapien.physx",
        "manicm_ms.errors",
        "manicm_ms.demos.store",
        "manicm_ms.demos.sequence_dataset",
        "mujoco",
    }
    assert imports("manicm_ms.demos.probe") == expected | {"metaworld"}


def loaded_by(code: str) -> set[str]:
    """Top-level packages in sys.modules after `code` ran in a fresh interpreter."""
    report = "import json, sys; print(json.dumps(sorted({m.split('.')[0] for m in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_importing_the_package_loads_no_simulator_and_no_torch():
    """It makes ids known to Gymnasium; what they name is imported when it is made."""
    assert not loaded_by("import manicm_ms") & (SIMULATORS | {"gymnasium_robotics", "torch", "scipy", "zarr"})


def test_a_policy_server_needs_no_simulator():
    names = sorted(name for name in MODULES if layer(name) == "policies")
    assert len(names) > 1
    loaded = loaded_by(f"import importlib\nfor name in {names!r}: importlib.import_module(name)")
    assert "torch" in loaded
    assert not loaded & SIMULATORS


_STOP_AT_SAPIEN = """
import importlib, json, os, sys
class Reached(BaseException): pass
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name in ("sapien", "mani_skill"):
            raise Reached(os.environ.get("VK_DRIVER_FILES", ""))
sys.meta_path.insert(0, Watch())
told = {}
for name in json.loads(sys.argv[1]):
    os.environ.pop("VK_DRIVER_FILES", None)
    for key in [k for k in sys.modules if k.startswith("manicm_ms")]:
        del sys.modules[key]
    try:
        importlib.import_module(name)
    except Reached as reached:
        told[name] = str(reached)
print(json.dumps(told))
"""


def test_the_vulkan_driver_is_chosen_before_sapien_is_imported(tmp_path):
    (tmp_path / "driver.json").write_text("{}")
    (tmp_path / "vulkan.json").write_text('{"driver": "driver.json", "preload": []}')
    names = sorted(name for name in MODULES if layer(name) in {"robots", "envs", "tasks", "demos", "bench"})
    env = {k: v for k, v in os.environ.items() if k not in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")}
    env["MANICM_MS_VULKAN"] = str(tmp_path)
    command = [sys.executable, "-c", _STOP_AT_SAPIEN, json.dumps(names)]
    done = subprocess.run(command, capture_output=True, text=True, env=env, check=True)
    told = json.loads(done.stdout.splitlines()[-1])
    assert "manicm_ms.tasks.slide_block" in told  # or this test would look at nothing
    assert set(told.values()) == {str(tmp_path / "driver.json")}, told


POLICY_ROOMS = ("encoders", "backbones", "heads")
"""Rooms of policies/, each of which may import those before it; above them stand methods and checkpoints."""
POLICY_BASE = {"configuration", "normalizer", "policy", "finite"}


@pytest.mark.parametrize("room", POLICY_ROOMS)
def test_a_room_of_the_policies_imports_no_room_above_it(room):
    allowed = {*POLICY_ROOMS[: POLICY_ROOMS.index(room) + 1], *POLICY_BASE}
    for name in MODULES:
        if name.startswith(f"manicm_ms.policies.{room}"):
            theirs = {other.split(".")[2] for other in imports(name) if other.startswith("manicm_ms.policies.")}
            assert theirs <= allowed, name
