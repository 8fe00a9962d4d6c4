"""Modules under their former names, for one release: a user's imports keep working, and a line says the present name.

Remove this file, and the line of `__init__` that calls it, with the release after 0.2.
"""

from __future__ import annotations

import importlib
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

_PACKAGE = "manicm_ms."
MOVED: Mapping[str, str] = {
    "calibration": "sensing.calibration",
    "camera_doubts": "sensing.camera_doubts",
    "camera_model": "sensing.camera_model",
    "devices": "machine.devices",
    "doctor": "machine.doctor",
    "mujoco_gl": "machine.mujoco_gl",
    "point_cloud": "sensing.point_cloud",
    "private_libraries": "machine.private_libraries",
    "realism": "sensing.realism",
    "sapien_gpu": "machine.sapien_gpu",
    "stereo_depth": "sensing.stereo_depth",
    "types": "spec",
    "vulkan": "machine.vulkan",
    "written_numbers": "sensing.written_numbers",
}
"""Former name -> present name, both within the package; a package stands for its modules too."""


def present_name(name: str) -> str | None:
    """Return today's full name of a module that has moved, or None for any other name."""
    if not name.startswith(_PACKAGE):
        return None
    parts = name.removeprefix(_PACKAGE).split(".")
    for length in range(len(parts), 0, -1):
        if (moved := MOVED.get(".".join(parts[:length]))) is not None:
            return _PACKAGE + ".".join([moved, *parts[length:]])
    return None


class _MovedModules(MetaPathFinder, Loader):
    """Gives the module itself under its former name, so that its classes stay one and the same."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(fullname, self) if present_name(fullname) is not None else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        present = present_name(spec.name)
        assert present is not None
        module = importlib.import_module(present)
        warnings.warn(f"{spec.name} is {present} now; the former name goes with the next release", FutureWarning, 2)
        spec.loader_state = module.__spec__  # the import machinery overwrites it with this one
        return module

    def exec_module(self, module: ModuleType) -> None:
        former = module.__spec__
        assert former is not None
        module.__spec__ = former.loader_state
        sys.modules[former.name] = module


def install() -> None:
    """Find modules under their former names; before others do, who would load a moved package's modules twice."""
    if not any(isinstance(finder, _MovedModules) for finder in sys.meta_path):
        sys.meta_path.insert(0, _MovedModules())
