"""A policy of the user's own, trained with any tool: a file, and a function in it that makes the policy."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from manicm_ms.errors import ManicmError, UserPolicyError
from manicm_ms.evaluation.decisions import State
from manicm_ms.policies.policy import example_observations
from manicm_ms.registry import where_it_failed
from manicm_ms.spec import AGENT_POS, OBS_KEYS, POINT_CLOUD, ChunkSpec, EnvSpec

FORM = "FILE.py:FUNCTION"
_TRIAL_ROWS = 2


class UserPolicy:
    """Gives a user's object the form of a policy, and checks what it returns.

    Args:
        source: where it comes from, FILE.py:FUNCTION, for messages.
        made: the object: `chunk` (a `ChunkSpec`) and `act(obs, noise, state) -> (actions, state)`; `keys` (the
            observations that it reads; by default cloud and proprioception), `nfe`, `name`, `device`, `eval` and
            `initial_state(n)` where it has them.
        spec: of the environment that it plays in.

    Raises:
        UserPolicyError: the object lacks one of the two, or its `keys` are no observations.
    """

    noise_draws = 1

    def __init__(self, source: str, made: Any, spec: EnvSpec) -> None:
        self.source, self.spec, self._made = source, spec, made
        if not isinstance(getattr(made, "chunk", None), ChunkSpec):
            raise UserPolicyError(
                f"{source} returned a {type(made).__name__} without a chunk: give it one, 'from manicm_ms import "
                "ChunkSpec' and 'chunk = ChunkSpec(n_obs_steps=2, horizon=4, n_action_steps=3)'"
            )
        if not callable(getattr(made, "act", None)):
            raise UserPolicyError(
                f"{source} returned a {type(made).__name__} without act(obs, noise, state) -> (actions, state)"
            )
        self.chunk: ChunkSpec = made.chunk
        self.keys = self._checked_keys(getattr(made, "keys", (POINT_CLOUD, AGENT_POS)))
        nfe = getattr(made, "nfe", None)
        self.nfe: int | None = None if nfe is None else int(nfe)
        self.name = str(getattr(made, "name", Path(source.rpartition(":")[0]).stem))

    @property
    def device(self) -> torch.device:
        """Device of its observations: its own `device`, else the CPU."""
        return torch.device(getattr(self._made, "device", "cpu"))

    def eval(self) -> None:
        """Put it into evaluation mode where it has one."""
        if callable(switch := getattr(self._made, "eval", None)):
            switch()

    def initial_state(self, n: int) -> State | None:
        """Return the user's `initial_state(n)`; None where there is no such function."""
        make = getattr(self._made, "initial_state", None)
        return self._checked_state(make(n), n) if callable(make) else None

    def decide(self, obs: Mapping[str, Tensor], noise: Tensor, state: State | None) -> tuple[Tensor, State | None]:
        """Return actions and state; see `Decider.decide`.

        Raises:
            UserPolicyError: what `act` returned has another form, shape or type. NaN goes through: a rollout ends the
                episodes of such rows.
        """
        rows = noise.shape[1]
        returned = self._made.act(dict(obs), noise[0], state)
        if not isinstance(returned, tuple) or len(returned) != 2:
            raise UserPolicyError(f"act of {self.source} returned a {type(returned).__name__}: return (actions, state)")
        actions, after = returned
        if not callable(getattr(self._made, "initial_state", None)):
            after = None
        return self._checked_actions(actions, rows), None if after is None else self._checked_state(after, rows)

    def _checked_keys(self, keys: Any) -> tuple[str, ...]:
        if not isinstance(keys, tuple | list) or not keys or any(key not in OBS_KEYS for key in keys):
            raise UserPolicyError(f"keys of {self.source} are {keys!r}: name some of {', '.join(OBS_KEYS)}")
        return tuple(keys)

    def _checked_actions(self, actions: Any, rows: int) -> Tensor:
        actions = torch.from_numpy(actions) if isinstance(actions, np.ndarray) else actions
        shape = (rows, self.chunk.n_action_steps, self.spec.action.dim)
        if not isinstance(actions, Tensor):
            raise UserPolicyError(f"actions of {self.source} are a {type(actions).__name__}: return a tensor {shape}")
        if tuple(actions.shape) != shape:
            raise UserPolicyError(
                f"actions of {self.source} have shape {tuple(actions.shape)}, and (N, Ta, Da) is {shape} here"
            )
        if not actions.is_floating_point():
            raise UserPolicyError(f"actions of {self.source} are {actions.dtype}: return floating point in [-1, 1]")
        return actions.detach().to(torch.float32)

    def _checked_state(self, state: Any, rows: int) -> State:
        sound = isinstance(state, dict) and all(
            isinstance(v, Tensor) and v.shape[:1] == (rows,) for v in state.values()
        )
        if not sound:
            raise UserPolicyError(f"the state of {self.source} must be None or a dictionary of tensors ({rows}, ...)")
        return state


def load_user_policy(source: str, spec: EnvSpec) -> UserPolicy:
    """Make a policy from FILE.py:FUNCTION and let it decide once, so that a wrong one is refused before any episode.

    The file is run like a script: what lies beside it can be imported.

    Args:
        source: the file, and the function in it that takes an `EnvSpec` and returns the policy.
        spec: of the environment that it will play in.

    Raises:
        UserPolicyError: the file or function does not exist or fails, or the policy's first actions are unfit.
    """
    policy = UserPolicy(source, _call(source, _factory(source), spec), spec)
    obs = {key: value.to(policy.device) for key, value in example_observations(policy, _TRIAL_ROWS).items()}
    noise = torch.zeros(1, _TRIAL_ROWS, policy.chunk.horizon, spec.action.dim, device=policy.device)
    try:
        policy.eval()
        with torch.no_grad():
            actions, _ = policy.decide(obs, noise, None)
    except ManicmError:
        raise
    except Exception as error:  # whatever it is, it is that file's
        raise _failed(source, "its first decision", error) from error
    if not torch.isfinite(actions).all():
        raise UserPolicyError(f"the first actions of {source} hold NaN or infinity, for observations within [0, 1]")
    return policy


def file_of(source: str) -> Path:
    """Return the file of FILE.py:FUNCTION; raise UserPolicyError where it has another form or does not exist."""
    file, colon, function = source.rpartition(":")
    if not colon or not file or not function.isidentifier():
        raise UserPolicyError(f"--policy {source} must name a file and a function in it, as in {FORM}")
    if not Path(file).is_file():
        raise UserPolicyError(f"--policy {source}: there is no file {file}")
    return Path(file)


def _factory(source: str) -> Callable[[EnvSpec], Any]:
    file, function = file_of(source).resolve(), source.rpartition(":")[2]
    name = f"_manicm_ms_user_policy_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise UserPolicyError(f"--policy {source}: {file.name} is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    if str(file.parent) not in sys.path:
        sys.path.insert(0, str(file.parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise _failed(source, "its import", error) from error
    made = getattr(module, function, None)
    if not callable(made):
        there = sorted(k for k, v in vars(module).items() if callable(v) and getattr(v, "__module__", "") == name)
        raise UserPolicyError(f"{file} has no function {function}: it defines {', '.join(there) or 'none'}")
    return made


def _call(source: str, make: Callable[[EnvSpec], Any], spec: EnvSpec) -> Any:
    try:
        return make(spec)
    except ManicmError:
        raise
    except Exception as error:
        raise _failed(source, f"{source.rpartition(':')[2]}(spec)", error) from error


def _failed(source: str, what: str, error: BaseException) -> UserPolicyError:
    file, line, words = where_it_failed(error, str(file_of(source).resolve()))
    return UserPolicyError(f"{file}, line {line}: {what} failed with {words}")
