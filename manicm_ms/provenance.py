"""Where a result came from: the versions of what made it."""

from __future__ import annotations

import platform
from importlib import metadata

_PACKAGES = ("manicm_ms", "torch", "numpy", "gymnasium", "mani_skill", "sapien", "mujoco", "diffusers", "zarr")


def package_versions() -> dict[str, str]:
    """Return name -> version of Python and of the packages that can change a result, those installed."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions
