"""The set-up scripts: apt's configuration in both formats, and a stamp that knows when to start anew."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

REPO = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def setup_vulkan():
    spec = importlib.util.spec_from_file_location("setup_vulkan", REPO / "scripts" / "setup_vulkan.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["setup_vulkan"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["setup_vulkan"]


DEB822 = """\
Types: deb
# a comment
URIs: http://mirror.example/debian
Suites: bookworm bookworm-updates
Components: main
Signed-By: /usr/share/keyrings/ring.gpg

Types: deb-src
URIs: http://mirror.example/debian
Suites: bookworm
Components: main

Enabled: no
Types: deb
URIs: http://off.example/
Suites: bookworm
Components: main
"""
EMBEDDED_KEY = """\
Types: deb
URIs: http://mirror.example/debian
Suites: bookworm
Components: main
Signed-By:
 -----BEGIN PGP PUBLIC KEY BLOCK-----
 .
 abc
 -----END PGP PUBLIC KEY BLOCK-----
"""
ONE_LINE = """\
# deb http://off.example/ bookworm main
deb [arch=amd64 signed-by=/ring.gpg] https://third.example/ cloud-bookworm main
deb [arch=amd64,arm64 signed-by=/usr/share/keyrings/ring.gpg] http://mirror.example/debian bookworm main contrib # here
deb-src http://mirror.example/debian bookworm main
"""


def backports(module, root):
    return module.backports_of(module.apt_sources(root), "bookworm")


def test_backports_take_mirror_and_key_from_deb822(setup_vulkan, tmp_path):
    (tmp_path / "sources.list.d").mkdir()
    (tmp_path / "sources.list.d" / "debian.sources").write_text(DEB822)
    assert backports(setup_vulkan, tmp_path).deb822() == (
        "Types: deb\nURIs: http://mirror.example/debian\nSuites: bookworm-backports\nComponents: main\n"
        "Signed-By: /usr/share/keyrings/ring.gpg\n"
    )


def test_backports_take_mirror_and_key_from_one_line_format(setup_vulkan, tmp_path):
    (tmp_path / "sources.list").write_text(ONE_LINE)
    assert backports(setup_vulkan, tmp_path).deb822() == (
        "Types: deb\nURIs: http://mirror.example/debian\nSuites: bookworm-backports\nComponents: main\n"
        "Architectures: amd64 arm64\nSigned-By: /usr/share/keyrings/ring.gpg\n"
    )


def test_an_embedded_key_survives(setup_vulkan):
    (source,) = setup_vulkan.parse_deb822(EMBEDDED_KEY)
    assert setup_vulkan.parse_deb822(source.deb822()) == [source]
    assert "\n .\n abc\n" in source.deb822()


def test_a_machine_without_a_main_mirror_has_no_backports(setup_vulkan, tmp_path):
    (tmp_path / "sources.list").write_text("deb https://third.example/ cloud-bookworm main\n")
    assert backports(setup_vulkan, tmp_path) is None


@pytest.mark.parametrize(
    ("version", "enough"),
    [("22.3.6-1+deb12u2", False), ("24.2.8-1ubuntu1~24.04.1", False), ("24.3.0-1", True), ("25.0.7-2~bpo12+1", True)],
)
def test_lavapipe_must_be_24_3(setup_vulkan, version, enough):
    assert (setup_vulkan.mesa_version(version) >= setup_vulkan.NEEDED_MESA) is enough


# ------------------------------------------------ setup.sh with a Python that only notes what it is asked


@pytest.fixture
def checkout(tmp_path) -> Path:
    """A copy of what set-up reads, with a stand-in for Python: set-up's own decisions are what is looked at here."""
    copy = tmp_path / "repo"
    (copy / "scripts").mkdir(parents=True)
    scripts = ("scripts/setup.sh", "scripts/setup_vulkan.py", "scripts/setup_mujoco.py")
    for name in ("setup.cfg", "pyproject.toml", "constraints.txt", *scripts):
        shutil.copy(REPO / name, copy / name)
    stand_in = copy / "standin"
    stand_in.write_text(
        """#!/bin/bash
echo "$*" >> calls
case "$*" in
    *"-m venv"*) mkdir -p .venv/bin; cp "$0" .venv/bin/python;;
    *get_path*) mkdir -p .venv/cv2; echo 'headless = True' > .venv/cv2/version.py; echo .venv/cv2/version.py;;
    *"version_info[:2] >= (3, 13)"*) exit 0;;
    *"install "*-e*) [ ! -e pip-fails ] || exit 1; [ ! -e pip-is-killed ] || kill -9 $PPID
        [ ! -e pip-kills-itself ] || kill -9 $$;;
    *setup_vulkan*) [ ! -e vulkan-fails ] || exit 1;;
esac
"""
    )
    stand_in.chmod(0o755)
    return copy


def run_setup(checkout: Path, **env: str) -> tuple[int, str]:
    """Run setup.sh; return its exit status and what it asked of Python."""
    (checkout / "calls").unlink(missing_ok=True)
    environment = {**os.environ, "PYTHON": str(checkout / "standin"), **env}
    done = subprocess.run(["bash", "scripts/setup.sh"], cwd=checkout, env=environment, capture_output=True, check=False)
    calls = checkout / "calls"
    return done.returncode, calls.read_text() if calls.exists() else ""


def test_a_second_run_asks_nothing_of_python(checkout):
    status, calls = run_setup(checkout)
    assert status == 0
    assert "-m venv" in calls
    assert "setup_vulkan.py" in calls
    assert "setup_mujoco.py" in calls
    assert run_setup(checkout) == (0, "")
    assert "install" in run_setup(checkout, FORCE="1")[1]


@pytest.mark.parametrize("name", ["constraints.txt", "setup.cfg", "scripts/setup_vulkan.py"])
def test_a_changed_input_is_noticed(checkout, name):
    run_setup(checkout)
    with (checkout / name).open("a") as f:
        f.write("\n# changed\n")
    status, calls = run_setup(checkout)
    assert status == 0
    assert "-e .[dev]" in calls
    assert "-m venv" not in calls  # the environment stays
    assert run_setup(checkout) == (0, "")


def test_a_moved_checkout_is_noticed(checkout):
    run_setup(checkout)
    moved = checkout.rename(checkout.with_name("elsewhere"))
    status, calls = run_setup(moved)
    assert status == 0
    assert "-e .[dev]" in calls  # the editable installation pointed at the old place
    assert run_setup(moved) == (0, "")


def test_a_pip_failure_is_told_and_repaired_in_place(checkout):
    (checkout / "pip-fails").touch()
    status, _ = run_setup(checkout)
    assert status != 0
    assert not (checkout / ".venv/.setup-done").exists()
    (checkout / "pip-fails").unlink()
    status, calls = run_setup(checkout)
    assert status == 0
    assert "-m venv" not in calls


def test_a_kill_during_the_installation_starts_the_environment_anew(checkout):
    (checkout / "pip-is-killed").touch()
    assert run_setup(checkout)[0] != 0
    (checkout / "pip-is-killed").unlink()
    (checkout / ".venv" / "half-installed").touch()
    status, calls = run_setup(checkout)
    assert status == 0
    assert "-m venv" in calls
    assert not (checkout / ".venv" / "half-installed").exists()


def test_a_killed_pip_starts_the_environment_anew(checkout):
    (checkout / "pip-kills-itself").touch()
    assert run_setup(checkout)[0] != 0
    (checkout / "pip-kills-itself").unlink()
    assert "-m venv" in run_setup(checkout)[1]


def test_a_rendering_failure_is_tried_again(checkout):
    (checkout / "vulkan-fails").touch()
    assert run_setup(checkout)[0] != 0
    (checkout / "vulkan-fails").unlink()
    status, calls = run_setup(checkout)
    assert status == 0
    assert "setup_vulkan.py" in calls


def test_an_unsuitable_python_is_refused(checkout, tmp_path):
    (tmp_path / "old").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "old").chmod(0o755)
    assert run_setup(checkout, PYTHON=str(tmp_path / "old")) == (1, "")


def test_a_private_opengl_that_is_gone_is_noticed(checkout):
    manifest = checkout / ".mujoco_gl" / "mujoco_gl.json"
    manifest.parent.mkdir()
    manifest.touch()
    assert run_setup(checkout)[0] == 0
    assert run_setup(checkout) == (0, "")
    manifest.unlink()
    assert "setup_mujoco.py" in run_setup(checkout)[1]


# ------------------------------------------------ MuJoCo's OpenGL


@pytest.fixture
def setup_mujoco(setup_vulkan, monkeypatch, tmp_path):
    """The script as a module; apt, root and this checkout's folder are not touched."""
    spec = importlib.util.spec_from_file_location("setup_mujoco", REPO / "scripts" / "setup_mujoco.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "setup_mujoco", module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "run", lambda command: "")
    monkeypatch.setattr(module, "Apt", lambda: SimpleNamespace(update=lambda: None))
    monkeypatch.setattr(module.shutil, "which", lambda name: f"/usr/bin/{name}")
    monkeypatch.setattr(module, "PRIVATE", tmp_path / ".mujoco_gl")
    return module


def answers(monkeypatch, module, *found):
    """Let the trial renderings answer `found` one after the other; return what is installed or unpacked in between."""
    left, provided = list(found), []
    monkeypatch.setattr(module, "renderer", lambda python, source: left.pop(0))
    monkeypatch.setattr(module, "install", provided.append)

    def unpack(packages, fresh, codename, choose):
        provided.append(packages)
        shutil.rmtree(fresh, ignore_errors=True)
        (fresh / "root").mkdir(parents=True)
        (fresh / "root" / packages[0]).touch()

    monkeypatch.setattr(module, "unpack", unpack)
    return provided


def test_an_opengl_that_renders_is_kept(setup_mujoco, monkeypatch):
    provided = answers(monkeypatch, setup_mujoco, ("a GPU through egl", ""))
    setup_mujoco.PRIVATE.mkdir()  # an earlier run's choice, from before the system had one
    assert setup_mujoco.ensure_renderer("python") == "a GPU through egl"
    assert provided == []
    assert not setup_mujoco.PRIVATE.exists()


def test_an_earlier_choice_that_renders_is_kept(setup_mujoco, monkeypatch):
    provided = answers(monkeypatch, setup_mujoco, ("", "no EGL"), ("llvmpipe through egl", ""))
    setup_mujoco.PRIVATE.mkdir()
    (setup_mujoco.PRIVATE / setup_mujoco.MANIFEST).touch()
    assert setup_mujoco.ensure_renderer("python") == "llvmpipe through egl"
    assert provided == []


def test_root_installs_egl_and_then_osmesa(setup_mujoco, monkeypatch):
    monkeypatch.setattr(setup_mujoco.os, "geteuid", lambda: 0)
    provided = answers(monkeypatch, setup_mujoco, ("", "no EGL"), ("", "still none"), ("llvmpipe through osmesa", ""))
    assert setup_mujoco.ensure_renderer("python") == "llvmpipe through osmesa"
    assert provided == [setup_mujoco.EGL.packages, setup_mujoco.OSMESA.packages]


def test_without_root_the_first_that_renders_is_unpacked(setup_mujoco, monkeypatch):
    monkeypatch.setattr(setup_mujoco.os, "geteuid", lambda: 1000)
    provided = answers(monkeypatch, setup_mujoco, ("", "no EGL"), ("", "still none"), ("llvmpipe through osmesa", ""))
    assert setup_mujoco.ensure_renderer("python") == "llvmpipe through osmesa"
    assert provided == [setup_mujoco.EGL.packages, setup_mujoco.OSMESA.packages]
    assert [path.name for path in (setup_mujoco.PRIVATE / "root").iterdir()] == ["libosmesa6"]
    assert json.loads((setup_mujoco.PRIVATE / setup_mujoco.MANIFEST).read_text())["gl"] == "osmesa"
    assert [path.name for path in setup_mujoco.PRIVATE.parent.iterdir()] == [".mujoco_gl"]


@pytest.mark.parametrize("tools", [("apt-get", "dpkg-deb"), ("apt-get",), ()])
def test_where_nothing_renders_it_says_what_to_ask_for_and_set_up_goes_on(setup_mujoco, monkeypatch, capsys, tools):
    monkeypatch.setattr(setup_mujoco.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(setup_mujoco.shutil, "which", lambda name: name if name in tools else None)
    provided = answers(monkeypatch, setup_mujoco, *[("", "no OpenGL to render with")] * 3)
    monkeypatch.setattr(sys, "argv", ["setup_mujoco.py", "python"])
    assert setup_mujoco.main() == 0
    assert len(provided) == (2 if len(tools) == 2 else 0)
    assert not list(setup_mujoco.PRIVATE.parent.iterdir())
    told = capsys.readouterr().out
    assert "warning: Adroit and Meta-World will not render here: no OpenGL to render with: have libegl1" in told


def test_the_trial_ignores_what_this_shell_names(setup_mujoco, monkeypatch, tmp_path):
    (tmp_path / "python").write_text('#!/bin/sh\necho "$MUJOCO_GL,$LIBGL_DRIVERS_PATH,$MANICM_MS_MUJOCO_GL,$*"\n')
    (tmp_path / "python").chmod(0o755)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setenv("LIBGL_DRIVERS_PATH", "/theirs")
    asked = setup_mujoco.renderer(str(tmp_path / "python"), "system")
    assert asked == (",,system,-m manicm_ms.envs.mujoco_render", "")


def test_the_manifest_names_what_was_unpacked(setup_mujoco, monkeypatch, tmp_path):
    """`outer` stands for EGL, `inner` for what it needs there; libGL was not fetched, so it is the system's."""
    monkeypatch.undo()
    compiler = shutil.which("cc") or pytest.skip("no C compiler to build two libraries with")
    libraries = tmp_path / "root" / "usr" / "lib" / "any-linux-gnu"
    vendor = tmp_path / "root" / "usr" / "share" / "glvnd" / "egl_vendor.d" / "50_mesa.json"
    for folder in (libraries / "dri", vendor.parent):
        folder.mkdir(parents=True)
    vendor.touch()
    (libraries / "dri" / "swrast_dri.so").touch()
    (tmp_path / "inner.c").write_text("int inner(void) { return 41; }\n")
    (tmp_path / "outer.c").write_text("int inner(void); int outer(void) { return inner() + 1; }\n")
    inner, outer = libraries / "libinner_probe.so.2", libraries / "libEGL.so.1"
    for library, *sources in ((inner, tmp_path / "inner.c"), (outer, tmp_path / "outer.c", inner)):
        build = [compiler, "-shared", "-fPIC", f"-Wl,-soname,{library.name}", "-o", library, *sources]
        subprocess.run(build, check=True)
    setup_mujoco.write_manifest(sys.executable, tmp_path, setup_mujoco.EGL)
    at = "root/usr/lib/any-linux-gnu"
    assert json.loads((tmp_path / setup_mujoco.MANIFEST).read_text()) == {
        "gl": "egl",
        "preload": [f"{at}/libinner_probe.so.2", f"{at}/libEGL.so.1"],
        "environment": {
            "__EGL_VENDOR_LIBRARY_FILENAMES": "root/usr/share/glvnd/egl_vendor.d/50_mesa.json",
            "LIBGL_DRIVERS_PATH": f"{at}/dri",
        },
    }
