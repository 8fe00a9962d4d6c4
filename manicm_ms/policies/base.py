"""What every policy is: a window of observations in, the executed part of an action chunk out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, ClassVar, Protocol, TypeVar

import torch
from torch import Tensor, nn

from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.registry import Registry
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, ChunkSpec, EnvSpec

Config = TypeVar("Config")


class ChannelStats(Protocol):
    """Range of a field: what a normaliser is fitted from (`manicm_ms.demos.stats.FieldStats` is one).

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


class Policy(nn.Module, ABC):
    """Maps observations to actions.

    Attributes:
        name: the policy's name in `POLICIES`.
        spec: the environment that it was made for.
        chunk: To, Tp, Ta.
    """

    name: str
    spec: EnvSpec
    chunk: ChunkSpec
    registered: ClassVar[bool] = True
    """Whether `POLICIES` can rebuild it from `config_dict`; False for wrappers that are not saved."""

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
    def config_dict(self) -> dict[str, Any]:
        """Return plain JSON values from which `POLICIES.get(name)` rebuilds the untrained policy."""

    @abstractmethod
    def fit_normalizer(self, stats: Mapping[str, ChannelStats]) -> None:
        """Set the normaliser from the ranges of `point_cloud`, `agent_pos` and `action`."""

    @abstractmethod
    def act(
        self, obs: Mapping[str, Tensor], *, generator: torch.Generator | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Choose the next actions.

        Args:
            obs: `point_cloud` (B, To, P, C) and `agent_pos` (B, To, D), float32, units and frame of `spec`,
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


POLICIES: Registry[Callable[[Mapping[str, Any], EnvSpec, ChunkSpec], Policy]] = Registry(
    "policy", package="manicm_ms.policies"
)
"""name -> factory(config, spec, chunk); keys missing from `config` take the policy's published values."""


def make_policy(
    name: str,
    spec: EnvSpec,
    chunk: ChunkSpec,
    config: Mapping[str, Any] | None = None,
    *,
    stats: Mapping[str, ChannelStats] | None = None,
    seed: int | None = None,
) -> Policy:
    """Build an untrained policy.

    Args:
        name: a name in `POLICIES`.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta.
        config: departures from the published configuration, for example
            `{"network": {"down_dims": (64, 128, 256), "cloud_frame": "tcp"}}`.
        stats: ranges of the training data; without them the normaliser is the identity.
        seed: of the initial weights; torch's default generator is left as it was. None draws from it.

    Raises:
        UnknownNameError: no policy has this name.
        ConfigError: a field is unknown, out of range, or does not fit `spec` or `chunk`.
    """
    factory = POLICIES.get(name)
    if seed is None:
        policy = factory(config or {}, spec, chunk)
    else:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            policy = factory(config or {}, spec, chunk)
    if stats is not None:
        policy.fit_normalizer(stats)
    return policy


def updated_config(default: Config, changes: Mapping[str, Any], kind: str) -> Config:
    """Return the frozen dataclass `default` with `changes`, which may come from JSON (lists become tuples).

    Raises ConfigError for a key that is no field of it.
    """
    known = {f.name for f in fields(default)}  # type: ignore[arg-type]
    if unknown := sorted(set(changes) - known):
        raise ConfigError(f"{kind} has no field {', '.join(unknown)}: its fields are {', '.join(sorted(known))}")
    values = {name: getattr(default, name) for name in known}
    values.update({k: tuple(v) if isinstance(v, list) else v for k, v in changes.items()})
    return type(default)(**values)


def check_sections(config: Mapping[str, Any], sections: tuple[str, ...], kind: str) -> None:
    """Raise ConfigError where `config` holds a key that is none of `sections`."""
    if unknown := sorted(set(config) - set(sections)):
        raise ConfigError(f"{kind} configuration has no section {', '.join(unknown)}: use {', '.join(sections)}")


def check_obs(obs: Mapping[str, Tensor], spec: EnvSpec, chunk: ChunkSpec) -> int:
    """Return B, the number of rows in `obs`; raise SpecMismatchError where a shape is not the policy's."""
    for key, rank, tail in (
        (POINT_CLOUD, 4, (spec.obs.point_channels,)),
        (AGENT_POS, 3, (spec.obs.agent_pos_dim,)),
    ):
        if key not in obs:
            raise SpecMismatchError(f"the policy reads {key!r} and got only {sorted(obs)}: ask the environment for it")
        shape = tuple(obs[key].shape)
        if len(shape) != rank or shape[1] != chunk.n_obs_steps or shape[-1:] != tail:
            want = f"(B, {chunk.n_obs_steps}, {'P, ' if rank == 4 else ''}{tail[0]})"
            raise SpecMismatchError(
                f"{key} has shape {shape} and this policy reads {want}: make the environment with the policy's chunk"
            )
    return obs[POINT_CLOUD].shape[0]


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
