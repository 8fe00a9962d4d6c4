"""Where an environment is simulated: on the CPU in worker processes, or together on a GPU; which of them runs here."""

from __future__ import annotations

import os

import torch

from manicm_ms.envs.simulator import EnvEntry
from manicm_ms.errors import BackendError
from manicm_ms.machine import sapien_gpu

BACKENDS = ("auto", "cpu", "gpu")


def resolve_backend(backend: str, entry: EnvEntry | None = None) -> str:
    """Return "cpu" or "gpu" for one of `BACKENDS`; raise BackendError where it cannot run here.

    An environment (`entry`) that only has the cpu backend gets it under "auto".
    """
    if backend not in BACKENDS:
        raise BackendError(f"unknown backend {backend!r}: choose from {', '.join(BACKENDS)}")
    if entry is not None and "gpu" not in entry.backends:
        if backend == "gpu":
            raise BackendError(f"{entry.spec.env_id} has no gpu backend, its physics run on the CPU: use backend='cpu'")
        return "cpu"
    missing = _gpu_obstacle()
    if backend == "gpu" and missing:
        raise BackendError(f"backend 'gpu' cannot run here: {missing}; use backend 'cpu'")
    if backend == "auto":
        return "cpu" if missing else "gpu"
    return backend


def _gpu_obstacle() -> str | None:
    """Return why ManiSkill cannot simulate on a GPU here, or None where it can. Downloads nothing."""
    if not torch.cuda.is_available():
        return "torch finds no CUDA device"
    library = sapien_gpu.physx_gpu_library()
    if not library.is_file():
        return f"SAPIEN's PhysX GPU library is not at {library}; {sapien_gpu.PHYSX_REMEDY}"
    if not sapien_gpu.cuda_can_render():
        return "SAPIEN cannot render on the CUDA device: the graphics part of its driver is missing"
    return None


def default_num_envs() -> int:
    """Return how many worker processes suit this machine: its cores."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
