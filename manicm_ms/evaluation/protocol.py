"""The ground of an evaluation: what is fixed about it, its policies with their roles, and how their files are named."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.evaluation.origins import UNKNOWN, Origin
from manicm_ms.seeds import require_seed
from manicm_ms.sensing.realism import RealismSample

if TYPE_CHECKING:
    from manicm_ms.evaluation.user_policy import UserPolicy
    from manicm_ms.policies.policy import Policy

TEACHER, CONTROL, STUDENT, OTHER = "teacher", "control", "student", "policy"
"""Roles: a diffusion policy, the same in one step without distillation, a distilled policy, any other."""
CLEAN = "clean"
"""Realism preset of the ideal world."""
OBS_PRESET = "manicm_ms"
"""The package's own way of making observations."""

MOST_EPISODES = 1_000_000
"""Seeds of an evaluation are listed one by one; nobody plays as many."""

Conditions = Callable[[str, int], RealismSample]
"""(realism preset, seed) -> what is drawn for that episode beside its scene."""


def seeds_from(seed: int, episodes: int) -> tuple[int, ...]:
    """Return seed, seed + 1, ..., one for each episode; raise ConfigError where there are more than `MOST_EPISODES`."""
    if episodes > MOST_EPISODES:
        raise ConfigError(f"--episodes must be at most {MOST_EPISODES}, got {episodes}")
    return tuple(range(seed, seed + episodes))


@dataclass(frozen=True)
class Protocol:
    """What is fixed about an evaluation beside its policies.

    Attributes:
        env_id: the environment.
        seeds: one episode each.
        num_envs: rows that run in parallel; does not change the conditions of an episode.
        threads: torch's intra-op threads while policies act and latency is measured.
        repetitions: timed decisions per policy.
        videos: seeds filmed, for each of teacher and student.
        realism: presets under which every policy plays all seeds; the first is that of the main results and videos.
        to_the_end: play on after a success that is certain, so that success at the end is known; see `rollout`.
        seed_limit: seeds lie below it; see `EnvEntry`.
    """

    env_id: str
    seeds: tuple[int, ...]
    num_envs: int
    threads: int = 1
    repetitions: int = 50
    videos: int = 4
    realism: tuple[str, ...] = (CLEAN,)
    to_the_end: bool = True
    seed_limit: int = 2**32

    def __post_init__(self) -> None:
        if not self.seeds:
            raise ConfigError("an evaluation needs at least one episode")
        require_seed(min(self.seeds))
        if max(self.seeds) >= self.seed_limit:
            raise ConfigError(
                f"seeds of {self.env_id} end at {self.seed_limit - 1}, and these run from {min(self.seeds)} to "
                f"{max(self.seeds)}: choose a smaller --seed"
            )
        require_at_least(1, num_envs=self.num_envs, threads=self.threads, repetitions=self.repetitions)
        require_at_least(0, videos=self.videos)


@dataclass(frozen=True)
class EvaluatedPolicy:
    """A policy to be evaluated.

    Attributes:
        name: its name in tables and files, unique in the evaluation.
        role: what its checkpoint is, one of the four above.
        checkpoint: folder it was loaded from, as the caller named it; of a user's own policy FILE.py:FUNCTION.
        policy: the policy itself, on the device it shall run on.
        origin: what its checkpoint says of its making.
        digest: tells what was loaded from something else under the same path.
    """

    name: str
    role: str
    checkpoint: str
    policy: Policy | UserPolicy
    origin: Origin = UNKNOWN
    digest: str = ""


def slug(name: str) -> str:
    """Return `name` as a file name."""
    return re.sub(r"[^\w-]+", "-", name).strip("-")
