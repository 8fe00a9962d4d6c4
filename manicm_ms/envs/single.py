"""One row of any registered environment as a plain Gymnasium environment, in this process: `gymnasium.make(id)`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.envs.requests import SeedStreams
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.envs.worker import action_space, observation_space
from manicm_ms.errors import ActionError, BackendError, ConfigError
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.camera_files import read_camera
from manicm_ms.sensing.realism import Realism, resolve_realism
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, VOXEL_SIZE

_ROW = torch.zeros(1, dtype=torch.int64)
_EVERY_ROW = np.ones(1, dtype=bool)


class SingleEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """One row, simulated and rendered on the CPU of this process.

    Observations are a dictionary of arrays, actions (Da,) in [-1, 1]. `reset(seed=k)` starts the episode that belongs
    to k everywhere in this package; without a seed one is drawn as by a row of `make_vec`. After its end an episode
    stays as it is until the reset. For speed use `make_vec`.

    Args:
        env_id: for example "adroit/door".
        render_mode: "rgb_array" makes `render` available (building takes some seconds longer).

    The other arguments are those of `make_vec`.

    Raises:
        UnknownNameError, ConfigError, CameraError, RenderDeviceError.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium declares it without ClassVar)

    def __init__(
        self,
        env_id: str,
        obs: Sequence[str] = (POINT_CLOUD, AGENT_POS),
        *,
        render_mode: str | None = None,
        num_points: int = 512,
        colors: bool = False,
        image_size: tuple[int, int] = (84, 84),
        voxel_size: int = VOXEL_SIZE,
        reward_mode: str = "sparse",
        realism: str | Realism = "clean",
        camera: CameraModel | Path | str | None = None,
        obs_preset: str = "manicm_ms",
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"{env_id} has no render_mode {render_mode!r}: use 'rgb_array' or None")
        entry = ENVS.get(env_id)
        config = SimulatorConfig(
            obs=tuple(obs),
            num_points=num_points,
            colors=colors,
            image_size=image_size,
            voxel_size=voxel_size,
            video=render_mode is not None,
            reward_mode=reward_mode,
            realism=resolve_realism(realism),
            camera=read_camera(Path(camera)) if isinstance(camera, (str, Path)) else camera,
            obs_preset=obs_preset,
        )
        entry.require(config)
        self.render_mode = render_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(entry.spec.action.control_hz)}
        self.env_spec = config.specialise(entry.spec)
        self.observation_space: gymnasium.Space[Any] = observation_space(self.env_spec, config.obs, None)
        self.action_space = action_space(self.env_spec, None)
        self._seeds = SeedStreams(1, entry.seed_limit, env_id)
        self._rows = ActionChunk(entry.build(self.env_spec, config))

    @torch.inference_mode()
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start the episode that belongs to `seed`; there are no options."""
        if options:
            raise ConfigError(f"{self.env_spec.env_id} has no reset options, got {sorted(options)}")
        (episode,) = self._seeds.next([seed], _EVERY_ROW)
        super().reset(seed=None if seed is None else episode)
        history, info = self._rows.reset(_ROW, [episode])
        return self._frame(history), self._info(info)

    @torch.inference_mode()
    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Play an action (Da,); entries out of [-1, 1] are clipped and counted in info["clipped"].

        Raises:
            ActionError: wrong shape, NaN or infinity.
            BackendError: the episode crashed; a reset starts another.
        """
        actions = torch.as_tensor(action, dtype=torch.float32)
        if actions.shape != self.action_space.shape or not torch.isfinite(actions).all():
            raise ActionError(
                f"{self.env_spec.env_id} takes actions of shape {self.action_space.shape} without NaN and infinity, "
                f"got shape {tuple(actions.shape)}: {action}"
            )
        history, reward, info = self._rows.step(actions[None, None])
        if self._rows.errors[0] is not None:
            raise BackendError(
                f"{self.env_spec.env_id} crashed: {self._rows.errors[0]}; a reset starts another episode"
            )
        ended = bool(self._rows.terminated[0]), bool(self._rows.truncated[0])
        return self._frame(history), float(reward[0]), *ended, self._info(info)

    @torch.inference_mode()
    def render(self) -> np.ndarray | None:
        """Return what the wide camera sees, (H, W, 3) uint8; None without a render mode."""
        return None if self.render_mode is None else self._rows.simulator.render_video_frames()[0].cpu().numpy()

    def close(self) -> None:
        """Free renderer and physics."""
        self._rows.simulator.close()

    def _frame(self, history: dict[str, torch.Tensor]) -> dict[str, np.ndarray]:
        spaces: Any = self.observation_space
        return {key: values[0, 0].numpy().astype(spaces[key].dtype) for key, values in history.items()}

    def _info(self, info: dict[str, torch.Tensor]) -> dict[str, Any]:
        """Return the facts as plain values."""
        return {name: values[0].item() for name, values in info.items()}
