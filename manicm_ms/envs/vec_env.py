"""`make_vec`: every benchmark behind one Gymnasium vector interface, in torch tensors or NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, overload

from manicm_ms.envs.backends import resolve_backend
from manicm_ms.envs.cpu_vec_env import CpuVecEnv
from manicm_ms.envs.gpu_vec_env import GpuVecEnv
from manicm_ms.envs.numpy_arrays import NumpyVecEnv
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.envs.vector import VecEnv
from manicm_ms.errors import ConfigError
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.camera_files import read_camera
from manicm_ms.sensing.realism import Realism, resolve_realism
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, VOXEL_SIZE, ChunkSpec

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
    voxel_size: int = ...,
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
    voxel_size: int = ...,
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
    voxel_size: int = VOXEL_SIZE,
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
        voxel_size: cells along each side of a voxel grid.
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
        voxel_size=voxel_size,
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
