"""A small real task for tests: its success comes and goes at control steps that the seed decides, and ends nothing."""

from dataclasses import replace
from functools import partial

import torch

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.simulator import ENVS, DemoRule, EnvEntry, Simulator, StepResult
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, STATE, ActionSpec, EnvSpec, ObsSpec

ENV_ID, LAST_ID, TWICE_ID = "toy/blinker", "toy/blinker-last", "toy/blinker-twice"
MAX_STEPS = 20
RULE = DemoRule(success_steps=3, tail_steps=4)
SOLVED_AT = {  # seed modulo 5 -> control steps, from 1, after which the task is solved
    0: {3, 4, 5, 6, 7, 8},
    1: {3, 10, 11, 12},
    2: {3, 4},
    3: set(),
    4: {17, 18, 19, 20},
}
SPEC = EnvSpec(
    env_id=ENV_ID,
    obs=ObsSpec(512, 3, 1, "world"),
    action=ActionSpec(("nothing [1]",), "velocity", 20.0),
    max_episode_steps=MAX_STEPS,
    agent_pos_names=("steps played [1]",),
    state_layout={"steps": (0, 1)},
)


class Blinker(Simulator):
    """`substeps` environment steps make a control step, and are counted where there are more than one."""

    def __init__(self, spec, config, substeps):
        self.spec, self.device, self.num_rows, self.substeps = spec, torch.device("cpu"), config.num_rows, substeps
        self.seeds = [0] * self.num_rows
        self.steps, self.successes = torch.zeros(2, self.num_rows, dtype=torch.int64)

    def reset(self, rows, seeds):
        for row, seed in zip(rows.tolist(), seeds, strict=True):
            self.seeds[row], self.steps[row], self.successes[row] = seed, 0, 0

    def step(self, actions):
        self.steps += 1
        success = torch.tensor([int(n) in SOLVED_AT[s % 5] for n, s in zip(self.steps, self.seeds, strict=True)])
        self.successes += success * self.substeps
        counted = {"success_steps": self.successes.clone()} if self.substeps > 1 else {}
        return StepResult(success.float(), torch.zeros_like(success), {"success": success, **counted})

    def observe(self):
        steps = self.steps[:, None].float()
        return {POINT_CLOUD: torch.zeros(self.num_rows, self.spec.obs.num_points, 3), AGENT_POS: steps, STATE: steps}

    def render_video_frames(self):
        return torch.zeros(self.num_rows, 8, 8, 3, dtype=torch.uint8)

    def close(self):
        pass


class Onlooker:
    """An expert that has nothing to do."""

    name, style, styles = "onlooker", "still", ("still",)

    def __init__(self, spec, num_envs, device, style):
        pass

    def reset(self, state, seeds, mask):
        pass

    def act(self, state):
        return torch.zeros(len(state), 1)


for _env_id, _rule, _substeps in ((ENV_ID, "any", 1), (LAST_ID, "last", 1), (TWICE_ID, "any", 2)):
    _spec = replace(SPEC, env_id=_env_id, success_rule=_rule)
    _build = partial(Blinker, substeps=_substeps)
    ENVS.add(_env_id, EnvEntry(_spec, _build, __name__, obs_presets=("manicm_ms", "dp3"), demos=RULE))
    EXPERTS.add(_env_id, Onlooker)
