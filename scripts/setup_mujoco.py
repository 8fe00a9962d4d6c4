"""Give MuJoCo an OpenGL that needs no screen: keep one that renders, else take Mesa's EGL, or OSMesa, from apt.

The first that renders is taken:

1. The system's OpenGL: nothing is installed.
2. An earlier run's choice in `.mujoco_gl/`.
3. root with apt: the packages are installed.
4. no root, with apt: they are downloaded and unpacked into `.mujoco_gl/`, which
   `manicm_ms.machine.mujoco_gl` finds; nothing outside the repository is written.

Each is tried by a real rendering. Only Adroit and Meta-World need it, so a machine that cannot have it is told so and
set up without it. Only the standard library is used.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from setup_vulkan import REPO, Apt, SetupError, os_release, preload_list, run, say, unpack, update_until_found

PRIVATE = REPO / ".mujoco_gl"
MANIFEST = "mujoco_gl.json"
WITHOUT_GL = "import os; os.environ['MUJOCO_GL'] = 'disabled'; import mujoco"
VENDOR, DRIVERS = "__EGL_VENDOR_LIBRARY_FILENAMES", "LIBGL_DRIVERS_PATH"  # where EGL looks for Mesa, and it for drivers
USERS_CHOICE = ("MUJOCO_GL", VENDOR, DRIVERS)


@dataclass(frozen=True)
class OpenGL:
    """What MUJOCO_GL calls `name`: Debian's `packages` of it, and the `libraries` that are opened by name."""

    name: str
    packages: tuple[str, ...]
    libraries: tuple[str, ...]


EGL = OpenGL(
    "egl",
    ("libegl1", "libegl-mesa0", "libgl1", "libgl1-mesa-dri"),
    ("libEGL.so.1", "libEGL_mesa.so.0", "libGL.so.1"),
)
OSMESA = OpenGL("osmesa", ("libosmesa6",), ("libOSMesa.so.8", "libOSMesa.so.6"))


def renderer(python: str, source: str) -> tuple[str, str]:
    """Return the name of what MuJoCo renders with and "", or "" and why not; `source` is as MANICM_MS_MUJOCO_GL.

    What this shell names is left out: what renders here must render in a shell that names nothing.
    """
    env = {key: value for key, value in os.environ.items() if key not in USERS_CHOICE}
    env["MANICM_MS_MUJOCO_GL"] = source
    command = [python, "-m", "manicm_ms.envs.mujoco_render"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=env, timeout=300, check=False)
    except subprocess.TimeoutExpired:
        return "", "no picture within 300 s"
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines() or ["no answer"]
    return (lines[-1], "") if done.returncode == 0 else ("", lines[-1].partition(";")[0])


# ---------------------------------------------------------------- as root


def install(packages: tuple[str, ...]) -> None:
    """Install `packages` with apt, from backports where Mesa's other parts have come from there."""
    say(f"installing {' '.join(packages)} with apt")
    try:
        Apt().install(packages)
    except SetupError:
        Apt().install(packages, "-t", f"{os_release().get('VERSION_CODENAME', '')}-backports")


def installed(python: str) -> Iterator[tuple[str, str]]:
    """Install one kind of OpenGL after the other, and yield each time what `renderer` says."""
    Apt().update()
    for opengl in (EGL, OSMESA):
        try:
            install(opengl.packages)
        except SetupError as error:
            yield "", str(error)
        else:
            yield renderer(python, "system")


# ---------------------------------------------------------------- without root


def unpacked(python: str) -> Iterator[tuple[str, str]]:
    """Unpack one kind of OpenGL after the other, keep it if it renders, and yield each time what `renderer` says."""
    say("not root: an OpenGL is unpacked into .mujoco_gl/ instead of being installed")
    fresh = PRIVATE.with_name(".mujoco_gl.new")
    for opengl in (EGL, OSMESA):
        say(f"fetching {' '.join(opengl.packages)} and what they need (about 40 to 100 MB)")
        try:
            unpack(opengl.packages, fresh, os_release().get("VERSION_CODENAME", ""), newest_mesa)
            write_manifest(python, fresh, opengl)
            name, reason = renderer(python, str(fresh))
        except SetupError as error:
            name, reason = "", str(error)
        shutil.rmtree(PRIVATE if name else fresh, ignore_errors=True)
        if name:
            fresh.rename(PRIVATE)
        yield name, reason


def newest_mesa(apt: Apt, codename: str, sources_file: Path) -> tuple[str, ...]:
    """Select the Mesa that lavapipe comes from, as both share libraries in a process; where it is too old, any."""
    try:
        return update_until_found(apt, codename, sources_file)
    except SetupError:
        return ()


def write_manifest(python: str, folder: Path, opengl: OpenGL) -> None:
    """Write the manifest of the packages unpacked in `folder`/root, which `manicm_ms.machine.mujoco_gl` reads.

    A part that is not there was not fetched, so the system has it.
    """
    found = [sorted(folder.glob(f"root/usr/lib/**/{name}")) for name in opengl.libraries]
    libraries = [paths[0] for paths in found if paths]
    drivers = sorted(folder.glob("root/usr/lib/**/dri/swrast_dri.so"))  # Mesa before 24.2 opens it by its path
    vendors = sorted(folder.glob("root/usr/share/glvnd/egl_vendor.d/*mesa*.json"))
    environment = {VENDOR: vendors[:1], DRIVERS: [path.parent for path in drivers[:1]]}
    manifest = {
        "gl": opengl.name,
        "preload": preload_list(python, libraries, drivers, folder),
        "environment": {key: str(path.relative_to(folder)) for key, paths in environment.items() for path in paths},
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n")


# ---------------------------------------------------------------- the choice


def existing_renderer(python: str) -> tuple[str, str]:
    """Return what renders without anything being installed, and why the system's OpenGL does not, as `renderer`."""
    name, reason = renderer(python, "system")
    if name:
        shutil.rmtree(PRIVATE, ignore_errors=True)  # what an earlier run chose is not needed any more
    elif (PRIVATE / MANIFEST).is_file():
        name, _ = renderer(python, str(PRIVATE))
    return name, reason


def ensure_renderer(python: str) -> str:
    """Return the name of what MuJoCo renders with, providing it if needed; raise SetupError where nothing renders."""
    run([python, "-c", WITHOUT_GL])  # where this fails, no package of apt's will help
    say("looking for an OpenGL that MuJoCo can render with")
    name, reason = existing_renderer(python)
    if name:
        return name
    reasons = [reason]
    if shutil.which("apt-get") and shutil.which("dpkg-deb"):
        for name, reason in installed(python) if os.geteuid() == 0 else unpacked(python):
            if name:
                return name
            reasons.append(reason)
    raise SetupError(f"{reasons[-1]}: have {' '.join(EGL.packages)} installed, then repeat 'make setup FORCE=1'")


def main() -> int:
    """Run the set-up; the exit status is 0 also where there is nothing to render with."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("python", help="interpreter of the environment that mujoco and manicm_ms are installed in")
    try:
        say(f"MuJoCo renders with {ensure_renderer(parser.parse_args().python)}")
    except (SetupError, OSError) as error:
        say(f"warning: Adroit and Meta-World will not render here: {error}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
