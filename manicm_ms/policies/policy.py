"""What every policy is: a window of observations in, the executed part of an action chunk out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.spec import AGENT_POS, ANY, POINT_CLOUD, ChunkSpec, EnvSpec


class ChannelStats(Protocol):
    """Range of a field: what a normalizer is fitted from (`manicm_ms.demos.stats.FieldStats` is one).

    Attributes:
        min: (C,) smallest value of each channel, in the field's unit.
        max: (C,) largest value of each channel.
    """

    @property
    def min(self) -> Any:
        """Return the smallest value of each channel."""

    @property
    def max(self) -> Any:
        """Return the largest value of each channel."""


class Observer(Protocol):
    """What reads observations: a policy of ours, or a user's own.

    Attributes:
        spec: the environment that it was made for.
        chunk: To, Tp, Ta.
    """

    spec: EnvSpec
    chunk: ChunkSpec


class Policy(nn.Module, ABC):
    """Maps observations to actions.

    Attributes:
        name: of the method, as a rule one in `METHODS`.
        spec: the environment that it was made for.
        chunk: To, Tp, Ta.
    """

    name: str
    spec: EnvSpec
    chunk: ChunkSpec
    keys: tuple[str, ...] = (POINT_CLOUD, AGENT_POS)
    """Observations that it reads."""

    @property
    @abstractmethod
    def nfe(self) -> int:
        """Number of network evaluations of one `act`, the observation encoder not counted."""

    @property
    def noise_draws(self) -> int:
        """Independent Gaussian arrays (B, Tp, Da) that one `act` consumes; 0 for a deterministic policy."""
        return 1

    def initial_state(self, n: int) -> dict[str, Tensor] | None:
        """Return what the policy remembers in n rows that have just been restarted; None without memory."""
        del n
        return None

    def decide(
        self, obs: Mapping[str, Tensor], noise: Tensor, state: dict[str, Tensor] | None
    ) -> tuple[Tensor, dict[str, Tensor] | None]:
        """Choose the next actions of rows whose episodes go on: what a rollout calls.

        Args:
            obs: as for `act`.
            noise: (noise_draws, B, Tp, Da).
            state: what the last decision returned, None at the first; a policy without memory ignores it.

        Returns:
            (B, Ta, Da) as `act` returns it, and the state after the decision.
        """
        return self.act(obs, noise=noise), state

    @abstractmethod
    def act(
        self, obs: Mapping[str, Tensor], *, generator: torch.Generator | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Choose the next actions.

        Args:
            obs: each of `keys` as (B, To, ...), as `point_cloud` (B, To, P, C), in type, unit and frame of `spec`,
                on the policy's device; frames in order of time, the present one last.
            generator: source of the Gaussian noise; torch's default generator where it is None. Noise is
                drawn on the generator's device and then moved, so a CPU generator gives every device the same.
                It is the only source of chance: points that are drawn at random are a function of the noise.
            noise: what to use in place of drawn noise, (B, Tp, Da), or (noise_draws, B, Tp, Da).

        Returns:
            (B, Ta, Da) float32 in [-1, 1], the actions to execute from the present frame on.

        Raises:
            SpecMismatchError: the observations do not have the shapes of `spec` and `chunk`.
            NotFiniteError: `agent_pos` or the action holds NaN or infinity, or a frame holds no finite point.
                Single points that are not finite are left out; see `finite_obs`.
        """

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return next(self.parameters()).device


def check_obs(obs: Mapping[str, Tensor], spec: EnvSpec, chunk: ChunkSpec, keys: Sequence[str]) -> int:
    """Return B, the number of rows in `obs`; raise SpecMismatchError where a shape is not the policy's.

    Args:
        obs: key -> (B, To, ...).
        spec: says how a frame of each key looks.
        chunk: To, Tp, Ta.
        keys: what the policy reads.
    """
    rows = 0
    for key in keys:
        if key not in obs:
            raise SpecMismatchError(f"the policy reads {key!r} and got only {sorted(obs)}: ask the environment for it")
        shape, frame = tuple(obs[key].shape), spec.observation(key).shape
        fits = len(shape) == 2 + len(frame) and shape[1] == chunk.n_obs_steps
        if not fits or any(n not in (m, ANY) for m, n in zip(shape[2:], frame, strict=True)):
            axes = ", ".join(["B", str(chunk.n_obs_steps), *("P" if n == ANY else str(n) for n in frame)])
            raise SpecMismatchError(
                f"{key} has shape {shape} and this policy reads ({axes}): make the environment with the policy's chunk"
            )
        if (spec.observation(key).dtype == "uint8") != (obs[key].dtype == torch.uint8):
            raise SpecMismatchError(
                f"{key} is {obs[key].dtype} and this policy reads {spec.observation(key).dtype}: hand it over as it is "
                "observed"
            )
        rows = shape[0]
    return rows


def example_observations(policy: Observer, batch: int = 1, seed: int = 0) -> dict[str, Tensor]:
    """Return observations of the right shapes for any policy, on the CPU: each key that it reads as (B, To, ...).

    Values are uniform, in [0, 1) or over all bytes: a decision takes the same operations whatever they are.

    Args:
        policy: ours, or a user's own with `spec` and `chunk`.
        batch: B, rows.
        seed: of the values.
    """
    generator = torch.Generator().manual_seed(seed)
    found = {}
    for key in getattr(policy, "keys", (POINT_CLOUD, AGENT_POS)):
        shape = tuple(policy.spec.obs.num_points if n == ANY else n for n in policy.spec.observation(key).shape)
        full = (batch, policy.chunk.n_obs_steps, *shape)
        if policy.spec.observation(key).dtype == "uint8":
            found[key] = torch.randint(256, full, generator=generator, dtype=torch.uint8)
        else:
            found[key] = torch.rand(full, generator=generator)
    return found


def typical_observations(policy: Observer, batch: int = 1, seed: int = 0) -> dict[str, Tensor]:
    """Return example observations within the ranges that the policy learnt from; arguments as `example_observations`.

    Far outside of them a network may answer with infinity, for which its decisions are refused. A policy without a
    normalizer gets the examples as they are.
    """
    from manicm_ms.policies.normalizer import Normalizer  # which imports this module

    found = example_observations(policy, batch, seed)
    if isinstance(normalizer := getattr(policy, "normalizer", None), Normalizer):
        device = next(normalizer.buffers()).device
        for key in found.keys() & set(normalizer.fields):
            found[key] = normalizer.unnormalize(key, 2 * found[key].to(device) - 1).cpu()
    return found


def starting_noise(
    policy: Policy, batch: int, generator: torch.Generator | None, noise: Tensor | None
) -> tuple[Tensor, ...]:
    """Return the noise arrays of one `act`, each (B, Tp, Da) on the policy's device.

    Raises ConfigError where `noise` has another shape.
    """
    shape = (batch, policy.chunk.horizon, policy.spec.action.dim)
    draws = policy.noise_draws
    given: tuple[Tensor, ...] = ()
    if noise is not None:
        given = tuple(noise) if noise.dim() == 4 else (noise,)
        if any(n.shape != shape for n in given) or len(given) not in (1, draws):
            raise ConfigError(f"noise has shape {tuple(noise.shape)}, expected {shape} or {(draws, *shape)}")
    place = generator.device if generator is not None else torch.device("cpu")
    drawn = (torch.randn(shape, generator=generator, device=place) for _ in range(draws - len(given)))
    return tuple(n.to(policy.device, torch.float32) for n in (*given, *drawn))
