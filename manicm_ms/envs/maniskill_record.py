"""Stored actions, played again in a task's plain ManiSkill environment and recorded by ManiSkill's `RecordEpisode`."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import torch

from manicm_ms.envs.maniskill import gym_id  # first: it chooses the Vulkan driver
from manicm_ms.envs.simulator import ENVS

from mani_skill.utils.wrappers import RecordEpisode  # isort: skip


class Played(NamedTuple):
    """What playing an episode again showed.

    Attributes:
        success: whether the task was solved at its end.
        agent_pos: (L, D) float32, proprioception before each action.
    """

    success: bool
    agent_pos: np.ndarray


class ManiSkillRecorder:
    """Writes `NAME.h5` and `NAME.json`, as ManiSkill's tools read them.

    Each episode is reset with its seed into a fresh scene, as when it was collected on a CPU
    (docs/decisions/0010); the file tells ManiSkill's replay to do the same. On a CPU, in one process.

    Args:
        env_id: a task on ManiSkill, for example "ur3e/slide-block".
        folder: where to write.
        name: of both files.
        source_type: ManiSkill's word for where the actions come from, for example "motionplanning".
        source_desc: the same in a sentence.

    Raises UnknownNameError for the id, ConfigError where the task is not one of ManiSkill.
    """

    def __init__(self, env_id: str, folder: Path, name: str, *, source_type: str, source_desc: str) -> None:
        plain = gymnasium.make(
            gym_id(env_id),
            num_envs=1,
            obs_mode="none",
            reward_mode="sparse",
            control_mode=ENVS.get(env_id).spec.action.control_mode,
            sim_backend="physx_cpu",
        )
        self._env = RecordEpisode(
            plain,
            str(folder),
            trajectory_name=name,
            save_video=False,
            save_on_reset=False,
            source_type=source_type,
            source_desc=source_desc,
        )

    def play(self, seed: int, actions: np.ndarray) -> Played:
        """Play actions (L, Da) in [-1, 1] from the seed's start; `keep` writes the episode."""
        self._env.reset(seed=seed, options={"reconfigure": True})
        task: Any = self._env.unwrapped
        seen, success = [], False
        for action in torch.from_numpy(actions):
            seen.append(task.agent_pos()[0].cpu().numpy())
            *_, info = self._env.step(action[None])
            success = bool(info["success"].item())
        return Played(success, np.stack(seen))

    def keep(self) -> None:
        """Write the episode that was played last; one that is not kept is dropped by the next `play`."""
        self._env.flush_trajectory()

    def close(self) -> None:
        """Finish the files and free the simulator."""
        self._env.close()

    def __enter__(self) -> ManiSkillRecorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
