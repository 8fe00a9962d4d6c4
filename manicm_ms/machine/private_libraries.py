"""Libraries that set-up unpacked inside the checkout where it could not install them: finds and loads them.

Such a folder lies beside the package (`.vulkan/`, `.mujoco_gl/`) and holds a manifest that names what to load. An
environment variable of each kind names another folder, or is `system` to ignore all of them.
"""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

from manicm_ms.errors import RenderDeviceError

USE_SYSTEM = "system"


def folder(variable: str, name: str, manifest: str) -> Path | None:
    """Return the folder to use: what `variable` names, else `name` beside the package; None for the system's own.

    Raises RenderDeviceError where `variable` names a folder without a `manifest`.
    """
    named = os.environ.get(variable)
    if named == USE_SYSTEM:
        return None
    if named:
        if not (Path(named) / manifest).is_file():
            raise RenderDeviceError(
                f"{variable}={named} holds no {manifest}: unset it or name a folder that 'make setup' made"
            )
        return Path(named).absolute()
    beside = Path(__file__).resolve().parents[2] / name
    return beside if (beside / manifest).is_file() else None


def load(libraries: list[str]) -> None:
    """Load libraries by path, each after those it needs; one whose name the process has already stays as it is.

    The dynamic linker takes a library that is loaded under the same soname before it searches, so this does what
    LD_LIBRARY_PATH would have done, had it been set before the process started. For the same reason a second library
    of that name (OpenGL and Vulkan share many) would serve nobody. The file's name must be the soname.

    Raises OSError where one does not load.
    """
    for path in libraries:  # ctypes never unloads
        try:
            ctypes.CDLL(os.path.basename(path), mode=os.RTLD_NOLOAD)
        except OSError:  # not in this process yet
            ctypes.CDLL(path)
