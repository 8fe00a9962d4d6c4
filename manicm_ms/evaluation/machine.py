"""The machine that a measurement ran on, as plain JSON values."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import torch


def machine() -> dict[str, str | int]:
    """Return the machine's processor, usable cores, system and CUDA device, if any."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    described: dict[str, str | int] = {"cpu": _cpu_model(), "cores": cores, "system": platform.platform(terse=True)}
    if torch.cuda.is_available():
        described["cuda"] = torch.cuda.get_device_name()
    return described


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
