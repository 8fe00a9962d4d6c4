"""OpenGL without a screen, for MuJoCo: chooses EGL or OSMesa before mujoco is imported, and tries it.

MuJoCo reads MUJOCO_GL while it is imported and, left alone, takes GLFW, which needs a screen. `prepare` sets it to the
first that this machine has: EGL (a GPU's, or Mesa's software renderer), else OSMesa, else "disabled": physics then
works and rendering raises RenderDeviceError. A choice that the user made stays. One that cannot be used is an error
where MuJoCo is to render, and nowhere else: `prepare_import` keeps mujoco's import from failing by it.

Where `make setup` had no root to install an OpenGL with, it unpacked one into `.mujoco_gl/` and left a manifest,
`.mujoco_gl/mujoco_gl.json`, which then comes first (paths relative to the folder)::

    {"gl": "egl", "preload": ["root/usr/lib/x86_64-linux-gnu/libGLdispatch.so.0", ...],
     "environment": {"__EGL_VENDOR_LIBRARY_FILENAMES": "root/usr/share/glvnd/egl_vendor.d/50_mesa.json", ...}}

`MANICM_MS_MUJOCO_GL` names another folder with such a manifest, or is `system` to ignore all of them.

Run as a module, it ends with status 0 where EGL opens without a screen, else 1.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manicm_ms.errors import RenderDeviceError
from manicm_ms.machine import private_libraries

VARIABLE = "MUJOCO_GL"
FOLDER_VARIABLE = "MANICM_MS_MUJOCO_GL"
MANIFEST = "mujoco_gl.json"
DISABLED = "disabled"
CHOICES = ("egl", "osmesa", "glfw", DISABLED)
REMEDY = "run 'make setup FORCE=1' in the repository, or as root 'apt install libegl1 libgl1' (or libosmesa6)"

_CONTEXTS = {"egl": "mujoco.egl", "osmesa": "mujoco.osmesa", "glfw": "mujoco.glfw"}
_LIBRARIES = {"egl": ("libEGL.so.1",), "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6")}
_TRIAL = "manicm_ms.envs.mujoco_render"  # run as a module, it renders one tiny picture
_PLATFORM_VARIABLE = "PYOPENGL_PLATFORM"
_DEVICE_VARIABLE = "MUJOCO_EGL_DEVICE_ID"
_DRIVER_VARIABLES = ("__EGL_VENDOR_LIBRARY_FILENAMES", "__EGL_VENDOR_LIBRARY_DIRS", "LIBGL_DRIVERS_PATH")
_EGL_PLATFORM_DEVICE = 0x313F
_MOST_DEVICES = 32


@dataclass(frozen=True)
class Probe:
    """Outcome of a trial rendering.

    Attributes:
        works: whether MuJoCo rendered a correct depth image.
        device: the OpenGL renderer's name and how it was reached, empty where it does not work.
        reason: one line saying what went wrong, empty where it works.
    """

    works: bool
    device: str = ""
    reason: str = ""


def prepare() -> str:
    """Choose how MuJoCo renders in this process and its children, and return it: one of `CHOICES`.

    Call it before mujoco is first imported. Calling twice is fine.

    Raises RenderDeviceError where MUJOCO_GL names something else, or a library that is not here, where
    PYOPENGL_PLATFORM names another one, and where the manifest of a private OpenGL is broken.
    """
    choice = _choose()
    platform = os.environ.get(_PLATFORM_VARIABLE, "")
    if choice in _LIBRARIES and platform.lower() not in ("", choice) and _CONTEXTS[choice] not in sys.modules:
        raise RenderDeviceError(
            f"{_PLATFORM_VARIABLE}={platform} keeps PyOpenGL from {choice}, which MuJoCo renders with here: unset it"
        )
    return choice


def prepare_import() -> None:
    """As `prepare`, but where that fails import mujoco without OpenGL: `make_context` will say why.

    mujoco's import ends in an error of PyOpenGL's where a variable of the user's names what is not here, also for
    programs that render nothing with it.
    """
    try:
        prepare()
    except RenderDeviceError:
        named = os.environ.get(VARIABLE)
        os.environ[VARIABLE] = DISABLED
        try:
            importlib.import_module("mujoco")
        finally:
            os.environ.pop(VARIABLE) if named is None else os.environ.update({VARIABLE: named})


def spare_others() -> None:
    """Call it before another library may import mujoco: a wrong value of the user's variables is then no error yet."""
    if os.environ.get(VARIABLE) and "mujoco" not in sys.modules:
        with contextlib.suppress(ImportError):  # MuJoCo is not installed
            prepare_import()


def _choose() -> str:
    # Threads of Mesa's rasteriser do not survive a fork, and are no faster at the size of an observation.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    named = os.environ.get(VARIABLE, "").strip().lower()
    if named and named not in CHOICES:
        raise RenderDeviceError(f"{VARIABLE}={named} is none of {', '.join(CHOICES)}: unset it, or name one of them")
    if named in ("", *_LIBRARIES) and _use_private(named):
        return os.environ[VARIABLE]
    if named in _LIBRARIES and not _library(*_LIBRARIES[named]):
        raise RenderDeviceError(f"{VARIABLE}={named}, but {_LIBRARIES[named][0]} is not here: unset it; {REMEDY}")
    if not named:
        named = "egl" if _egl_works() else "osmesa" if _library(*_LIBRARIES["osmesa"]) else DISABLED
        os.environ[VARIABLE] = named
    return named


def make_context(width: int, height: int) -> Any:
    """Return a GL context of MuJoCo's own, not yet current, for pictures of up to `width` x `height` pixels.

    Raises RenderDeviceError where there is none to be had.
    """
    choice = prepare()
    if choice == DISABLED:
        raise RenderDeviceError(f"no OpenGL to render with: neither EGL nor OSMesa is here; {REMEDY}")
    try:
        kind = importlib.import_module(_CONTEXTS[choice]).GLContext
        if not hasattr(kind, "_context"):  # mujoco frees what was never made, and an error of that would be printed
            kind._context = None
        return kind(width, height)
    except Exception as error:  # PyOpenGL's and the driver's own kinds; what follows is the same for all
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise RenderDeviceError(f"MuJoCo cannot render through {choice} ({lines[0]}); {_remedy()}") from error


def _remedy() -> str:
    """Return what to try where rendering fails: first without the variables that the user set, if there are any."""
    ours = _private_environment()
    theirs = [
        f"{name}={os.environ[name]}"
        for name in (_DEVICE_VARIABLE, *_DRIVER_VARIABLES)
        if os.environ.get(name) and os.environ[name] != ours.get(name)
    ]
    return f"unset {' and '.join(theirs)}, or correct it" if theirs else REMEDY


def _private_environment() -> dict[str, str]:
    """Return the variables that a private OpenGL sets, none where there is no sound one."""
    try:
        where = private_libraries.folder(FOLDER_VARIABLE, ".mujoco_gl", MANIFEST)
        return {} if where is None else _read_manifest(where / MANIFEST)[2]
    except RenderDeviceError:
        return {}


def probe(timeout_s: float = 120) -> Probe:
    """Render a tiny scene in a process of its own: a driver may crash, and what it loads stays out of this one."""
    try:
        done = subprocess.run(
            [sys.executable, "-m", _TRIAL], capture_output=True, text=True, timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired:
        return Probe(False, reason=f"no picture within {timeout_s:.0f} s")
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    last = lines[-1] if lines else f"the trial rendering ended with status {done.returncode}"
    return Probe(True, device=last) if done.returncode == 0 else Probe(False, reason=last)


def _use_private(named: str) -> bool:
    """Load the OpenGL that set-up unpacked, for this process and its children; return False where it is not wanted.

    It is not where there is none, where the user `named` another kind, and where a variable that it needs is theirs.
    """
    where = private_libraries.folder(FOLDER_VARIABLE, ".mujoco_gl", MANIFEST)
    if where is None:
        return False
    choice, preload, environment = _read_manifest(where / MANIFEST)
    theirs = any(os.environ.get(key, value) != value for key, value in environment.items())
    if theirs or named not in ("", choice):
        return False
    try:
        private_libraries.load(preload)
    except OSError as error:
        raise RenderDeviceError(f"the private OpenGL does not load ({error}): {REMEDY}") from error
    os.environ.update({**environment, VARIABLE: choice})
    return True


def _read_manifest(path: Path) -> tuple[str, list[str], dict[str, str]]:
    """Return the kind of OpenGL, the libraries to load and the variables to set."""
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        choice = manifest["gl"]
        preload = [str(path.parent / p) for p in manifest["preload"]]
        environment = {key: str(path.parent / p) for key, p in manifest["environment"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RenderDeviceError(f"{path} cannot be read ({error}): {REMEDY}") from error
    if choice not in _LIBRARIES:
        raise RenderDeviceError(f"{path} names {choice!r}, which is none of {', '.join(_LIBRARIES)}: {REMEDY}")
    missing = [p for p in (*preload, *environment.values()) if not Path(p).exists()]
    if missing:
        raise RenderDeviceError(f"{path} names {missing[0]}, which does not exist: {REMEDY}")
    return choice, preload, environment


def _library(*names: str) -> ctypes.CDLL | None:
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None


def _egl_works() -> bool:
    """Ask a process of its own: a driver that was opened here might not survive a fork, and one that crashes none."""
    asked = subprocess.run([sys.executable, "-m", "manicm_ms.machine.mujoco_gl"], capture_output=True, check=False)
    return asked.returncode == 0


def _egl_initialises() -> bool:
    """Return whether some EGL device opens without a screen, asked the way MuJoCo does."""
    egl = _library(*_LIBRARIES["egl"])
    if egl is None:
        return False
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    pointer = ctypes.c_void_p
    addresses = [egl.eglGetProcAddress(name) for name in (b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT")]
    if not all(addresses):
        return False
    query_type = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.POINTER(pointer), ctypes.POINTER(ctypes.c_int))
    display_type = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)
    query, display_of = query_type(addresses[0]), display_type(addresses[1])
    egl.eglInitialize.argtypes = (pointer, pointer, pointer)
    devices, count = (pointer * _MOST_DEVICES)(), ctypes.c_int()
    if not query(_MOST_DEVICES, devices, ctypes.byref(count)):
        return False
    displays = (display_of(_EGL_PLATFORM_DEVICE, device, None) for device in devices[: count.value])
    return any(display and egl.eglInitialize(display, None, None) for display in displays)


if __name__ == "__main__":
    sys.exit(0 if _egl_initialises() else 1)
