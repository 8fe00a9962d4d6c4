"""Our vector environments as Stable-Baselines3 takes them (extra `rl`), and what ended episodes count for a learner."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv as StableVecEnv
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from torch import Tensor

from manicm_ms.envs.vector import VecEnv
from manicm_ms.envs.worker import action_space, observation_space
from manicm_ms.errors import ConfigError
from manicm_ms.seeds import require_seed

SUCCESS = "is_success"
"""Name of a row's success in the info of its last step, as Stable-Baselines3 spells it."""


class StableBaselinesEnv(StableVecEnv):
    """A `VecEnv` as Stable-Baselines3 expects one: NumPy arrays, and rows that begin a new episode when one ends.

    Episode k since the last `seed(s)` has the seed s + k, rows counted from 0 where several begin together, so that a
    run is fixed by its first seed and meets each seed once. The info of a row's last step holds `terminal_observation`
    (the frame that the episode ended with; what `step` returns is the next episode's first), `TimeLimit.truncated`
    (bootstrap from that frame: the time was up, the task was not over) and `is_success`.

    An environment with a `ChunkSpec` plays each action for the chunk's Ta control steps, so that a learner decides at a
    lower rate than the controller runs; rewards are summed over them, and of the history the last frame is returned.

    Args:
        env: the environment, in torch tensors or NumPy arrays. An observation of one key becomes a plain array, of
            several a dictionary.
        seed: of the first episode.

    Raises:
        ConfigError: a negative seed.
    """

    def __init__(self, env: VecEnv, seed: int = 0) -> None:
        require_seed(seed)
        self.env = env = env.unwrapped  # also of an environment with NumPy arrays
        self._next_seed = seed
        self._keys: tuple[str, ...] = tuple(env.single_observation_space)  # type: ignore[arg-type]  # a Dict space
        self._held = env.chunk.n_action_steps if env.chunk else 1
        spaces_of_rows = observation_space(env.env_spec, self._keys, None)
        self._actions = np.zeros((env.num_envs, env.env_spec.action.dim), np.float32)
        self.render_mode = env.render_mode  # Stable-Baselines3 asks for it before it sets it
        space = spaces_of_rows[self._keys[0]] if len(self._keys) == 1 else spaces_of_rows
        super().__init__(env.num_envs, space, action_space(env.env_spec, None))

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Let the next episode have `seed` (a random one where it is None); return the seeds that the rows get."""
        if seed is None:
            seed = int(np.random.default_rng().integers(2**31))
        require_seed(seed)
        self._next_seed = seed
        return [seed + row for row in range(self.num_envs)]

    def reset(self) -> VecEnvObs:
        """Begin an episode in every row; return its first observations."""
        return self._start(np.ones(self.num_envs, dtype=bool))

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Take actions (N, Da) in [-1, 1], to be played by `step_wait`."""
        self._actions = np.asarray(actions, dtype=np.float32)

    def step_wait(self) -> VecEnvStepReturn:
        """Play the actions; return observations, rewards (N,), dones (N,) and N dictionaries."""
        chunk = np.repeat(self._actions[:, None], self._held, axis=1)  # (N, Ta, Da)
        obs, reward, terminated, truncated, info = self.env.step(chunk if self.env.chunk else self._actions)
        ended = _array(terminated | truncated)
        infos = [self._row_info(k, obs, truncated, info) if ended[k] else {} for k in range(self.num_envs)]
        after = self._start(ended) if ended.any() else self._arrays(obs)
        return after, _array(reward), ended, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of this adapter, else of its environment, once a row: the rows share one object."""
        owner = self if hasattr(self, attr_name) else self.env
        return [getattr(owner, attr_name)] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return what the wide camera sees, (H, W, 3) uint8 a row; needs `make_vec(..., video=True)`."""
        return list(self.env.render())

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refuse: rows have no attributes of their own."""
        raise ConfigError(f"cannot set {attr_name!r} of single rows: make the environment anew with what is wanted")

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Refuse: rows have no methods of their own."""
        raise ConfigError(f"cannot call {method_name!r} on single rows: call it on the vector environment")

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return False for each row: none is wrapped."""
        return [False] * len(list(self._get_indices(indices)))

    def _start(self, rows: NDArray[np.bool_]) -> VecEnvObs:
        seeds = np.zeros(self.num_envs, dtype=np.int64)  # those of other rows are ignored
        count = int(rows.sum())
        seeds[rows] = self._next_seed + np.arange(count)
        self._next_seed += count
        obs, _ = self.env.reset(seed=seeds.tolist(), options={"reset_mask": rows})
        return self._arrays(obs)

    def _row_info(self, row: int, obs: dict[str, Tensor], truncated: Tensor, info: dict[str, Any]) -> dict[str, Any]:
        frames = self._arrays(obs)
        last = {key: values[row] for key, values in frames.items()} if isinstance(frames, dict) else frames[row]
        facts = {"terminal_observation": last, "TimeLimit.truncated": bool(truncated[row])}
        return facts | {SUCCESS: bool(info["success_once"][row]), "error": info["error"][row]}

    def _arrays(self, obs: dict[str, Tensor]) -> Any:
        arrays = {key: _array(values[:, -1] if self.env.chunk else values) for key, values in obs.items()}
        return arrays[self._keys[0]] if len(self._keys) == 1 else arrays


class AbsorbingSuccess(VecEnvWrapper):
    """Pays for a success that ends the episode what staying in it for ever would have brought.

    Dense rewards are positive and highest in success. Where success ends an episode and nothing follows, a learner
    that maximises their sum does best by staying just short of it. So success counts as an absorbing state that goes
    on to earn the largest reward r: gamma r + gamma^2 r + ... = gamma r / (1 - gamma) is added to its first reward.
    Failures, crashes among them, earn nothing from then on: with rewards of 0 and more, no state is worse.

    Args:
        venv: gives `is_success` in the info of the last step.
        gamma: the learner's discount for one of its decisions, in [0, 1).
        largest: r, the largest reward of one decision: for normalised rewards the control steps that it lasts.

    Raises:
        ConfigError: a discount outside [0, 1).
    """

    def __init__(self, venv: StableVecEnv, gamma: float, largest: float = 1.0) -> None:
        if not 0 <= gamma < 1:
            raise ConfigError(f"gamma must lie in [0, 1), got {gamma}: with 1 a success would be worth infinitely much")
        super().__init__(venv)
        self._for_ever = gamma * largest / (1 - gamma)

    def reset(self) -> VecEnvObs:
        """See `StableBaselinesEnv.reset`."""
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        """See `StableBaselinesEnv.step_wait`."""
        obs, rewards, dones, infos = self.venv.step_wait()
        ends = zip(dones, infos, strict=True)
        absorbed = np.array([done and info[SUCCESS] and not info["TimeLimit.truncated"] for done, info in ends])
        return obs, (rewards + self._for_ever * absorbed).astype(np.float32), dones, infos


def normalized_return(rewards: Tensor, steps: Tensor, success: Tensor, max_episode_steps: int) -> Tensor:
    """Return the mean reward over the whole time limit, in [0, 1], of episodes that success or failure may cut short.

    After a success the remaining steps count 1, the largest normalised reward; after a failure they count 0. Without
    this an expert that is done early would seem worse than an idler.

    Args:
        rewards: (N,) sums of normalised rewards.
        steps: (N,) control steps played.
        success: (N,) bool.
        max_episode_steps: the time limit, control steps.
    """
    return (rewards + (max_episode_steps - steps) * success) / max_episode_steps


def _array(values: Tensor) -> NDArray[Any]:
    return values.numpy(force=True)


__all__ = ["SUCCESS", "AbsorbingSuccess", "StableBaselinesEnv", "normalized_return"]
