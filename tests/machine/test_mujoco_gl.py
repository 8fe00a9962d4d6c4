"""MuJoCo's OpenGL where set-up unpacked one inside the checkout: the manifest, and what each process makes of it."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from manicm_ms.errors import RenderDeviceError
from manicm_ms.machine import mujoco_gl, private_libraries

VENDOR = "__EGL_VENDOR_LIBRARY_FILENAMES"


@pytest.fixture
def private(tmp_path, monkeypatch) -> Path:
    """A folder with a manifest, used in a shell that names no OpenGL."""
    monkeypatch.setenv(mujoco_gl.FOLDER_VARIABLE, str(tmp_path))
    for name in (mujoco_gl.VARIABLE, VENDOR, "PYOPENGL_PLATFORM"):  # mujoco's import sets the last
        monkeypatch.setenv(name, "")  # so that it is put back, whatever a test makes of it
        monkeypatch.delenv(name)
    (tmp_path / "vendor.json").touch()
    write(tmp_path)
    return tmp_path


def write(folder: Path, **fields: object) -> None:
    """Write a manifest that loads nothing, but for `fields`."""
    manifest = {"gl": "egl", "preload": [], "environment": {VENDOR: "vendor.json"}, **fields}
    (folder / mujoco_gl.MANIFEST).write_text(json.dumps(manifest))


def library(path: Path, answer: int) -> Path:
    """Build a library whose soname is its file's name and whose `answer()` returns `answer`."""
    compiler = shutil.which("cc") or pytest.skip("no C compiler to build a library with")
    path.parent.mkdir(exist_ok=True)
    source = path.with_suffix(".c")
    source.write_text(f"int answer(void) {{ return {answer}; }}\n")
    subprocess.run([compiler, "-shared", "-fPIC", f"-Wl,-soname,{path.name}", "-o", path, source], check=True)
    return path


def python(code: str) -> str:
    """Run `code` in a fresh process and return what it printed."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_the_manifest_comes_before_the_systems_opengl(private, monkeypatch):
    monkeypatch.setattr(mujoco_gl, "_egl_works", lambda: pytest.fail("set-up's trial has answered that"))
    write(private, gl="osmesa")
    assert mujoco_gl.prepare() == "osmesa"
    assert os.environ["MUJOCO_GL"] == "osmesa"
    assert os.environ[VENDOR] == str(private / "vendor.json")
    assert mujoco_gl.prepare() == "osmesa"


def test_a_system_without_a_manifest_is_asked_itself(private, monkeypatch):
    monkeypatch.setenv(mujoco_gl.FOLDER_VARIABLE, "system")
    monkeypatch.setattr(mujoco_gl, "_egl_works", lambda: True)
    assert mujoco_gl.prepare() == "egl"
    assert VENDOR not in os.environ


@pytest.mark.parametrize("choice", ["disabled", "glfw", "osmesa"])
def test_another_kind_that_the_user_named_stays(private, monkeypatch, choice):
    monkeypatch.setenv("MUJOCO_GL", choice)
    monkeypatch.setattr(mujoco_gl, "_library", lambda *names: True)
    assert mujoco_gl.prepare() == choice
    assert VENDOR not in os.environ


def test_a_variable_that_the_user_set_stays(private, monkeypatch):
    monkeypatch.setenv(VENDOR, "/their/own.json")
    monkeypatch.setattr(mujoco_gl, "_egl_works", lambda: True)
    assert mujoco_gl.prepare() == "egl"
    assert os.environ[VENDOR] == "/their/own.json"


def test_a_named_folder_without_a_manifest_is_refused(private):
    (private / mujoco_gl.MANIFEST).unlink()
    with pytest.raises(RenderDeviceError, match=f"MANICM_MS_MUJOCO_GL={private} holds no mujoco_gl.json: unset it"):
        mujoco_gl.prepare()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"gl": "egl", "preload": []}',
        '{"gl": "egl", "preload": [], "environment": []}',
        '{"gl": "vulkan", "preload": [], "environment": {}}',
        '{"gl": "egl", "preload": ["gone.so"], "environment": {}}',
        '{"gl": "egl", "preload": [], "environment": {"LIBGL_DRIVERS_PATH": "gone"}}',
        '{"gl": "egl", "preload": ["vendor.json"], "environment": {}}',  # no library
    ],
)
def test_a_broken_manifest_is_refused(private, text):
    (private / mujoco_gl.MANIFEST).write_text(text)
    with pytest.raises(RenderDeviceError, match="make setup"):
        mujoco_gl.prepare()
    assert "MUJOCO_GL" not in os.environ


def test_every_process_loads_the_libraries(private):
    """A worker inherits the variables and not the libraries: preparing it loads them there as well."""
    library(private / "libanswer_probe.so.1", 42)
    write(private, preload=["libanswer_probe.so.1"])
    worker = "import ctypes; print(ctypes.CDLL('libanswer_probe.so.1').answer())"
    prepare = "from manicm_ms import mujoco_gl; mujoco_gl.prepare()"
    code = f"import subprocess, sys; {prepare}\n{worker}\nsys.stdout.flush()\n"
    assert python(code + f"subprocess.run([sys.executable, '-c', {f'{prepare}; {worker}'!r}])").split() == ["42", "42"]


def test_rendering_with_a_manifest(private):
    """With a manifest that adds nothing to the system's OpenGL, the picture is made as without one."""
    choice = python("import os; os.environ['MANICM_MS_MUJOCO_GL'] = 'system'\n"
                    "from manicm_ms import mujoco_gl; print(mujoco_gl.prepare())")  # fmt: skip
    if choice not in ("egl", "osmesa"):
        pytest.skip("this system has no OpenGL of its own")
    write(private, gl=choice, environment={})
    works = mujoco_gl.probe()
    assert works.works, works.reason
    assert works.device.endswith(f"through {choice}")


def test_a_library_whose_name_is_loaded_is_not_loaded_again(tmp_path):
    """Two drivers bring the same library: the linker would serve both the first, so the second stays out."""
    paths = [str(library(tmp_path / name / "libtwice_probe.so.1", i)) for i, name in enumerate(("first", "second"))]
    private_libraries.load(paths)
    loaded = Path("/proc/self/maps").read_text()
    assert paths[0] in loaded
    assert paths[1] not in loaded


# ---- what the user's own variables do -------------------------------------------------------------------------------

WRONG = {
    "MUJOCO_GL": "no-such-gl",
    "PYOPENGL_PLATFORM": "glx",
    "MUJOCO_EGL_DEVICE_ID": "977",
    VENDOR: "/gone/vendor.json",
}


def with_variable(name: str, *words: str) -> subprocess.CompletedProcess:
    """Run Python where a variable of MuJoCo's or OpenGL's has a wrong value."""
    env = {k: v for k, v in os.environ.items() if k not in WRONG and k != mujoco_gl.FOLDER_VARIABLE}
    env |= {"MUJOCO_GL": "egl", name: WRONG[name]}
    return subprocess.run([sys.executable, *words], env=env, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_variable_is_named_with_its_value_where_mujoco_renders(name):
    done = with_variable(name, "-m", "manicm_ms.envs.mujoco_render")
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert f"{name}={WRONG[name]}" in line
    assert "unset" in line


@pytest.mark.parametrize("package", ["envs", "robots", "tasks"])
@pytest.mark.parametrize("name", ["MUJOCO_GL", "PYOPENGL_PLATFORM"])
def test_a_wrong_variable_ends_nothing_that_renders_without_mujoco(name, package):
    """ManiSkill imports mujoco, whose import would end in an error of PyOpenGL's; the variable stays as it was."""
    code = f"import os, manicm_ms.{package}, mujoco; print(os.environ.get({name!r}), mujoco.mj_versionString())"
    done = with_variable(name, "-c", code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{WRONG[name]} 3.")
