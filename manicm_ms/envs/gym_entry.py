"""What Gymnasium calls for our ids: `env[adroit/door]` makes one row, `vector_env[adroit/door]` N of them."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

from manicm_ms.envs.simulator import ENVS
from manicm_ms.envs.single import SingleEnv
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import ConfigError

_NAME = re.compile(r"(env|vector_env)\[(.+)\]")


def __getattr__(name: str) -> Callable[..., Any]:
    """Return what makes the environment that an entry point names; its arguments are those of `make_vec`."""
    if not (named := _NAME.fullmatch(name)):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    kind, env_id = named.groups()
    return partial(SingleEnv if kind == "env" else _make_vec, env_id)


def _make_vec(env_id: str, num_envs: int, max_episode_steps: int, arrays: str = "numpy", **options: Any) -> Any:
    """Return `make_vec`'s environment, in NumPy arrays, which Gymnasium's users expect, unless asked otherwise."""
    longest = ENVS.get(env_id).spec.max_episode_steps
    if max_episode_steps != longest:
        raise ConfigError(f"an episode of {env_id} has {longest} control steps, which max_episode_steps cannot change")
    make: Any = make_vec
    return make(env_id, num_envs, arrays=arrays, **options)
