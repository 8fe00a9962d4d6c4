"""The Vulkan driver that SAPIEN renders with: chooses it before SAPIEN is imported, and tries it.

A working system driver needs nothing from here. Where `make setup` had to choose one (Mesa's lavapipe
unpacked into `.vulkan/` without root, or the system's lavapipe beside an NVIDIA driver that cannot render),
it left a manifest `.vulkan/vulkan.json`::

    {"driver": "lvp_icd.json", "preload": ["root/usr/lib/x86_64-linux-gnu/libdrm.so.2", ...]}

(paths relative to the folder, or absolute).

`MANICM_MS_VULKAN` names another folder with such a manifest, or is `system` to ignore all of them.

Run as a module, it renders one tiny picture and prints the device's name.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

from manicm_ms.errors import RenderDeviceError
from manicm_ms.machine import private_libraries

FOLDER_VARIABLE = "MANICM_MS_VULKAN"
MANIFEST = "vulkan.json"
REMEDY = "run 'make setup FORCE=1' in the repository, or install an NVIDIA driver or Mesa's lavapipe 24.3 or newer"

_DRIVER_VARIABLE = "VK_DRIVER_FILES"
_FORMER_VARIABLE = "VK_ICD_FILENAMES"
_PROBE_PIXELS = 8
_PROBE_BOX_M = 0.1  # half size of the box that is looked at
_PROBE_RANGE_M = 1.0  # camera to box centre


@dataclass(frozen=True)
class Probe:
    """Outcome of a trial rendering.

    Attributes:
        works: whether SAPIEN rendered a correct picture.
        device: name of the Vulkan device, empty where it does not work.
        reason: one line saying what went wrong, empty where it works.
    """

    works: bool
    device: str = ""
    reason: str = ""


def folder() -> Path | None:
    """Return the folder whose manifest names the driver; None where the system's drivers are to be used.

    Raises RenderDeviceError where `MANICM_MS_VULKAN` names a folder without a manifest.
    """
    return private_libraries.folder(FOLDER_VARIABLE, ".vulkan", MANIFEST)


def prepare() -> None:
    """Point this process at the driver that set-up chose; call it in every process, before SAPIEN is imported.

    A driver that the user named by VK_DRIVER_FILES or VK_ICD_FILENAMES is left alone. Calling twice is fine.

    Raises RenderDeviceError where the manifest is broken or a file that it names is gone.
    """
    where = folder()
    if where is None:
        return
    driver, preload = _read_manifest(where / MANIFEST)
    chosen = os.environ.get(_DRIVER_VARIABLE) or os.environ.get(_FORMER_VARIABLE)
    if chosen and chosen != driver:
        return
    _load(preload)
    os.environ[_DRIVER_VARIABLE] = driver
    warnings.filterwarnings("ignore", message="Failed to find system libvulkan")  # SAPIEN's own does as well


def no_device(detail: str = "") -> RenderDeviceError:
    """Return the error that says that SAPIEN has nothing to render with, and what to try.

    Where the user named a driver, that is the likely cause: the variable is told with its value.
    """
    told = "no Vulkan device that SAPIEN can render with" + (f" ({detail})" if detail else "")
    named = [f"{name}={os.environ[name]}" for name in (_DRIVER_VARIABLE, _FORMER_VARIABLE) if _is_theirs(name)]
    if not named:
        return RenderDeviceError(f"{told}: {REMEDY}; 'manicm-ms doctor' tells what is there")
    gone = [p for value in named for p in value.partition("=")[2].split(os.pathsep) if p and not Path(p).exists()]
    why = f", where {gone[0]} does not exist" if gone else ""
    return RenderDeviceError(f"{told}: it was told to use {' and '.join(named)}{why}; unset it, or name another driver")


def _is_theirs(variable: str) -> bool:
    """Return whether the user set a variable that names a driver: neither set-up's driver nor SAPIEN's own."""
    value = os.environ.get(variable)
    if not value or "sapien" in Path(value).parts:
        return False
    try:
        where = folder()
        return where is None or value != _read_manifest(where / MANIFEST)[0]
    except RenderDeviceError:
        return True


def _read_manifest(path: Path) -> tuple[str, list[str]]:
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        driver, *preload = (str(path.parent / p) for p in (manifest["driver"], *manifest["preload"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RenderDeviceError(f"{path} cannot be read ({error}): {REMEDY}") from error
    missing = [p for p in (driver, *preload) if not Path(p).is_file()]
    if missing:
        raise RenderDeviceError(f"{path} names {missing[0]}, which does not exist: {REMEDY}")
    return driver, preload


def _load(libraries: list[str]) -> None:
    try:
        private_libraries.load(libraries)
    except OSError as error:
        raise RenderDeviceError(f"the private Vulkan driver does not load ({error}): {REMEDY}") from error


def probe(python: str = sys.executable, timeout_s: float = 120.0) -> Probe:
    """Render a tiny scene in a process of its own, so that a crash of the driver is survived and told."""
    try:
        done = subprocess.run([python, "-m", __name__], capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return Probe(False, reason=f"rendering did not end within {timeout_s:.0f} s")
    except OSError as error:
        return Probe(False, reason=str(error))
    if done.returncode == 0:
        return Probe(True, device=done.stdout.strip().splitlines()[-1])
    if done.returncode < 0:
        return Probe(False, reason=f"the driver crashed the process (signal {-done.returncode})")
    lines = [line for line in done.stderr.strip().splitlines() if line.strip()]
    return Probe(False, reason=lines[-1] if lines else f"exit status {done.returncode}")


def render_device() -> str:
    """Render one box with SAPIEN in this process and return the name of the Vulkan device that did it.

    Raises RenderDeviceError where there is no device or its picture is wrong.
    """
    prepare()
    import sapien

    try:
        scene = sapien.Scene()
        builder = scene.create_actor_builder()
        builder.add_box_visual(half_size=[_PROBE_BOX_M] * 3)
        builder.build_static()
        camera = scene.add_camera("probe", _PROBE_PIXELS, _PROBE_PIXELS, 1.0, 0.01, 10.0)
        camera.entity.set_pose(sapien.Pose([-_PROBE_RANGE_M, 0, 0]))
        scene.update_render()
        camera.take_picture()
        position = camera.get_picture("Position")  # (H, W, 4), OpenGL camera frame: -z looks forward
    except RuntimeError as error:
        raise no_device(str(error)) from error
    seen, true = -float(position[_PROBE_PIXELS // 2, _PROBE_PIXELS // 2, 2]), _PROBE_RANGE_M - _PROBE_BOX_M
    name = str(scene.render_system.device.name)
    if abs(seen - true) > 0.01:
        raise RenderDeviceError(f"{name} renders wrongly (a box at {true:.3f} m appears at {seen:.3f} m): {REMEDY}")
    return name


if __name__ == "__main__":
    try:
        print(render_device())
    except (RenderDeviceError, ImportError) as error:
        print(error, file=sys.stderr)
        sys.exit(1)
