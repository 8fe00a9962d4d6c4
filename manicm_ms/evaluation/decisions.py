"""Asks a policy for the actions of all rows: each row's noise, its state, and rows in which no action can be taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from manicm_ms.errors import NotFiniteError
from manicm_ms.spec import ChunkSpec, EnvSpec

State = dict[str, Tensor]
"""What a policy remembers from one decision to the next: name -> (N, ...)."""

_NOISE_STREAM = 0x4D53
"""Sets the policy's noise apart from whatever else is drawn from an episode's seed."""


class Decider(Protocol):
    """What a rollout asks of a policy; `manicm_ms.policies.policy.Policy` and `UserPolicy` give it.

    Attributes:
        spec: the environment that it was made for.
        chunk: To, Tp, Ta.
        noise_draws: independent Gaussian arrays (N, Tp, Da) that a decision consumes; 0 for a deterministic policy.
        device: where it wants its observations.
    """

    spec: EnvSpec
    chunk: ChunkSpec

    @property
    def nfe(self) -> int | None:
        """Return the network evaluations of a decision; None where it is not known."""

    @property
    def noise_draws(self) -> int:
        """Return how many arrays of noise a decision consumes."""

    @property
    def device(self) -> torch.device:
        """Return where the observations are wanted."""

    def eval(self) -> Any:
        """Get ready to act."""

    def initial_state(self, n: int) -> State | None:
        """Return the state of n rows that have just been restarted; None for a policy without memory."""

    def decide(self, obs: Mapping[str, Tensor], noise: Tensor, state: State | None) -> tuple[Tensor, State | None]:
        """Return the actions (N, Ta, Da) and the next state.

        Args:
            obs: key -> (N, To, ...).
            noise: (noise_draws, N, Tp, Da).
            state: what the last decision returned, restarted rows overwritten; None at the first decision.
        """


def decision_noise(seed: int, decision: int, shape: tuple[int, ...]) -> Tensor:
    """Return the Gaussian noise, float32 on the CPU, of one decision of the episode with this seed.

    A shorter leading axis gives the beginning of a longer one: policies that draw once and policies that
    draw several times start from the same array.

    Args:
        seed: of the episode.
        decision: number of the decision in the episode, from 0.
        shape: (noise_draws, Tp, Da).
    """
    if shape[0] == 0:
        return torch.zeros(shape)
    state = np.random.SeedSequence((seed, _NOISE_STREAM, decision)).generate_state(1, np.uint64)[0]
    generator = torch.Generator().manual_seed(int(state) >> 1)  # torch takes 63 bits without wrapping
    return torch.stack([torch.randn(shape[1:], generator=generator) for _ in range(shape[0])])


class Decisions:
    """The decisions of a policy for N rows of a vector env, whose episodes start and end independently.

    Args:
        policy: decides for all rows at once.
        num_rows: N.
    """

    def __init__(self, policy: Decider, num_rows: int) -> None:
        self._policy, self._num_rows = policy, num_rows
        self._state: State | None = None

    def restart(self, rows: Sequence[int]) -> None:
        """Forget what the policy remembers of these rows; the others keep their memory."""
        if self._state is None or not rows:
            return
        fresh = self._policy.initial_state(len(rows))
        assert fresh is not None, "a policy that returned a state has an initial one"
        index = torch.as_tensor(list(rows))
        self._state = {key: value.clone() for key, value in self._state.items()}
        for key, value in self._state.items():
            value[index.to(value.device)] = fresh[key].to(value)

    def actions(self, obs: Mapping[str, Tensor], episodes: Sequence[tuple[int, int] | None]) -> Tensor:
        """Return actions (N, Ta, Da) on the policy's device, NaN in rows in which it refuses to act.

        Args:
            obs: key -> (N, To, ...).
            episodes: the seed of each row's episode and the number of its decision; None in a row without an episode,
                whose noise is zeros.
        """
        policy = self._policy
        shape = (policy.noise_draws, policy.chunk.horizon, policy.spec.action.dim)
        drawn = [torch.zeros(shape) if e is None else decision_noise(*e, shape) for e in episodes]
        noise = torch.stack(drawn, dim=1).to(policy.device)  # (draws, N, Tp, Da)
        actions, self._state = self._decide({k: v.to(policy.device) for k, v in obs.items()}, noise, self._state)
        return actions

    def _decide(self, obs: Mapping[str, Tensor], noise: Tensor, state: State | None) -> tuple[Tensor, State | None]:
        try:
            return self._policy.decide(obs, noise, state)
        except NotFiniteError as error:
            refused = list(error.rows)
        sound = next((i for i in range(self._num_rows) if i not in refused), None)
        if sound is None:
            shape = (self._num_rows, self._policy.chunk.n_action_steps, self._policy.spec.action.dim)
            return torch.full(shape, torch.nan, device=self._policy.device), state
        # A row does not depend on the others, so that a sound one can stand in for those that are refused.
        rows = [sound if i in refused else i for i in range(self._num_rows)]
        taken = None if state is None else {key: value[rows] for key, value in state.items()}
        actions, after = self._decide({key: value[rows] for key, value in obs.items()}, noise[:, rows], taken)
        actions = actions.clone()
        actions[refused] = torch.nan
        return actions, after
