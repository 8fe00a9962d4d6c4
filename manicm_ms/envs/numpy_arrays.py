"""A `VecEnv` that speaks NumPy: what Gymnasium's vector wrappers and most learners expect at the border."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import VectorWrapper
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from manicm_ms.envs.requests import Seeds, reset_mask
from manicm_ms.envs.vector import VecEnv

Arrays = dict[str, NDArray[Any]]


class NumpyVecEnv(VectorWrapper[Arrays, Any, Any, Any, Any]):
    """A `VecEnv` whose observations, rewards, flags and info are NumPy arrays with a leading axis N.

    Actions may be NumPy arrays or tensors. `info["error"]` is an array of objects, None where a row did not crash.

    An end is announced once: `terminated` or `truncated` is True in the step that ended the row, and False while the
    ended row is stepped on, so that wrappers that count episodes count each of them once. `info["ended"]`, (N,) bool,
    stays True until the row is reset.

    Everything else (`env_spec`, `chunk`, `backend`, `render_video_frames`, ...) is the wrapped environment's.

    Args:
        env: the environment in torch tensors, also reached as `env.unwrapped`.
    """

    env: VecEnv

    def __init__(self, env: VecEnv) -> None:
        super().__init__(env)
        self._ended = np.zeros(env.num_envs, dtype=bool)

    def reset(self, *, seed: Seeds = None, options: dict[str, Any] | None = None) -> tuple[Arrays, dict[str, Any]]:
        """See `VecEnv.reset`."""
        obs, info = self.env.reset(seed=seed, options=options)
        self._ended &= ~reset_mask(options, self.num_envs)
        crashed = np.array([error is not None for error in info["error"]])
        # A row that crashed at its reset has no step yet: the next one announces its end.
        return _arrays(obs), {**_facts(info), "ended": self._ended | crashed}

    def step(self, actions: ArrayLike | Tensor) -> tuple[Arrays, NDArray[Any], NDArray[Any], NDArray[Any], dict]:
        """See `VecEnv.step`."""
        obs, reward, terminated, truncated, info = self.env.step(actions)
        fresh = ~self._ended
        flags = _array(terminated) & fresh, _array(truncated) & fresh
        self._ended = _array(terminated) | _array(truncated)
        return _arrays(obs), _array(reward), *flags, {**_facts(info), "ended": self._ended.copy()}

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not there yet: asking it for itself would never end
            raise AttributeError(name)
        return getattr(self.env, name)


def _facts(info: dict[str, Any]) -> dict[str, Any]:
    errors = np.empty(len(info["error"]), dtype=object)
    errors[:] = info["error"]
    return {name: errors if name == "error" else _array(values) for name, values in info.items()}


def _arrays(values: dict[str, Tensor]) -> Arrays:
    return {name: _array(tensor) for name, tensor in values.items()}


def _array(values: Tensor) -> NDArray[Any]:
    return values.numpy(force=True)
