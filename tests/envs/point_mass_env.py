"""A small real simulator for tests, and variants of it that each fail one check; workers import this module."""

import torch

from manicm_ms.envs.simulator import ENVS, EnvEntry, Simulator, SimulatorConfig, StepResult
from manicm_ms.errors import RenderDeviceError
from manicm_ms.spec import AGENT_POS, DEPTH, IMAGE, POINT_CLOUD, STATE, ActionSpec, EnvSpec, ObsSpec

MAX_STEPS = 12
CRASH_X = 3.0  # m: a row beyond it makes `step` raise
RAISE_Y = -3.0  # m: a row below it makes `observe` raise
DIVERGE_Y = 3.0  # m: a row beyond it is observed as NaN
GOAL_X = 1.0  # m


def make_spec(env_id):
    return EnvSpec(
        env_id=env_id,
        obs=ObsSpec(16, 3, 2, "world", (6, 8)),
        action=ActionSpec(("dx [m]", "dy [m]"), "delta", 20.0),
        max_episode_steps=MAX_STEPS,
        agent_pos_names=("x [m]", "y [m]"),
        state_layout={"position": (0, 2)},
    )


class PointMass(Simulator):
    """Points that move by their action; success beyond `GOAL_X`. Counts how often it was observed."""

    def __init__(self, spec, config):
        self.spec, self.config, self.num_rows = spec, config, config.num_rows
        self.device = torch.device("cpu")
        self.position = torch.zeros(self.num_rows, 2)
        self.observed = self.stepped = 0

    def reset(self, rows, seeds):
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            self.position[row] = self.start(seed)

    def start(self, seed):
        return torch.rand(2, generator=torch.Generator().manual_seed(seed)) * 0.1

    def step(self, actions):
        self.stepped += 1
        self.position = self.position + actions
        if (self.position[:, 0] > CRASH_X).any():
            raise RuntimeError("left the world")
        success = self.position[:, 0] > GOAL_X
        return StepResult(self.position[:, 0].clone(), success, {"success": success})

    def observe(self):
        self.observed += 1
        if (self.position[:, 1] < RAISE_Y).any():
            raise ValueError("no picture")
        n, (height, width) = self.num_rows, self.spec.obs.image_size
        shape = (n, self.spec.obs.num_points, self.spec.obs.point_channels)
        depth = torch.arange(height * width).view(height, width) + self.position[:, :1, None]
        every = {
            POINT_CLOUD: self.position.repeat(1, shape[2])[:, None, : shape[2]].expand(shape).clone(),
            AGENT_POS: torch.where(self.position[:, 1:] > DIVERGE_Y, torch.nan, self.position),
            STATE: self.position.clone(),
            DEPTH: depth,
            IMAGE: (depth[..., None].expand(n, height, width, 3) * 2).to(torch.uint8),
        }
        return {key: every[key] for key in self.config.obs}

    def render_video_frames(self):
        return torch.zeros(self.num_rows, 4, 4, 3, dtype=torch.uint8)

    def close(self):
        pass


class IgnoresSeed(PointMass):
    def start(self, seed):
        return torch.zeros(2)


class DrawsFromGlobalState(PointMass):
    def start(self, seed):
        return torch.rand(2)


class IgnoresActions(PointMass):
    def step(self, actions):
        return super().step(torch.zeros_like(actions))


class WrongShape(PointMass):
    def observe(self):
        return {key: value[:, 1:] if key == DEPTH else value for key, value in super().observe().items()}


class NotFinite(PointMass):
    def observe(self):
        frame = super().observe()
        frame[AGENT_POS][:, 0] = torch.inf
        return frame


class Raises(PointMass):
    """Cannot start the seed 13; the seed 14 meets an error that the package knows."""

    def start(self, seed):
        if seed == 13:
            raise RuntimeError("a long story:\nno start for this seed")
        if seed == 14:
            raise RenderDeviceError("no device: install one")
        return super().start(seed)


class RemembersTheLastEpisode(PointMass):
    """Its first step after a reset goes on with the last action of the episode before."""

    last = 0.0

    def step(self, actions):
        moved = actions + 0.01 * self.last
        self.last = actions
        return super().step(moved)


BROKEN = {
    "toy/ignores-seed": (IgnoresSeed, "other seed other start"),
    "toy/global-random": (DrawsFromGlobalState, "same seed same episode"),
    "toy/ignores-actions": (IgnoresActions, "observations vary"),
    "toy/wrong-shape": (WrongShape, "plays"),
    "toy/not-finite": (NotFinite, "observations finite"),
    "toy/remembers": (RemembersTheLastEpisode, "same seed same episode"),
}
"""id -> (simulator, the check it fails)."""
SOUND, RAISING = "toy/point-mass-env", "toy/raising"

for env_id, simulator in {
    SOUND: PointMass,
    RAISING: Raises,
    **{name: broken for name, (broken, _) in BROKEN.items()},
}.items():
    ENVS.add(env_id, EnvEntry(make_spec(env_id), simulator, __name__))


def build(num_rows, obs=(POINT_CLOUD, AGENT_POS)):
    """Return a simulator of `num_rows` rows in this process."""
    config = SimulatorConfig(num_rows=num_rows, obs=obs)
    return PointMass(make_spec(SOUND), config)
