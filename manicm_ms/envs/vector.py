"""`VecEnv`: N rows of one environment behind Gymnasium's vector interface, in torch tensors."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from manicm_ms.envs.requests import Seeds, SeedStreams, reset_mask
from manicm_ms.envs.simulator import EnvEntry, SimulatorConfig
from manicm_ms.envs.worker import action_space, observation_space
from manicm_ms.errors import ActionError, ConfigError
from manicm_ms.spec import ChunkSpec, EnvSpec

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
        spec: Gymnasium's word for it: id and time limit.
        chunk: history and chunk lengths, or None.
        device: where the tensors live.
        backend: "cpu" or "gpu".
        autoreset_mode: DISABLED, also in `metadata`.
        render_mode: "rgb_array" where the environment was made with video, else None.
    """

    backend: str
    device: torch.device
    autoreset_mode = AutoresetMode.DISABLED

    def __init__(
        self, entry: EnvEntry, spec: EnvSpec, num_envs: int, config: SimulatorConfig, chunk: ChunkSpec | None
    ) -> None:
        self.env_spec, self.num_envs, self.chunk = spec, num_envs, chunk
        self.spec = GymnasiumSpec(spec.env_id, max_episode_steps=spec.max_episode_steps)
        decisions_hz = spec.action.control_hz / (chunk.n_action_steps if chunk else 1)
        self.metadata = {
            "autoreset_mode": self.autoreset_mode,
            "render_modes": ["rgb_array"],
            "render_fps": max(1, round(decisions_hz)),
        }
        self.render_mode = "rgb_array" if config.video else None
        self.single_observation_space = observation_space(spec, config.obs, chunk.n_obs_steps if chunk else None)
        self.single_action_space = action_space(spec, chunk.n_action_steps if chunk else None)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._every_row_started = False
        self._seeds = SeedStreams(num_envs, entry.seed_limit, spec.env_id)

    @abstractmethod
    def reset(self, *, seed: Seeds = None, options: dict[str, Any] | None = None) -> tuple[Obs, Info]:
        """Start new episodes.

        Args:
            seed: N seeds, one a row; or one, from which the rows count up. A row without a seed (None) draws one from
                its own stream, which the last seed that it was given decides; so `reset(seed=5)` fixes later resets.
            options: {"reset_mask": (N,) bool} resets only those rows and leaves the others as they are; the first
                reset must cover every row.

        Returns:
            observations (N, ...) and info of all rows. A row whose simulator raised has crashed: it is terminated, and
            "error" says why.

        Raises:
            ConfigError: options, a mask or seeds that do not fit; the environment stays as it was.
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
            ConfigError: no reset yet.
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

    def _begin(self, seed: Seeds, options: dict[str, Any] | None) -> tuple[NDArray[np.bool_], list[int]]:
        """Return which rows a reset starts anew, (N,) bool, and N seeds, those of other rows without meaning."""
        self._require_open()
        mask = reset_mask(options, self.num_envs)
        if not self._every_row_started and not mask.all():
            raise ConfigError("the first reset must cover every row: leave reset_mask out, or make it all True")
        return mask, self._seeds.next(seed, mask)

    def _require_started(self, what: str) -> None:
        self._require_open()
        if not self._every_row_started:
            raise ConfigError(f"{what} before the first reset: call reset() first")

    def _require_open(self) -> None:
        if self.closed:
            raise ConfigError(f"this environment ({self.env_spec.env_id}) is closed: make it anew")

    def _require_video(self) -> None:
        if self.render_mode is None:
            raise ConfigError("this environment was made without video: use make_vec(..., video=True)")
        self._require_started("a video frame")
