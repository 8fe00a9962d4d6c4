"""A small real task for tests: push a point to a goal in the plane; every fifth seed's goal is out of reach."""

import os
import time

import numpy as np
import torch

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.simulator import ENVS, EnvEntry, Simulator, StepResult
from manicm_ms.errors import UnknownNameError
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, STATE, ActionSpec, EnvSpec, ObsSpec

ENV_ID = "toy/point-mass"
MAX_STEPS = 40
FIRST_BROKEN_SEED = 900_000  # the simulator fails at its reset
SPEC = EnvSpec(
    env_id=ENV_ID,
    obs=ObsSpec(512, 3, 2, "world"),
    action=ActionSpec(("vx (m/step)", "vy (m/step)"), "velocity", 20.0),
    max_episode_steps=MAX_STEPS,
    agent_pos_names=("x (m)", "y (m)"),
    state_layout={"position": (0, 2), "goal": (2, 4)},
)


def unsolvable(seed):
    return seed % 5 == 3


class PointMass(Simulator):
    def __init__(self, spec, config):
        self.spec, self.device, self.num_rows = spec, torch.device("cpu"), config.num_rows
        self.position, self.goal = torch.zeros(self.num_rows, 2), torch.zeros(self.num_rows, 2)
        self.shape = torch.zeros(self.num_rows, spec.obs.num_points, spec.obs.point_channels)

    def reset(self, rows, seeds):
        if max(seeds) >= FIRST_BROKEN_SEED:
            raise RuntimeError("no device to render with")
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            rng = np.random.default_rng(seed)
            self.position[row] = torch.tensor(rng.uniform(-1, 1, 2), dtype=torch.float32)
            self.goal[row] = torch.tensor(rng.uniform(-1, 1, 2), dtype=torch.float32) + 100.0 * unsolvable(seed)
            cloud = rng.uniform(0, 0.1, (self.spec.obs.num_points, self.spec.obs.point_channels))
            self.shape[row] = torch.tensor(cloud, dtype=torch.float32)

    def step(self, actions):
        time.sleep(float(os.environ.get("TOY_STEP_SECONDS", "0")))
        self.position = self.position + 0.1 * actions
        success = (self.position - self.goal).norm(dim=1) < 0.05
        return StepResult(success.float(), success, {"success": success})

    def observe(self):
        cloud = self.shape.clone()
        cloud[..., :2] += self.position[:, None]
        return {
            POINT_CLOUD: cloud,
            AGENT_POS: self.position.clone(),
            STATE: torch.cat([self.position, self.goal], dim=1),
        }

    def render_video_frames(self):
        return torch.zeros(self.num_rows, 8, 8, 3, dtype=torch.uint8)

    def close(self):
        pass


class StraightLine:
    name = "straight-line"
    styles = ("direct", "wobbly")

    def __init__(self, spec, num_envs, device, style):
        if style not in (None, *self.styles):
            raise UnknownNameError("style", style, self.styles)
        self.style = style or self.styles[0]
        self.noise = [None] * num_envs

    def reset(self, state, seeds, mask):
        for i in mask.nonzero().flatten().tolist():
            self.noise[i] = np.random.default_rng(seeds[i])

    def act(self, state):
        action = ((state[:, 2:] - state[:, :2]) / 0.1).clamp(-1, 1)
        if self.style == "wobbly":
            action = action + torch.tensor(np.stack([r.normal(0, 0.1, 2) for r in self.noise]), dtype=torch.float32)
        return action


ENVS.add(ENV_ID, EnvEntry(SPEC, PointMass, __name__))
EXPERTS.add(ENV_ID, StraightLine)
