"""The wheel and the sdist hold every module and data file of the tree and work in an environment without it."""

import configparser
import json
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[1]
MAPPED = {"manicm_ms": "manicm_ms", "tasks": "manicm_ms/tasks", "assets": "manicm_ms/assets"}
CODE_AND_DATA = {".py", ".typed", ".urdf", ".glb", ".obj", ".stl", ".ply", ".vert", ".frag", ".json", ".md"} | {
    ".j2", ".html", ".css", ".js",
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
    """A folder into which the wheel, and nothing else, is installed."""
    target = tmp_path_factory.mktemp("site")
    wheel = next(built.glob("*.whl"))
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-index",
        "--no-deps",
        "--target",
        str(target),
        str(wheel),
    ]
    subprocess.run(command, check=True, capture_output=True)
    return target


def ask_installed(installed: Path, code: str) -> dict:
    """Run `code` where only the installed copy is importable (its dependencies are taken from here); parse its JSON."""
    # -I ignores the environment and the working folder; the editable install's finder is taken out of sys.meta_path.
    dependencies = [p for p in sys.path if "site-packages" in p]
    start = (
        "import sys, json\n"
        "sys.meta_path = [f for f in sys.meta_path if '__editable__' not in getattr(f, '__module__', repr(f))]\n"
        f"sys.path = [{str(installed)!r}] + [p for p in sys.path if p not in {dependencies!r}] + {dependencies!r}\n"
    )
    done = subprocess.run([sys.executable, "-I", "-c", start + code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


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
    ):
        assert "://" not in (REPO / name).read_text(), name


def test_the_command_line_is_installed(built):
    with zipfile.ZipFile(next(built.glob("*.whl"))) as wheel:
        name = next(n for n in wheel.namelist() if n.endswith("entry_points.txt"))
        assert "manicm-ms = manicm_ms.cli:main" in wheel.read(name).decode()
