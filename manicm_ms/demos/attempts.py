"""One seed played is one attempt: an expert plays seed after seed on all rows of a vector environment.

Attempts are yielded in the order of their seeds, whatever the number of rows and whichever of them ends first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from manicm_ms.demos.experts import Expert
from manicm_ms.demos.layout import OBS_OF_FIELD, Episode
from manicm_ms.envs.simulator import DemoRule
from manicm_ms.envs.vector import VecEnv
from manicm_ms.errors import ConfigError
from manicm_ms.sensing.realism import RealismSample
from manicm_ms.spec import ACTION, STATE


@dataclass(frozen=True)
class Attempt:
    """One seed that was played to its end.

    Attributes:
        seed: seed of the environment's reset.
        episode: the demonstration, or None where the task was not solved.
        reason: why there is none, in a few words; empty where there is one.
    """

    seed: int
    episode: Episode | None
    reason: str = ""


@dataclass
class _Row:
    """What one row of the environment is playing."""

    seed: int
    frames: dict[str, list[np.ndarray]] = field(default_factory=dict)
    solved_at: int | None = None  # steps played when success was first reported
    success_steps: int = 0


class Collector:
    """Plays seed after seed with an expert on all rows of a vector environment.

    Args:
        env: vector environment whose observations hold `point_cloud`, `agent_pos`, `state` and
            what `extras` needs; finished rows stay as they are until they are reset.
        expert: plays all rows from `state`.
        rule: which episodes are kept, and where they are cut if the task goes on after its success.
        extras: optional fields of `Episode` to record, from `OPTIONAL_FIELDS`.
        conditions: returns what is drawn for the episode of a seed beside its scene, to be recorded with it.
    """

    def __init__(
        self,
        env: VecEnv,
        expert: Expert,
        *,
        rule: DemoRule = DemoRule(),  # noqa: B008 (it is frozen)
        extras: Iterable[str] = (),
        conditions: Callable[[int], RealismSample] = lambda seed: {},
    ) -> None:
        if rule.tail_steps < 0:
            raise ConfigError(f"tail_steps must not be negative, got {rule.tail_steps}")
        self.env, self.expert, self.rule, self.conditions = env, expert, rule, conditions
        self.spec = env.env_spec
        self.fields = ("point_cloud", "agent_pos", *extras)
        self._obs: Mapping[str, Any] = {}
        self._rows: list[_Row | None] = [None] * env.num_envs
        self._seeds = [0] * env.num_envs
        self._next_seed = 0
        self._begun: int | None = None  # first seed of a `begin` that no attempts followed yet

    def begin(self, first_seed: int) -> None:
        """Reset all rows to first_seed, first_seed + 1, ..., which shows whether the simulator runs at all.

        `attempts` from the same seed goes on from here, and does this itself where it was not done.
        """
        self._next_seed = self._begun = first_seed
        self._start(np.ones(self.env.num_envs, bool))

    def attempts(self, first_seed: int, wanted: int) -> Iterator[Attempt]:
        """Yield the attempts at first_seed, first_seed + 1, ... in this order, until `wanted` are solved."""
        done: dict[int, Attempt] = {}
        if self._begun != first_seed:
            self.begin(first_seed)
        self._begun, turn = None, first_seed
        while wanted > 0:
            for attempt in self._step():
                done[attempt.seed] = attempt
            while wanted > 0 and turn in done:
                attempt = done.pop(turn)
                turn += 1
                wanted -= attempt.episode is not None
                yield attempt
            pending = sum(a.episode is not None for a in done.values()) + sum(r is not None for r in self._rows)
            self._start(self._idle_rows(wanted - pending))

    def _idle_rows(self, count: int) -> np.ndarray:
        """Return a mask (N,) of the first `count` rows that play nothing.

        A row is left idle where those at work suffice if they succeed: it would only slow them.
        """
        mask = np.zeros(len(self._rows), bool)
        idle = [i for i, row in enumerate(self._rows) if row is None]
        mask[idle[: max(count, 0)]] = True
        return mask

    def _start(self, mask: np.ndarray) -> None:
        """Begin the next seeds in the rows of `mask` (N,) bool."""
        if not mask.any():
            return
        for i in np.flatnonzero(mask):
            self._seeds[i] = self._next_seed
            self._rows[i] = _Row(self._next_seed)
            self._next_seed += 1
        self._obs, _ = self.env.reset(seed=list(self._seeds), options={"reset_mask": mask})
        state = self._obs[STATE]
        self.expert.reset(state, list(self._seeds), torch.as_tensor(mask, device=state.device))

    def _step(self) -> list[Attempt]:
        """Play one control step in all rows; return the attempts that ended with it."""
        actions = self.expert.act(self._obs[STATE]).clamp(-1.0, 1.0)
        self._record(actions)
        self._obs, _, terminated, truncated, info = self.env.step(actions)
        over, success = _numpy(terminated) | _numpy(truncated), _numpy(info["success"])
        errors = info.get("error", [None] * len(self._rows))
        counted = info.get("success_steps")  # where an environment step is shorter than a control step
        ended = []
        for i, row in enumerate(self._rows):
            if row is None:
                continue
            steps = len(row.frames[ACTION])
            if success[i] and row.solved_at is None:
                row.solved_at = steps
            row.success_steps = row.success_steps + bool(success[i]) if counted is None else int(counted[i])
            if over[i] or self._tail_played(row, steps) or errors[i] or steps >= self.spec.max_episode_steps:
                ended.append(self._finish(row, bool(success[i]), errors[i]))
                self._rows[i] = None
        return ended

    def _tail_played(self, row: _Row, steps: int) -> bool:
        """Return whether a row has shown all that is kept; one that lacks successful steps may still get them."""
        if row.solved_at is None or row.success_steps < self.rule.success_steps:
            return False
        return steps - row.solved_at >= self.rule.tail_steps

    def _record(self, actions: torch.Tensor) -> None:
        """Keep what each playing row sees and does."""
        frame = {name: _numpy(self._obs[OBS_OF_FIELD[name]]) for name in self.fields}
        frame[ACTION] = _numpy(actions)
        for i, row in enumerate(self._rows):
            if row is not None:
                for name, values in frame.items():
                    # A copy: the environment may write its next observation into the same memory.
                    row.frames.setdefault(name, []).append(values[i].copy())

    def _finish(self, row: _Row, success_now: bool, error: str | None) -> Attempt:
        solved = success_now if self.spec.success_rule == "last" else row.solved_at is not None
        if error:
            return Attempt(row.seed, None, f"the episode crashed: {error}")
        if not solved:
            return Attempt(row.seed, None, f"not solved in {len(row.frames[ACTION])} steps")
        if row.success_steps < self.rule.success_steps:
            few = f"{row.success_steps} successful steps, of which {self.rule.success_steps} are wanted"
            return Attempt(row.seed, None, few)
        arrays = {name: np.stack(values) for name, values in row.frames.items()}
        if bad := [name for name, a in arrays.items() if a.dtype.kind == "f" and not np.isfinite(a).all()]:
            return Attempt(row.seed, None, f"NaN or infinity in {', '.join(bad)}")
        drawn = self.conditions(row.seed)
        return Attempt(row.seed, Episode(**arrays, seed=row.seed, success=True, realism=drawn))


def _numpy(value: Any) -> np.ndarray:
    return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
