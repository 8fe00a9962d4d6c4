"""One row as a Gymnasium environment: what a worker process of the CPU backend runs."""

from __future__ import annotations

import gc
import importlib
import sys
import traceback
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.errors import ManicmError
from manicm_ms.spec import ANY, ChunkSpec, EnvSpec


def observation_space(spec: EnvSpec, obs: tuple[str, ...], n_obs_steps: int | None) -> spaces.Dict:
    """Return the space of one row's observation; `n_obs_steps` adds the history axis, None leaves it out."""
    history = () if n_obs_steps is None else (n_obs_steps,)
    boxes: dict[str, spaces.Space[Any]] = {}
    for key in obs:
        field = spec.observation(key)
        shape = tuple(spec.obs.num_points if n == ANY else n for n in field.shape)
        low, high = (0, 255) if field.dtype == "uint8" else (-np.inf, np.inf)
        boxes[key] = spaces.Box(low, high, history + shape, np.dtype(field.dtype).type)
    return spaces.Dict(boxes)


def action_space(spec: EnvSpec, n_action_steps: int | None) -> spaces.Box:
    """Return the space of one row's action; `n_action_steps` adds the chunk axis, None leaves it out."""
    chunk = () if n_action_steps is None else (n_action_steps,)
    return spaces.Box(-1.0, 1.0, (*chunk, spec.action.dim), np.float32)


def package_folders(task_module: str) -> tuple[str, ...]:
    """Return the folders of the package that a task's module lies in, as this process knows them.

    Workers are forked from a server that started with the environment of that moment: folders that became known later,
    by MANICM_MS_TASKS or otherwise, it does not know.
    """
    package = sys.modules.get(task_module.rpartition(".")[0])
    return tuple(getattr(package, "__path__", ()))


FACTS = "facts"
"""The one key of a worker's info: a tuple that holds a dictionary of plain values."""


class RowEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """One row of a registered environment.

    Everything runs in torch's inference mode: a control step is some hundred tiny tensor operations, and bookkeeping
    for gradients would cost a third of it. What leaves the process are NumPy arrays.

    The simulator is built at the first reset, in the process that will use it: gymnasium's AsyncVectorEnv also makes
    one environment in the parent, only to read its spaces, and a renderer there would cost memory and seconds.

    Args:
        env_id: its id.
        task_module: module that registers it.
        config: of the simulator.
        chunk: To, Tp, Ta; None for plain steps.
        folders: further folders of the module's package, those that the parent process knows; see `package_folders`.
    """

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (Gymnasium declares it without ClassVar)
    render_mode = "rgb_array"

    def __init__(
        self,
        env_id: str,
        task_module: str,
        config: SimulatorConfig,
        chunk: ChunkSpec | None,
        folders: tuple[str, ...] = (),
    ) -> None:
        self._env_id, self._task_module, self._config, self._chunk = env_id, task_module, config, chunk
        if folders:
            path = importlib.import_module(task_module.rpartition(".")[0]).__path__
            path.extend(folder for folder in folders if folder not in path)
        importlib.import_module(task_module)  # registers the id in this process, and only this one
        self.env_spec = config.specialise(ENVS.get_registered(env_id).spec)
        self.observation_space: spaces.Space[Any] = observation_space(
            self.env_spec, config.obs, chunk.n_obs_steps if chunk else None
        )
        self.action_space = action_space(self.env_spec, chunk.n_action_steps if chunk else None)
        self._rows: ActionChunk | None = None

    @torch.inference_mode()
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start the episode that belongs to `seed` (drawn at random where it is None)."""
        super().reset(seed=seed)
        self._rows = self._rows or self._build()
        seed = int(self.np_random.integers(2**31)) if seed is None else seed
        history, info = self._rows.reset(torch.zeros(1, dtype=torch.int64), [seed])
        return self._unbatch(history), self._plain(info)

    def _build(self) -> ActionChunk:
        torch.set_num_threads(1)  # workers share the cores; more threads a worker fight the software renderer
        gc.freeze()  # ManiSkill collects garbage with every new scene: 0.2 s each if it had to look at all modules too
        try:
            simulator = ENVS.get_registered(self._env_id).build(self.env_spec, self._config)
        except ManicmError:
            raise
        except Exception as error:  # the parent sees the message alone: let it say where
            raise RuntimeError(f"building {self._env_id} failed in its worker:\n{traceback.format_exc()}") from error
        return ActionChunk.from_spec(simulator, self._chunk)

    @torch.inference_mode()
    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Play one action, or a chunk of them."""
        assert self._rows is not None, "reset before the first step"
        actions = torch.as_tensor(action, dtype=torch.float32)
        history, reward, info = self._rows.step(actions[None] if self._chunk else actions[None, None])
        ended = bool(self._rows.terminated[0]), bool(self._rows.truncated[0])
        return self._unbatch(history), float(reward[0]), *ended, self._plain(info)

    @torch.inference_mode()
    def render(self) -> np.ndarray:
        """Return what the wide camera sees, (H, W, 3) uint8."""
        assert self._rows is not None, "reset before the first frame"
        return self._rows.simulator.render_video_frames()[0].cpu().numpy()

    def close(self) -> None:
        """Free the simulator."""
        if self._rows is not None:
            self._rows.simulator.close()
            self._rows = None

    def _unbatch(self, history: dict[str, torch.Tensor]) -> dict[str, np.ndarray]:
        return {key: (values[0] if self._chunk else values[0, 0]).numpy() for key, values in history.items()}

    def _plain(self, info: dict[str, torch.Tensor]) -> dict[str, Any]:
        """Return the facts as one object: Gymnasium would build two arrays for each name at every step."""
        assert self._rows is not None
        facts = {name: values[0].item() for name, values in info.items()}
        return {FACTS: (facts | {"error": self._rows.errors[0]},)}  # in a tuple, for dictionaries are taken apart
