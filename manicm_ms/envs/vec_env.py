"""`make_vec`: every benchmark behind one Gymnasium vector interface, in torch tensors or NumPy arrays."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, overload

import torch

from manicm_ms.envs.cpu_vec_env import CpuVecEnv
from manicm_ms.envs.gpu_vec_env import GpuVecEnv
from manicm_ms.envs.numpy_arrays import NumpyVecEnv
from manicm_ms.envs.simulator import ENVS, EnvEntry, SimulatorConfig
from manicm_ms.envs.vector import Info, Obs, VecEnv
from manicm_ms.errors import BackendError, ConfigError
from manicm_ms.machine import sapien_gpu
from manicm_ms.sensing.camera_model import CameraModel, read_camera
from manicm_ms.sensing.realism import Realism, resolve_realism
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, ChunkSpec

BACKENDS = ("auto", "cpu", "gpu")
ARRAYS = ("torch", "numpy")


@overload
def make_vec(
    env_id: str,
    num_envs: int = ...,
    backend: str = ...,
    obs: Sequence[str] = ...,
    chunk: ChunkSpec | None = ...,
    *,
    num_points: int = ...,
    colors: bool = ...,
    image_size: tuple[int, int] = ...,
    video: bool = ...,
    reward_mode: str = ...,
    realism: str | Realism = ...,
    camera: CameraModel | Path | str | None = ...,
    obs_preset: str = ...,
    arrays: Literal["torch"] = ...,
) -> VecEnv: ...


@overload
def make_vec(
    env_id: str,
    num_envs: int = ...,
    backend: str = ...,
    obs: Sequence[str] = ...,
    chunk: ChunkSpec | None = ...,
    *,
    num_points: int = ...,
    colors: bool = ...,
    image_size: tuple[int, int] = ...,
    video: bool = ...,
    reward_mode: str = ...,
    realism: str | Realism = ...,
    camera: CameraModel | Path | str | None = ...,
    obs_preset: str = ...,
    arrays: Literal["numpy"],
) -> NumpyVecEnv: ...


def make_vec(
    env_id: str,
    num_envs: int = 1,
    backend: str = "auto",
    obs: Sequence[str] = (POINT_CLOUD, AGENT_POS),
    chunk: ChunkSpec | None = None,
    *,
    num_points: int = 512,
    colors: bool = False,
    image_size: tuple[int, int] = (84, 84),
    video: bool = False,
    reward_mode: str = "sparse",
    realism: str | Realism = "clean",
    camera: CameraModel | Path | str | None = None,
    obs_preset: str = "manicm_ms",
    arrays: str = "torch",
) -> VecEnv | NumpyVecEnv:
    """Make N parallel rows of a registered environment.

    Args:
        env_id: for example "ur3e/slide-block"; `manicm-ms list envs` shows all.
        num_envs: N.
        backend: "gpu" (one batch on an accelerator), "cpu" (worker processes), or "auto": gpu where CUDA, a GPU that
            SAPIEN can render on and its PhysX GPU library are there, else cpu; `VecEnv.backend` says which it became.
        obs: observation keys; only what is asked is rendered.
        chunk: give it to exchange histories and action chunks, as policies do; None for frames and actions.
        num_points: points of a cloud.
        colors: append rgb to the points, (N, P, 6).
        image_size: (H, W) of the camera, pixels.
        video: make `render_video_frames` available; building takes some seconds longer.
        reward_mode: "sparse", "normalized_dense", "dense" or "none".
        realism: "clean", "d435i", "d435i+dr", or ranges of your own: what is drawn for each episode from its seed.
        camera: the cell's depth camera, or its YAML file as `manicm-ms calibrate` writes it; None takes the ideal one
            where realism is clean, else the D435i that the package ships.
        obs_preset: "manicm_ms", or "dp3" for clouds as the public DP3 wrapper makes them (Adroit and Meta-World).
        arrays: "torch" tensors, as policies take them, or "numpy" arrays, as Gymnasium's wrappers and most learners do.

    Raises:
        UnknownNameError, ConfigError, CameraError, BackendError, RenderDeviceError.
    """
    if arrays not in ARRAYS:
        raise ConfigError(f"unknown arrays {arrays!r}: choose from {', '.join(ARRAYS)}")
    entry = ENVS.get(env_id)
    backend = resolve_backend(backend, entry)
    config = SimulatorConfig(
        num_rows=1 if backend == "cpu" else num_envs,
        obs=tuple(obs),
        num_points=num_points,
        colors=colors,
        image_size=image_size,
        video=video,
        reward_mode=reward_mode,
        device="cpu" if backend == "cpu" else "cuda",
        realism=resolve_realism(realism),
        camera=read_camera(Path(camera)) if isinstance(camera, (str, Path)) else camera,
        obs_preset=obs_preset,
    )
    entry.require(config)
    if num_envs < 1:
        raise ConfigError(f"num_envs must be at least 1, got {num_envs}")
    kind = CpuVecEnv if backend == "cpu" else GpuVecEnv
    env = kind(entry, config.specialise(entry.spec), num_envs, config, chunk)
    return env if arrays == "torch" else NumpyVecEnv(env)


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


__all__ = [
    "ARRAYS", "BACKENDS", "CpuVecEnv", "GpuVecEnv", "Info", "NumpyVecEnv", "Obs", "VecEnv", "default_num_envs",
    "make_vec", "resolve_backend",
]  # fmt: skip
