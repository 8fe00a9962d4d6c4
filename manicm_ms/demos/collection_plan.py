"""What a collection asks for, checked before any work, and what plays it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from manicm_ms.demos.attempts import Collector
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.demos.layout import OBS_OF_FIELD, OPTIONAL_FIELDS
from manicm_ms.envs.env_request import EnvRequest
from manicm_ms.envs.simulator import DemoRule
from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.seeds import require_seed
from manicm_ms.sensing.realism import Realism, realism_name, resolve_realism
from manicm_ms.spec import ACTION, AGENT_POS, POINT_CLOUD, STATE, VOXEL_GRID, VOXEL_SIZE


@dataclass(frozen=True)
class CollectionPlan:
    """What a collection asks for, whether into a store or into memory; see `collect`.

    Raises ConfigError where a number is out of range or an extra is not known, UnknownNameError for the id.
    """

    env: EnvRequest
    num_envs: int
    seed: int
    style: str | None
    extras: tuple[str, ...]
    tail_steps: int | None
    voxel_size: int = VOXEL_SIZE

    def __post_init__(self) -> None:
        if self.num_envs < 1:
            raise ConfigError(f"num_envs must be at least 1, got {self.num_envs}")
        require_seed(self.seed)
        require_at_least(1, voxel_size=self.voxel_size)
        if self.voxel_size != VOXEL_SIZE and VOXEL_GRID not in self.extras:
            raise ConfigError(f"voxel_size={self.voxel_size} without voxel grids: add {VOXEL_GRID} to the extras")
        if unknown := set(self.extras) - set(OPTIONAL_FIELDS):
            raise ConfigError(f"extras {sorted(unknown)} are not known: choose from {', '.join(OPTIONAL_FIELDS)}")
        _ = self.env.entry  # knows former names too
        EXPERTS.get(self.env.env_id)

    @property
    def realism(self) -> Realism:
        """What is drawn for each episode."""
        return resolve_realism(self.env.realism)

    @property
    def rule(self) -> DemoRule:
        """The task's own rule, with the tail that was asked for instead of its own."""
        own = self.env.entry.demos
        return own if self.tail_steps is None else replace(own, tail_steps=self.tail_steps)

    def asked(self) -> dict[str, Any]:
        """Return what is known of `origin.IDENTITY` before the environment and the expert are made."""
        return {
            "env_id": self.env.env_id,
            "seed": self.seed,
            "tail_steps": self.rule.tail_steps,
            "success_steps": self.rule.success_steps,
            "obs_preset": self.env.obs_preset,
            "fields": ["point_cloud", "agent_pos", ACTION, *(f for f in OPTIONAL_FIELDS if f in self.extras)],
            "point_channels": 6 if self.env.colors else 3,
            "realism": realism_name(self.realism),
            "realism_ranges": None if self.realism.is_clean else self.realism.to_dict(),
            "camera": None if (camera := self.env.camera_model) is None else camera.to_dict(),
            **({"voxel_size": self.voxel_size} if VOXEL_GRID in self.extras else {}),
        }

    @contextmanager
    def collector(self) -> Iterator[Collector]:
        """Make environment and expert; yield what plays, and close the environment after it."""
        keys = dict.fromkeys([POINT_CLOUD, AGENT_POS, STATE, *(OBS_OF_FIELD[f] for f in self.extras)])
        env = self.env.vec_env(self.num_envs, obs=tuple(keys), voxel_size=self.voxel_size)
        try:
            expert = EXPERTS.get(self.env.env_id)(env.env_spec, self.num_envs, env.device, self.style)
            conditions = partial(self.env.entry.conditions, self.realism)
            yield Collector(env, expert, rule=self.rule, extras=self.extras, conditions=conditions)
        finally:
            env.close()
