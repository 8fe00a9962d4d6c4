"""The wheel and the sdist hold every module and data file of the tree and work in an environment without it."""

import configparser
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from pathlib import Path

import pytest

from manicm_ms import __version__

REPO = Path(__file__).resolve().parents[1]
MAPPED = {"manicm_ms": "manicm_ms", "tasks": "manicm_ms/tasks", "assets": "manicm_ms/assets"}
CODE_AND_DATA = {".py", ".typed", ".urdf", ".glb", ".obj", ".stl", ".ply", ".vert", ".frag", ".json", ".md"} | {
    ".yaml", ".j2", ".html", ".css", ".js",
}  # fmt: skip


def expected_files(source: Path) -> set[str]:
    """Name inside the wheel of every file under the three source folders."""
    found = set()
    for folder, target in MAPPED.items():
        files = (path for path in (source / folder).rglob("*") if path.is_file())
        found |= {f"{target}/{path.relative_to(source / folder).as_posix()}" for path in files}
    return found


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """A copy of what a build reads, so that building leaves nothing in the working tree."""
    copy = tmp_path_factory.mktemp("source")
    skip = shutil.ignore_patterns("__pycache__")
    for folder in MAPPED:
        shutil.copytree(REPO / folder, copy / folder, ignore=skip)
    for name in ("setup.cfg", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(REPO / name, copy / name)
    return copy


@pytest.fixture(scope="module")
def built(source, tmp_path_factory) -> Path:
    """The folder with the sdist and the wheel that was built from it."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(source)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return out


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Path:
    """A fresh environment with the wheel, which finds its dependencies (and nothing of this checkout) in this one's."""
    environment = tmp_path_factory.mktemp("installed") / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True, capture_output=True)
    python = environment / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-index", "--no-deps"]
    subprocess.run([*install, str(next(built.glob("*.whl")))], check=True, capture_output=True)
    # A .pth file adds folders without running the .pth files in them, so the editable install there stays unseen.
    ours = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    site = sysconfig.get_path("purelib", "venv", {"base": str(environment), "platbase": str(environment)})
    (Path(site) / "dependencies.pth").write_text("".join(f"{folder}\n" for folder in sorted(ours)))
    return environment


def run_installed(program: Path, *arguments: str) -> str:
    """Run a program of the fresh environment away from the checkout, without this shell's paths; return its output."""
    env = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        [str(program), *arguments], capture_output=True, text=True, check=False, cwd=program.parent, env=env
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def ask_installed(installed: Path, code: str) -> dict:
    """Run `code` with the fresh environment's interpreter and parse the JSON that it prints last."""
    return json.loads(run_installed(installed / "bin" / "python", "-c", "import json\n" + code).splitlines()[-1])


def test_the_wheel_holds_every_file_of_the_tree(source, built):
    inside = set(zipfile.ZipFile(next(built.glob("*.whl"))).namelist())
    missing = expected_files(source) - inside
    assert not missing, f"add the package or the file's ending to setup.cfg: {sorted(missing)}"
    strangers = {n for n in inside if not n.startswith("manicm_ms-")} - expected_files(source)
    assert not strangers


def test_the_kinds_of_file_are_known(source):
    endings = {Path(name).suffix for name in expected_files(source)}
    assert endings <= CODE_AND_DATA, "a new kind of file: is it meant to be shipped? then add it here and to setup.cfg"


def test_the_sdist_holds_what_a_build_needs(built):
    with tarfile.open(next(built.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"setup.cfg", "pyproject.toml", "README.md", "LICENSE"} <= names
    assert "tasks/slide_block.py" in names
    assert "assets/robots/ur3e_ag95/ur3e_ag95.urdf" in names


def test_the_installed_copy_finds_urdf_meshes_and_tasks(installed):
    code = """
import re, pkgutil, manicm_ms, manicm_ms.tasks
from manicm_ms.paths import asset
urdf = asset("robots", "ur3e_ag95", "ur3e_ag95.urdf")
meshes = re.findall(r'filename="([^"]+)"', urdf.read_text())
print(json.dumps({
    "home": manicm_ms.__file__, "urdf": str(urdf), "typed": asset("..", "py.typed").is_file(),
    "meshes": {name: (urdf.parent / name).stat().st_size for name in meshes},
    "tasks": [m.name for m in pkgutil.iter_modules(manicm_ms.tasks.__path__)],
}))
"""
    told = ask_installed(installed, code)
    assert told["home"].startswith(str(installed))
    assert told["urdf"].startswith(str(installed))
    assert told["typed"]
    assert len(told["meshes"]) >= 6
    assert min(told["meshes"].values()) > 0
    assert "slide_block" in told["tasks"]


def test_the_installed_copy_registers_its_tasks_with_maniskill(installed):
    code = """
import manicm_ms.tasks.slide_block as task
from mani_skill.utils.registration import REGISTERED_ENVS
print(json.dumps({"file": task.__file__, "known": "UR3eSlideBlock-v1" in REGISTERED_ENVS}))
"""
    told = ask_installed(installed, code)
    assert told["file"].startswith(str(installed))
    assert told["known"]


def test_every_requirement_is_pinned_in_the_constraints():
    config = configparser.ConfigParser()
    config.read(REPO / "setup.cfg")
    lines = config["options"]["install_requires"].splitlines()
    lines += [line for extra in config["options.extras_require"].values() for line in extra.splitlines()]
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    pins = {}
    for line in (REPO / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            pin = Requirement(line)
            assert [s.operator for s in pin.specifier] == ["=="], line
            pins[canonicalize_name(pin.name)] = next(iter(pin.specifier)).version
    wanted = [Requirement(line) for line in lines if line.strip() and not line.startswith("#")]
    assert len(wanted) > 20
    for requirement in wanted:
        assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), requirement


def test_no_package_host_is_named():
    for name in (
        "Makefile",
        "setup.cfg",
        "pyproject.toml",
        "constraints.txt",
        "scripts/setup.sh",
        "scripts/setup_vulkan.py",
        "scripts/setup_mujoco.py",
    ):
        assert "://" not in (REPO / name).read_text(), name


def test_the_installed_command_line_runs(installed):
    home = Path(ask_installed(installed, "import manicm_ms\nprint(json.dumps(manicm_ms.__file__))"))
    assert home.is_relative_to(installed)
    manicm_ms = installed / "bin" / "manicm-ms"
    assert run_installed(manicm_ms, "--version") == f"{__version__}\n"
    assert "ur3e/slide-block" in run_installed(manicm_ms, "list", "envs")
    command = [manicm_ms, "bench", "depth", "--write"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=installed, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert "manicm_ms is installed outside of one" in done.stderr, "there is no docs/results to keep a page in"
