"""`make_vec` and `VecEnv`: every benchmark behind one Gymnasium vector interface, in torch tensors."""

from __future__ import annotations

import functools
import multiprocessing
import os
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv
from gymnasium.vector.async_vector_env import AsyncState
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike
from torch import Tensor

from manicm_ms import sapien_gpu
from manicm_ms.camera_model import CameraModel, read_camera
from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.envs.simulator import ENVS, EnvEntry, SimulatorConfig
from manicm_ms.envs.worker import FACTS, RowEnv, action_space, observation_space
from manicm_ms.errors import ActionError, BackendError, ConfigError, ManicmError
from manicm_ms.realism import Realism, resolve_realism
from manicm_ms.types import AGENT_POS, POINT_CLOUD, ChunkSpec, EnvSpec

BACKENDS = ("auto", "cpu", "gpu")
_START_METHOD = "forkserver"  # fork hangs once a Vulkan or GL context exists in the parent
_REAP_S = 0.2  # how long a worker's end may take to show after its pipe broke
_DEAD_WORKER = (EOFError, BrokenPipeError, ConnectionResetError)

Obs = dict[str, Tensor]
Info = dict[str, Any]


class VecEnv(VectorEnv[Obs, Tensor, Tensor]):
    """N rows of one environment. Every array is a torch tensor on `device` with a leading axis N.

    Frames of clouds and poses are what `env_spec.obs.frame` says. Rows never reset by themselves (autoreset mode
    DISABLED): episode k is the one with seed k. A row that has terminated or was truncated is frozen: stepping it
    repeats its last observation and flags with reward 0 until it is reset.

    With a `ChunkSpec`, observations carry a history axis, (N, To, ...), and actions a chunk axis, (N, Ta, Da).

    `info` holds (N,) tensors: "success" and the task's other facts now; "success_once" since the reset;
    "elapsed_steps", control steps played; "clipped", action entries that had to be clipped to [-1, 1]; and "error", a
    list of N reasons, None where the row did not crash.

    Attributes:
        env_spec: what is fixed about the environment.
        chunk: history and chunk lengths, or None.
        device: where the tensors live.
        backend: "cpu" or "gpu".
    """

    backend: str
    device: torch.device

    def __init__(self, spec: EnvSpec, num_envs: int, obs: tuple[str, ...], chunk: ChunkSpec | None) -> None:
        self.env_spec, self.num_envs, self.chunk = spec, num_envs, chunk
        self.metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_modes": ["rgb_array"]}
        self.single_observation_space = observation_space(spec, obs, chunk.n_obs_steps if chunk else None)
        self.single_action_space = action_space(spec, chunk.n_action_steps if chunk else None)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._every_row_started = False

    @abstractmethod
    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, Info]:
        """Start new episodes.

        Args:
            seed: N seeds, one a row; or one, from which the rows count up; or None for random ones.
            options: {"reset_mask": (N,) bool} resets only those rows and leaves the others as they are; the first
                reset must cover every row.

        Returns:
            observations (N, ...) and info of all rows.

        Raises:
            ConfigError: a mask or seeds that do not fit.
            BackendError: as `step`.
        """

    @abstractmethod
    def step(self, actions: ArrayLike | Tensor) -> tuple[Obs, Tensor, Tensor, Tensor, Info]:
        """Play actions (N, Da), or chunks (N, Ta, Da), normalised to [-1, 1].

        Returns:
            observations (N, ...), reward (N,) float32 (summed over a chunk), terminated (N,) bool,
            truncated (N,) bool, info.

        Raises:
            ActionError: wrong shape, NaN or infinity. Entries out of range are clipped and counted.
            BackendError: a worker process failed or died, now or earlier; close the environment and make it anew.
        """

    @abstractmethod
    def render_video_frames(self) -> Tensor:
        """Return what the wide camera sees, (N, H, W, 3) uint8; needs `make_vec(..., video=True)`."""

    def render(self) -> tuple[np.ndarray, ...]:
        """Return the N video frames as arrays (Gymnasium's form of `render_video_frames`)."""
        return tuple(self.render_video_frames().cpu().numpy())

    def _check_actions(self, actions: ArrayLike | Tensor) -> Tensor:
        try:
            tensor = torch.as_tensor(actions, dtype=torch.float32, device=self.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ActionError(f"actions are not an array of numbers: {error}") from error
        expected = self.action_space.shape
        if tuple(tensor.shape) != expected:
            raise ActionError(
                f"actions have shape {tuple(tensor.shape)}, {self.env_spec.env_id} with num_envs={self.num_envs} "
                f"takes {expected}"
            )
        bad = ~torch.isfinite(tensor).flatten(1).all(dim=1)
        if bad.any():
            raise ActionError(f"actions of rows {bad.nonzero().flatten().tolist()} hold NaN or infinity")
        return tensor

    def _reset_mask(self, options: dict[str, Any] | None) -> np.ndarray:
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return np.ones(self.num_envs, dtype=bool)
        mask = np.asarray(torch.as_tensor(mask).cpu())
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise ConfigError(f"reset_mask must be ({self.num_envs},) bool, got {mask.shape} {mask.dtype}")
        if not self._every_row_started and not mask.all():
            raise ConfigError("the first reset must cover every row: leave reset_mask out, or make it all True")
        return mask

    def _seeds(self, seed: int | Sequence[int] | None) -> list[int]:
        if seed is None:
            return [int(s) for s in np.random.default_rng().integers(2**31, size=self.num_envs)]
        if isinstance(seed, (int, np.integer)):
            return [int(seed) + k for k in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ConfigError(f"{len(seed)} seeds for num_envs={self.num_envs}: give one a row")
        return [int(s) for s in seed]


class CpuVecEnv(VecEnv):
    """Rows in worker processes, one simulator each, observations through shared memory."""

    backend = "cpu"

    def __init__(
        self, entry: EnvEntry, spec: EnvSpec, num_envs: int, config: SimulatorConfig, chunk: ChunkSpec | None
    ) -> None:
        super().__init__(spec, num_envs, config.obs, chunk)
        self.device = torch.device("cpu")
        multiprocessing.get_context(_START_METHOD).set_forkserver_preload([__name__, entry.module, *entry.preload])
        make = functools.partial(RowEnv, spec.env_id, entry.module, config, chunk)
        self._workers = AsyncVectorEnv(
            [make] * num_envs, context=_START_METHOD, autoreset_mode=AutoresetMode.DISABLED, copy=False
        )
        self._facts: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        self._video = config.video
        self._failure: str | None = None  # why no call can succeed any more

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, Info]:
        """See `VecEnv.reset`."""
        mask, seeds = self._reset_mask(options), self._seeds(seed)
        self._require_sound()
        if mask.any():
            obs, info = self._guarded(self._workers.reset, seed=seeds, options={"reset_mask": mask})
        else:
            obs, info = self._workers.observations, {}
        self._every_row_started = True
        return self._tensors(obs), self._merged(info, mask)

    def step(self, actions: ArrayLike | Tensor) -> tuple[Obs, Tensor, Tensor, Tensor, Info]:
        """See `VecEnv.step`."""
        checked = self._check_actions(actions).numpy()
        obs, reward, terminated, truncated, info = self._guarded(self._workers.step, checked)
        flags = torch.from_numpy(terminated.copy()), torch.from_numpy(truncated.copy())
        everyone = np.ones(self.num_envs, dtype=bool)
        return self._tensors(obs), torch.from_numpy(reward.astype(np.float32)), *flags, self._merged(info, everyone)

    def render_video_frames(self) -> Tensor:
        """See `VecEnv.render_video_frames`."""
        _require_video(self._video)
        return torch.from_numpy(np.stack(self._guarded(self._workers.call, "render")))

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the worker processes."""
        broken = self._failure is not None or not all(process.is_alive() for process in self._workers.processes)
        if broken:
            self._workers._state = AsyncState.DEFAULT  # else Gymnasium waits for an answer that never comes
        self._workers.close(terminate=broken)

    def _guarded(self, call: Any, *args: Any, **kwargs: Any) -> Any:
        self._require_sound()
        try:
            with _quiet_gymnasium():
                return call(*args, **kwargs)
        except _DEAD_WORKER as error:
            self._failure = f"{self._dead_workers()} of {self.env_spec.env_id} died"
            raise self._backend_error() from error
        except Exception as error:  # a worker that raised has ended
            self._failure = f"a worker process of {self.env_spec.env_id} failed ({_last_line(error)})"
            if isinstance(error, ManicmError):
                raise
            raise self._backend_error() from error

    def _require_sound(self) -> None:
        if self._failure is not None:
            raise self._backend_error()

    def _backend_error(self) -> BackendError:
        return BackendError(
            f"{self._failure}: close this environment and make it anew; "
            "'manicm-ms doctor' tells whether the machine can simulate and render"
        )

    def _dead_workers(self) -> str:
        for process in self._workers.processes:
            process.join(_REAP_S)
        codes = {k: process.exitcode for k, process in enumerate(self._workers.processes) if not process.is_alive()}
        return f"worker processes {list(codes)} (exit codes {list(codes.values())})"

    def _tensors(self, obs: dict[str, np.ndarray]) -> Obs:
        return {key: torch.from_numpy(values.copy()) for key, values in obs.items()}  # the workers' memory is reused

    def _merged(self, info: dict[str, Any], rows: np.ndarray) -> Info:
        for row in rows.nonzero()[0]:
            (self._facts[row],) = info[FACTS][row]
        kinds = {name: type(value) for facts in self._facts for name, value in facts.items() if name != "error"}
        # A row that was not stepped since its reset does not know the task's facts yet: they are False or 0.
        merged: Info = {n: torch.tensor([f.get(n, kind()) for f in self._facts]) for n, kind in kinds.items()}
        merged["error"] = [facts["error"] for facts in self._facts]
        return merged


class GpuVecEnv(VecEnv):
    """All rows in this process, simulated and rendered together on an accelerator."""

    backend = "gpu"

    def __init__(
        self, entry: EnvEntry, spec: EnvSpec, num_envs: int, config: SimulatorConfig, chunk: ChunkSpec | None
    ) -> None:
        super().__init__(spec, num_envs, config.obs, chunk)
        self._rows = ActionChunk.from_spec(entry.build(spec, config), chunk)
        self.device = self._rows.simulator.device
        self._video = config.video
        self._history: Obs = {}

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Obs, Info]:
        """See `VecEnv.reset`."""
        seeds = self._seeds(seed)
        rows = self._reset_mask(options).nonzero()[0]
        if len(rows):
            where = torch.as_tensor(rows, device=self.device)
            self._history, _ = self._rows.reset(where, [seeds[k] for k in rows])
            self._every_row_started = True
        return self._unchunk(self._history), self._with_errors(self._rows.info())

    def step(self, actions: ArrayLike | Tensor) -> tuple[Obs, Tensor, Tensor, Tensor, Info]:
        """See `VecEnv.step`."""
        checked = self._check_actions(actions)
        self._history, reward, info = self._rows.step(checked if self.chunk else checked[:, None])
        flags = self._rows.terminated.clone(), self._rows.truncated.clone()
        return self._unchunk(self._history), reward, *flags, self._with_errors(info)

    def render_video_frames(self) -> Tensor:
        """See `VecEnv.render_video_frames`."""
        _require_video(self._video)
        return self._rows.simulator.render_video_frames()

    def close_extras(self, **kwargs: Any) -> None:
        """Free renderer and physics."""
        self._rows.simulator.close()

    def _unchunk(self, history: Obs) -> Obs:
        return {key: values if self.chunk else values[:, 0] for key, values in history.items()}

    def _with_errors(self, info: dict[str, Tensor]) -> Info:
        return {**info, "error": list(self._rows.errors)}


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
) -> VecEnv:
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

    Raises:
        UnknownNameError, ConfigError, CameraError, BackendError, RenderDeviceError.
    """
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
    vec_env = CpuVecEnv if backend == "cpu" else GpuVecEnv
    return vec_env(entry, config.specialise(entry.spec), num_envs, config, chunk)


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


@contextmanager
def _quiet_gymnasium() -> Iterator[None]:
    """Keep Gymnasium from logging a worker's traceback: the exception that it raises here says the same."""
    level = gymnasium.logger.min_level
    gymnasium.logger.min_level = gymnasium.logger.ERROR + 1
    try:
        yield
    finally:
        gymnasium.logger.min_level = level


def _last_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()  # of a traceback, the last line says what happened
    return lines[-1].strip() if lines else type(error).__name__


def _require_video(video: bool) -> None:
    if not video:
        raise ConfigError("this environment was made without video: use make_vec(..., video=True)")


def default_num_envs() -> int:
    """Return how many worker processes suit this machine: its cores."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


__all__ = ["BACKENDS", "CpuVecEnv", "GpuVecEnv", "VecEnv", "default_num_envs", "make_vec", "resolve_backend"]
