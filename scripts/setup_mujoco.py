"""Give MuJoCo an OpenGL that needs no screen: keep one that renders, else install Mesa's EGL, or OSMesa, with apt.

Only Adroit and Meta-World need it, so a machine that cannot have it is told so and set up without it. Installing needs
root; without it, what to ask for is said. Each is tried by a real rendering. Only the standard library is used.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys

from setup_vulkan import Apt, SetupError, os_release, run, say

EGL = ("libegl1", "libegl-mesa0", "libgl1", "libgl1-mesa-dri")
OSMESA = ("libosmesa6",)
WITHOUT_GL = "import os; os.environ['MUJOCO_GL'] = 'disabled'; import mujoco"


def renderer(python: str) -> tuple[str, str]:
    """Return the name of what MuJoCo renders with and "", or "" and why it does not render."""
    env = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}  # what a plain shell will have
    command = [python, "-m", "manicm_ms.envs.mujoco_render"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=env, timeout=300, check=False)
    except subprocess.TimeoutExpired:
        return "", "no picture within 300 s"
    lines = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines() or ["no answer"]
    return (lines[-1], "") if done.returncode == 0 else ("", lines[-1])


def install(packages: tuple[str, ...]) -> None:
    """Install `packages` with apt, from backports where Mesa's other parts have come from there."""
    say(f"installing {' '.join(packages)} with apt")
    command = ["apt-get", "install", "-y", "--no-install-recommends"]
    try:
        run([*command, *packages])
    except SetupError:
        run([*command, "-t", f"{os_release().get('VERSION_CODENAME', '')}-backports", *packages])


def ensure_renderer(python: str) -> str:
    """Return the name of what MuJoCo renders with, installing it if needed; raise SetupError where nothing renders."""
    run([python, "-c", WITHOUT_GL])  # where this fails, no package of apt's will help
    say("looking for an OpenGL that MuJoCo can render with")
    name, reason = renderer(python)
    if name:
        return name
    if os.geteuid() != 0 or not shutil.which("apt-get"):
        raise SetupError(
            f"{reason.partition(';')[0]}: have {' '.join(EGL)} installed, then repeat 'make setup FORCE=1'"
        )
    Apt().update()
    for packages in (EGL, OSMESA):
        try:
            install(packages)
        except SetupError as error:
            reason = str(error)
            continue
        name, reason = renderer(python)
        if name:
            return name
    raise SetupError(reason)


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
