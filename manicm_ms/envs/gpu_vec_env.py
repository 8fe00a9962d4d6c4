"""`GpuVecEnv`: all rows in one process, one batch on an accelerator."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.envs.requests import Seeds
from manicm_ms.envs.simulator import EnvEntry, SimulatorConfig
from manicm_ms.envs.vector import Info, Obs, VecEnv
from manicm_ms.spec import ChunkSpec, EnvSpec


class GpuVecEnv(VecEnv):
    """All rows in this process, simulated and rendered together on an accelerator."""

    backend = "gpu"

    def __init__(
        self, entry: EnvEntry, spec: EnvSpec, num_envs: int, config: SimulatorConfig, chunk: ChunkSpec | None
    ) -> None:
        super().__init__(entry, spec, num_envs, config, chunk)
        self._rows = ActionChunk.from_spec(entry.build(spec, config), chunk)
        self.device = self._rows.simulator.device
        self._history: Obs = {}

    def reset(self, *, seed: Seeds = None, options: dict[str, Any] | None = None) -> tuple[Obs, Info]:
        """See `VecEnv.reset`."""
        mask, seeds = self._begin(seed, options)
        rows = mask.nonzero()[0]
        where = torch.as_tensor(rows, device=self.device)
        self._history, _ = self._rows.reset(where, [seeds[k] for k in rows])
        self._every_row_started = True
        return self._unchunk(self._history), self._with_errors(self._rows.info())

    def step(self, actions: ArrayLike | Tensor) -> tuple[Obs, Tensor, Tensor, Tensor, Info]:
        """See `VecEnv.step`."""
        self._require_started("a step")
        checked = self._check_actions(actions)
        self._history, reward, info = self._rows.step(checked if self.chunk else checked[:, None])
        flags = self._rows.terminated.clone(), self._rows.truncated.clone()
        return self._unchunk(self._history), reward, *flags, self._with_errors(info)

    def render_video_frames(self) -> Tensor:
        """See `VecEnv.render_video_frames`."""
        self._require_video()
        return self._rows.simulator.render_video_frames()

    def close_extras(self, **kwargs: Any) -> None:
        """Free renderer and physics."""
        self._rows.simulator.close()

    def _unchunk(self, history: Obs) -> Obs:
        # A copy: the next history is made of this one, whatever its reader writes into it.
        return {key: (values if self.chunk else values[:, 0]).clone() for key, values in history.items()}

    def _with_errors(self, info: dict[str, Tensor]) -> Info:
        return {**info, "error": list(self._rows.errors)}
