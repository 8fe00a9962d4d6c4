"""A small real vector env and a small real policy: a point that is to be brought to the origin."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import torch

from manicm_ms.errors import ActionError, BackendError
from manicm_ms.policies.policy import Policy, starting_noise
from manicm_ms.spec import ActionSpec, ChunkSpec, EnvSpec, ObsSpec

SPEC = EnvSpec(
    env_id="toy/point-mass",
    obs=ObsSpec(num_points=4, point_channels=3, agent_pos_dim=2, frame="world"),
    action=ActionSpec(names=("vx [m/step / 0.1]", "vy [m/step / 0.1]"), control_mode="velocity", control_hz=20.0),
    max_episode_steps=20,
    agent_pos_names=("x [m]", "y [m]"),
)
CHUNK = ChunkSpec(n_obs_steps=2, horizon=4, n_action_steps=3)
REACH = 0.05  # metres
DT = 0.1  # metres per step and unit of action


class PointMass(gym.vector.VectorEnv):
    """N points, each started at random by its seed; success is to come within REACH of the origin.

    `crash_at` maps a seed to the control step at which its simulation fails; `dies` holds seeds whose
    presence kills the whole env at its first step; `spec` lets a test ask for another success rule; with `goes_on`
    success ends nothing, as in Meta-World.
    """

    def __init__(self, num_envs, chunk=CHUNK, *, spec=SPEC, crash_at=None, dies=(), goes_on=False):
        self.goes_on = goes_on
        self.num_envs, self.chunk, self.env_spec, self.device = num_envs, chunk, spec, torch.device("cpu")
        self.crash_at, self.dies = crash_at or {}, set(dies)
        self.seeds = [None] * num_envs
        self.pos = np.zeros((num_envs, 2))
        self.last = np.zeros((num_envs, 2))
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self.success = np.zeros(num_envs, dtype=bool)
        self.success_once = np.zeros(num_envs, dtype=bool)
        self.finished = np.ones(num_envs, dtype=bool)
        self.error = [None] * num_envs
        self.played = []  # every seed that was reset, in order
        self.dead = False

    def reset(self, *, seed=None, options=None):
        self._require_alive()
        for i in np.flatnonzero(options["reset_mask"]):
            self.seeds[i] = seed[i]
            self.played.append(seed[i])
            self.pos[i] = self.last[i] = np.random.default_rng(seed[i]).uniform(-1, 1, 2)
            self.steps[i], self.error[i] = 0, None
            self.success[i] = self.success_once[i] = self.finished[i] = False
        return self._obs(), self._info()

    def step(self, actions):
        self._require_alive()
        if self.dies & set(self.seeds):
            self.dead = True
            raise BackendError("worker 0 died")
        actions = np.asarray(actions, dtype=np.float64)
        actions = actions if self.chunk else actions[:, None]
        if not np.isfinite(actions).all():
            raise ActionError("an action is not finite")
        reward = np.zeros(self.num_envs, dtype=np.float32)
        for i in range(self.num_envs):
            for action in actions[i]:
                if not self.finished[i]:
                    reward[i] += self._step_row(i, np.clip(action, -1, 1))
        terminated = (self.success & (not self.goes_on)) | np.array([e is not None for e in self.error])
        truncated = self.steps >= self.env_spec.max_episode_steps
        return (
            self._obs(),
            torch.from_numpy(reward),
            torch.from_numpy(terminated),
            torch.from_numpy(truncated),
            self._info(),
        )

    def _step_row(self, i, action):
        self.last[i] = self.pos[i]
        self.pos[i] = self.pos[i] + DT * action
        self.steps[i] += 1
        self.success[i] = np.linalg.norm(self.pos[i]) < REACH
        self.success_once[i] |= self.success[i]
        if self.crash_at.get(self.seeds[i]) == self.steps[i]:
            self.error[i], self.success[i] = "solver diverged", False
        solved = self.success[i] and not self.goes_on
        self.finished[i] = solved or self.error[i] or self.steps[i] >= self.env_spec.max_episode_steps
        return -np.linalg.norm(self.pos[i])

    def render_video_frames(self):
        frames = np.full((self.num_envs, 64, 64, 3), 235, np.uint8)
        for i, (x, y) in enumerate(np.clip((self.pos + 1) * 32, 2, 61).astype(int)):
            frames[i, y - 2 : y + 3, x - 2 : x + 3] = (200, 60, 30)
        return frames

    def close(self, **kwargs):
        self.dead = True

    def _require_alive(self):
        if self.dead:
            raise BackendError("the env is closed")

    def _obs(self):
        pos = np.stack([self.last, self.pos], axis=1).astype(np.float32)  # (N, To, D)
        cloud = np.zeros((self.num_envs, 2, 4, 3), np.float32)
        cloud[..., :2] = pos[:, :, None]
        if not self.chunk:
            pos, cloud = pos[:, -1], cloud[:, -1]
        # The privileged state is for the record of the start: nothing of a policy may depend on it.
        obs = {"agent_pos": pos, "point_cloud": cloud, "state": pos.copy()}
        return {key: torch.from_numpy(values) for key, values in obs.items()}

    def _info(self):
        return {
            "success": torch.from_numpy(self.success.copy()),
            "success_once": torch.from_numpy(self.success_once.copy()),
            "elapsed_steps": torch.from_numpy(self.steps.copy()),
            "clipped": torch.zeros(self.num_envs, dtype=torch.int64),
            "error": list(self.error),
        }


class Proportional(Policy):
    """Walks towards the origin; `gain` 0 never arrives, NaN where x exceeds `nan_above`."""

    def __init__(self, gain=3.0, noise_scale=0.3, nan_above=2.0, spec=SPEC, chunk=CHUNK):
        super().__init__()
        self.name, self.spec, self.chunk = "proportional", spec, chunk
        self.gain = torch.nn.Parameter(torch.tensor(gain))
        self.noise_scale, self.nan_above = noise_scale, nan_above
        self.batches = []

    @property
    def nfe(self):
        return 1

    def act(self, obs, *, generator=None, noise=None):
        position = obs["agent_pos"][:, -1]  # (B, 2)
        self.batches.append(len(position))
        first = starting_noise(self, len(position), generator, noise)[0]  # (B, Tp, Da)
        actions = -self.gain * position[:, None] + self.noise_scale * first[:, self.chunk.executed]
        actions = actions.clamp(-1, 1)
        return torch.where(position[:, :1, None] > self.nan_above, torch.nan, actions)
