"""What this machine offers to simulation, rendering and learning, and a remedy for each trouble found.

Each check is a function that returns one `Finding`; `diagnose` runs them all, `doctor` prints them. Checks look and
try; they install nothing, fetch nothing and change nothing.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Literal

from manicm_ms.machine import mujoco_gl, sapien_gpu, vulkan

Status = Literal["ok", "warn", "fail"]

NEEDED_FREE_GB = 2.0  # a demo run: data, two checkpoints with optimizer state, report with videos
_PYTHONS = ((3, 11), (3, 13))  # first and last minor version that all simulators have wheels for
_NEEDED = (
    "numpy", "torch", "gymnasium", "sapien", "mani_skill", "diffusers", "lightning-fabric", "zarr", "trimesh",
    "safetensors", "scipy", "statsmodels", "matplotlib", "imageio-ffmpeg", "jinja2", "rich", "tyro", "tensorboard",
)  # fmt: skip
_REINSTALL = "run 'make setup FORCE=1'"


@dataclass(frozen=True)
class Finding:
    """Outcome of one check.

    Attributes:
        name: what was looked at.
        status: "ok"; "warn" where something optional is missing or slower than it could be; "fail" where something
            needed is missing.
        found: what was found, one line.
        remedy: what to do about it, empty where nothing is to be done.
    """

    name: str
    status: Status
    found: str
    remedy: str = ""


def check_python() -> Finding:
    """Look at the interpreter's version."""
    found = f"{platform.python_version()} ({sys.executable})"
    if _PYTHONS[0] <= sys.version_info[:2] <= _PYTHONS[1]:
        return Finding("Python", "ok", found)
    return Finding("Python", "fail", found, "make .venv with 3.11 to 3.13: make clean && make setup PYTHON=python3.12")


def check_packages() -> Finding:
    """Look for the packages that every command needs, and name the versions that matter most."""
    versions = {name: _version(name) for name in _NEEDED}
    missing = [name for name, version in versions.items() if version is None]
    if missing:
        return Finding("packages", "fail", f"missing: {', '.join(missing)}", _REINSTALL)
    shown = ("manicm_ms", "mani_skill", "sapien", "torch", "gymnasium", "numpy", "diffusers", "zarr")
    return Finding("packages", "ok", ", ".join(f"{name} {_version(name)}" for name in shown))


def check_vulkan() -> Finding:
    """Render a tiny scene with SAPIEN in a process of its own."""
    outcome = vulkan.probe()
    if not outcome.works:
        reason, _, remedy = outcome.reason.partition("; ")
        theirs = remedy if remedy.startswith("unset") else ""
        return Finding("Vulkan device", "fail", reason, theirs or f"{_REINSTALL}, which installs Mesa's lavapipe")
    software = "llvmpipe" in outcome.device
    if software and _nvidia_driver():
        return Finding(
            "Vulkan device",
            "warn",
            f"{outcome.device}: software, though there is an NVIDIA GPU",
            "install the graphics part of its driver (libGLX_nvidia; in a container the 'graphics' capability)",
        )
    return Finding("Vulkan device", "ok", outcome.device + (" (software rendering)" if software else ""))


def check_mujoco() -> Finding:
    """Render a tiny scene with MuJoCo, without a screen, in a process of its own."""
    name = "MuJoCo OpenGL"
    code = "from manicm_ms.envs.mujoco_task import require_suite as r; r('metaworld'); r('gymnasium-robotics')"
    asked = _python(code)
    if asked.returncode:
        reason = asked.stderr.strip().splitlines()[-1].rpartition("Error: ")[2]
        return Finding(name, "warn", f"Adroit and Meta-World cannot be played: {reason}", _REINSTALL)
    outcome = mujoco_gl.probe()
    if not outcome.works:
        reason, _, remedy = outcome.reason.partition("; ")
        return Finding(name, "fail", reason, remedy or mujoco_gl.REMEDY)
    return Finding(name, "ok", f"mujoco {_version('mujoco')}, {outcome.device}")


def check_cuda() -> Finding:
    """Look for a GPU that torch can compute on."""
    try:
        import torch
    except (ImportError, OSError) as error:
        return Finding("CUDA", "fail", f"torch does not import: {error}", _REINSTALL)
    if torch.cuda.is_available():
        return Finding("CUDA", "ok", f"{torch.cuda.get_device_name(0)}, torch built for CUDA {torch.version.cuda}")
    if _nvidia_driver():
        built = f"CUDA {torch.version.cuda}" if torch.version.cuda else "the CPU alone"
        return Finding(
            "CUDA",
            "warn",
            f"an NVIDIA driver is here, but torch {torch.__version__}, built for {built}, cannot use it",
            "install a CUDA build of the same torch version that this driver supports into .venv",
        )
    return Finding("CUDA", "ok", "no NVIDIA driver: simulation and learning run on the CPU")


def check_physx_gpu() -> Finding:
    """Look for the PhysX library that GPU simulation needs; SAPIEN fetches it at first use, this does not."""
    try:
        library = physx_gpu_library()
    except ValueError as error:
        return Finding("PhysX GPU library", "fail", str(error), _REINSTALL)
    if library.is_file():
        return Finding("PhysX GPU library", "ok", str(library))
    if not _nvidia_driver():
        return Finding("PhysX GPU library", "ok", "absent and not needed: there is no NVIDIA GPU")
    found = f"not at {library}: GPU simulation needs it"
    return Finding("PhysX GPU library", "warn", found, sapien_gpu.PHYSX_REMEDY)


def physx_gpu_library() -> Path:
    """Return where SAPIEN looks for the PhysX GPU library, asked in a process of its own.

    Raises ValueError where SAPIEN does not import.
    """
    asked = _python(f"import runpy; runpy.run_module({sapien_gpu.__name__!r}, run_name='__main__')")
    if asked.returncode:
        lines = asked.stderr.strip().splitlines() or [f"exit status {asked.returncode}"]
        raise ValueError(f"sapien does not import: {lines[-1]}")
    return Path(asked.stdout.strip().splitlines()[-1])


def check_opencv() -> Finding:
    """Say which of the two OpenCV wheels, which write into one folder, was installed last."""
    spec = importlib.util.find_spec("cv2")
    if spec is None or spec.origin is None:
        return Finding("OpenCV", "fail", "cv2 is not installed", _REINSTALL)
    names = [name for name in ("opencv-python", "opencv-python-headless") if _version(name)]
    version_file = Path(spec.origin).parent / "version.py"
    headless = version_file.is_file() and re.search(r"^headless = True", version_file.read_text(), re.MULTILINE)
    winner = "opencv-python-headless" if headless else "opencv-python"
    found = f"{' and '.join(names)} installed, {winner} is the one in cv2/"
    if not headless:
        remedy = f"{_REINSTALL}, or: python -m pip install --force-reinstall --no-deps opencv-python-headless"
        return Finding("OpenCV", "warn", found, remedy)
    if _python("import cv2").returncode:
        return Finding("OpenCV", "fail", f"{found}, but it does not import", _REINSTALL)
    return Finding("OpenCV", "ok", found)


def check_mplib() -> Finding:
    """Say whether mplib, a requirement of mani_skill, would crash this process."""
    version, numpy = _version("mplib"), _version("numpy")
    if version is None:
        return Finding("mplib", "ok", "not installed and not needed: the experts plan without it")
    if numpy is not None and int(numpy.split(".")[0]) >= 2 and _release(version) < (0, 2):
        return Finding(
            "mplib",
            "warn",
            f"{version} crashes the process under numpy {numpy}; this package never imports it",
            "nothing to do; ManiSkill's own motion-planning examples need an environment with numpy 1",
        )
    return Finding("mplib", "ok", f"{version} with numpy {numpy}")


def check_disk(folder: Path | None = None) -> Finding:
    """Look at the free space where runs are written (default: the working folder)."""
    where = folder or Path.cwd()
    free_gb = shutil.disk_usage(where).free / 1e9
    found = f"{free_gb:.1f} GB free in {where}"
    if free_gb < NEEDED_FREE_GB:
        return Finding("free disk", "fail", found, f"free some space: a run needs about {NEEDED_FREE_GB:.0f} GB")
    return Finding("free disk", "ok", found)


def check_cpu() -> Finding:
    """Count the CPU cores that this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Finding("CPU", "ok", f"{cores} cores: about as many environments as cores run at once on the cpu backend")


CHECKS: tuple[Callable[[], Finding], ...] = (
    check_python, check_packages, check_vulkan, check_mujoco, check_cuda, check_physx_gpu, check_opencv,
    check_mplib, check_cpu, check_disk,
)  # fmt: skip


def diagnose() -> list[Finding]:
    """Run every check and return what each found, in a fixed order."""
    return [check() for check in CHECKS]


def doctor() -> int:
    """Print what was found as a table; return 1 where something needed is missing, else 0."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Column, Table

    styles = {"ok": "green", "warn": "yellow", "fail": "red"}
    table = Table("check", "status", Column("found", overflow="fold"))
    findings = diagnose()
    for finding in findings:
        table.add_row(finding.name, f"[{styles[finding.status]}]{finding.status}[/]", escape(finding.found))
    console = Console()
    console.print(table)
    for finding in findings:
        if finding.remedy:  # below the table and unwrapped, so that a command can be copied
            console.print(f"{finding.name}: {escape(finding.remedy)}", soft_wrap=True)
    return int(any(finding.status == "fail" for finding in findings))


def _version(distribution: str) -> str | None:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def _nvidia_driver() -> bool:
    return Path("/dev/nvidiactl").exists() or shutil.which("nvidia-smi") is not None


def _python(code: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a process of its own: what it imports may crash, and stays out of this one."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
