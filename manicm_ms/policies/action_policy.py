"""The policy: input transforms, normalizer, encoder and head put together, acting and saving written once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.policies.backbones.backbone import BACKBONES, Backbone
from manicm_ms.policies.configuration import NAME, Nested, section
from manicm_ms.policies.encoders.encoder import ENCODERS, Features, ObsEncoder
from manicm_ms.policies.encoders.transform import TRANSFORMS, InputTransform, Obs
from manicm_ms.policies.finite import finite_obs, require_finite_actions
from manicm_ms.policies.heads.head import HEADS, ActionHead, State
from manicm_ms.policies.normalizer import Normalizer
from manicm_ms.policies.policy import ChannelStats, Policy, check_obs, starting_noise
from manicm_ms.registry import Registry
from manicm_ms.spec import ACTION, AGENT_POS, ANY, ChunkSpec, EnvSpec

SECTIONS = ("inputs", "normalizer", "encoder", "backbone", "head")
"""Sections of a policy's configuration."""


@dataclass(frozen=True)
class NormalizerConfig:
    """How the normalizer is fitted; checkpoints hold the fitted one, so that this changes none of them.

    Attributes:
        min_state_range: least range of a channel of agent_pos, in the channel's unit (metres, radians, entries of a
            rotation): a channel that moves less in the demonstrations is not stretched to [-1, 1]. 0 stretches it, as
            DP3 does.
    """

    sizes: ClassVar[Mapping[str, Nested]] = {"quick": {"min_state_range": 0.02}, "smoke": {"min_state_range": 0.02}}
    min_state_range: float = 0.0

    def __post_init__(self) -> None:
        if not self.min_state_range >= 0:
            raise ConfigError(f"min_state_range must be at least 0, got {self.min_state_range}")


class ActionPolicy(Policy):
    """Observations in, actions out, by whatever encoder and head.

    Observations pass through the transforms, are normalised, become features, and the head makes a chunk of them.

    Args:
        name: of the method.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta.
        transforms: name -> transform, in order; those that change nothing that the encoder reads are left out.
        normalizer_config: how the normalizer is fitted.
        encoder: normalised observations to features.
        head: features to normalised chunks.
        normalizer: of its keys and of `action`; a fresh one where None.

    Attributes:
        keys: observations that it reads: the encoder's and the transforms'.
    """

    def __init__(
        self,
        name: str,
        spec: EnvSpec,
        chunk: ChunkSpec,
        transforms: Mapping[str, InputTransform],
        normalizer_config: NormalizerConfig,
        encoder: ObsEncoder,
        head: ActionHead,
        normalizer: Normalizer | None = None,
    ) -> None:
        super().__init__()
        self.name, self.spec, self.chunk = name, spec, chunk
        transforms = _effective(transforms, encoder.keys)
        self.keys = _keys(encoder.keys, transforms)
        self.transforms = torch.nn.ModuleDict(transforms)
        self.normalizer_config = normalizer_config
        self.normalizer = normalizer if normalizer is not None else Normalizer(_channels(spec, self.keys))
        self.encoder, self.head = encoder, head

    @property
    def nfe(self) -> int:
        """Network evaluations of one decision."""
        return self.head.nfe

    @property
    def noise_draws(self) -> int:
        """Gaussian arrays that one decision consumes: the head's, and one where a transform draws from it."""
        return max(self.head.noise_draws, int(self.reads_noise))

    @property
    def reads_noise(self) -> bool:
        """Whether a transform draws from the noise that a decision starts from."""
        return any(t.acts_on_noise for t in self._transforms)

    @property
    def role(self) -> str | None:
        """What it is in a distillation: "teacher", "student", or None."""
        return self.head.role

    def config_dict(self) -> dict[str, Any]:
        """Return plain JSON values from which `build_policy` makes the same policy, untrained."""
        parts: dict[str, tuple[Any, Any]] = {"encoder": (ENCODERS, self.encoder), "head": (HEADS, self.head)}
        if self.head.backbone is not None:
            parts["backbone"] = (BACKBONES, self.head.backbone)
        named = {
            key: {NAME: _name_of(registry, part), **asdict(part.config)} for key, (registry, part) in parts.items()
        }
        inputs = {name: asdict(t.config) for name, t in zip(self.transforms, self._transforms, strict=True)}
        return {"inputs": inputs, "normalizer": asdict(self.normalizer_config), "backbone": None, **named}

    def fit_normalizer(self, stats: Mapping[str, ChannelStats]) -> None:
        """Set the normalizer from the ranges of what the policy reads and of `action`, each in its unit."""
        for transform in self._transforms:
            stats = transform.ranges(stats)
        self.normalizer.fit(stats, {AGENT_POS: self.normalizer_config.min_state_range})

    def encode(self, obs: Obs, noise: Tensor | None = None) -> Features:
        """Return the features of raw observations as they are read when acting.

        Args:
            obs: each of `keys` as (B, To, ...), in units and frame of `spec`.
            noise: (B, Tp, Da) that the decision starts from; needed where a transform reads it.
        """
        return self._encoded(obs, lambda transform, seen: transform.read_acting(seen, noise))  # type: ignore[arg-type]

    def encode_training(self, obs: Obs, generator: torch.Generator) -> Features:
        """Return the features of raw observations as one step of training reads them; chance from `generator`."""
        return self._encoded(obs, lambda transform, seen: transform.read_training(seen, generator))

    def varies(self, obs: Obs) -> bool:
        """Return whether another draw could give other features of the same observations."""
        return any(t.varies(obs) for t in self._transforms)

    @torch.inference_mode()
    def decide(self, obs: Obs, noise: Tensor | None, state: State | None) -> tuple[Tensor, State | None]:
        """Choose the next actions of rows whose episodes go on; see `Policy.decide`."""
        return self._decided(obs, None, noise, state)

    @torch.inference_mode()
    def act(self, obs: Obs, *, generator: torch.Generator | None = None, noise: Tensor | None = None) -> Tensor:
        """Choose the next actions; see `Policy.act`."""
        return self._decided(obs, generator, noise, None)[0]

    def initial_state(self, n: int) -> State | None:
        """Return what the policy remembers in n rows that have just been restarted; None without memory."""
        return self.head.initial_state(n)

    def with_head(self, head: ActionHead, name: str | None = None) -> ActionPolicy:
        """Return a policy that shares this one's encoder and normalizer and has another head."""
        transforms = dict(zip(self.transforms, self._transforms, strict=True))
        called, fitted = name or self.name, self.normalizer_config
        return ActionPolicy(
            called, self.spec, self.chunk, transforms, fitted, self.encoder, head, self.normalizer
        )  # fmt: skip

    def with_nfe(self, nfe: int) -> ActionPolicy:
        """Return a policy that shares this one's weights and evaluates its network `nfe` times a decision.

        Raises ConfigError where its head cannot.
        """
        return self.with_head(self.head.with_nfe(nfe))

    def one_step(self) -> ActionPolicy | None:
        """Return the control of a distillation: this policy with its network evaluated once; None without one."""
        head = self.head.one_step()
        return None if head is None else self.with_head(head, f"{self.name}_one_step")

    @property
    def _transforms(self) -> list[InputTransform]:
        return list(self.transforms.values())  # type: ignore[arg-type]

    def _encoded(self, obs: Obs, read: Callable[[InputTransform, Obs], Obs]) -> Features:
        for transform in self._transforms:
            obs = read(transform, obs)
        ranged = self.normalizer.fields
        normalized = {key: self.normalizer.normalize(key, obs[key]) if key in ranged else obs[key] for key in self.keys}
        for transform in self._transforms:
            normalized = transform.normalized(normalized, obs)
        return self.encoder(normalized)

    def _decided(
        self, obs: Obs, generator: torch.Generator | None, noise: Tensor | None, state: State | None
    ) -> tuple[Tensor, State | None]:
        batch = check_obs(obs, self.spec, self.chunk, self.keys)
        obs = finite_obs({key: obs[key] for key in self.keys}, self.spec)
        draws = starting_noise(self, batch, generator, noise)
        features = self.encode(obs, draws[0] if draws else None)
        chunk, state = self.head.act(features, draws, state)
        actions = self.normalizer.unnormalize(ACTION, chunk[:, self.chunk.executed])
        require_finite_actions(actions, self.name)
        return actions.clamp(-1.0, 1.0), state


class Parts(NamedTuple):
    """A configuration, read: each part's class and its fields.

    Attributes:
        inputs: name -> transform.
        normalizer: how the normalizer is fitted.
        encoder: that of the observations.
        backbone: None where the head needs none.
        head: makes actions.
    """

    inputs: dict[str, tuple[type[InputTransform], Any]]
    normalizer: NormalizerConfig
    encoder: tuple[type[ObsEncoder], Any]
    backbone: tuple[type[Backbone], Any] | None
    head: tuple[type[ActionHead], Any]


def read_parts(config: Nested) -> Parts:
    """Return what a configuration says; arguments and errors as those of `build_policy`."""
    for key in config:
        if key not in SECTIONS:
            raise UnknownNameError("configuration key", key, (*SECTIONS, "chunk", "training"))
    inputs = config.get("inputs") or {}
    if not isinstance(inputs, Mapping):
        raise ConfigError(f"inputs takes the fields of each transform, as in inputs.points.max_points; got {inputs!r}")
    transforms: dict[str, tuple[type[InputTransform], Any]] = {}
    for key, fields in inputs.items():
        kind = TRANSFORMS.get(key)
        transforms[key] = kind, section(kind.Config, _mapping(fields, f"inputs.{key}"), f"inputs.{key}")
    encoder, head = _part(ENCODERS, config, "encoder"), _part(HEADS, config, "head")
    backbone = _part(BACKBONES, config, "backbone") if config.get("backbone") else None
    called = config["head"][NAME]
    if head[0].needs_backbone and backbone is None:
        raise ConfigError(f"the head {called!r} needs a backbone: name one of {', '.join(BACKBONES.names())}")
    if backbone is not None and not head[0].needs_backbone:
        raise ConfigError(f"the head {called!r} runs no backbone: set backbone=null, and no field of it")
    fitted = section(NormalizerConfig, _mapping(config.get("normalizer") or {}, "normalizer"), "normalizer")
    return Parts(transforms, fitted, encoder, backbone, head)


def keys_read(config: Nested, spec: EnvSpec) -> tuple[str, ...]:
    """Return the observations that a policy of this configuration reads (`ActionPolicy.keys`) without building it."""
    parts = read_parts(config)
    transforms = {key: kind(fields, spec) for key, (kind, fields) in parts.inputs.items()}
    return _keys(parts.encoder[0].keys, _effective(transforms, parts.encoder[0].keys))


def build_policy(name: str, config: Nested, spec: EnvSpec, chunk: ChunkSpec) -> ActionPolicy:
    """Return the untrained policy that a configuration describes.

    Args:
        name: of the method, for messages and checkpoints.
        config: the sections `inputs` (transform -> its fields), `normalizer`, `encoder`, `backbone` (null where the
            head needs none) and `head`; fields that are missing take the published values.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta.

    Raises:
        UnknownNameError: there is no such section, field, encoder, backbone, head or transform.
        ConfigError: a value is of another type or out of range, or parts do not fit together, `spec` or `chunk`.
    """
    parts = read_parts(config)
    try:
        return _built(name, parts, spec, chunk)
    except RuntimeError as error:  # of the allocator, as a rule: sizes that no machine holds
        raise ConfigError(f"{name} cannot be built with these sizes: {' '.join(str(error).split())}") from error


def _built(name: str, parts: Parts, spec: EnvSpec, chunk: ChunkSpec) -> ActionPolicy:
    transforms = {key: kind(fields, spec) for key, (kind, fields) in parts.inputs.items()}
    encoder_kind, encoder_fields = parts.encoder
    encoder = encoder_kind(encoder_fields, spec, chunk)
    head_kind, head_fields = parts.head
    backbone = None
    if parts.backbone is not None:
        kind, fields = parts.backbone
        backbone = kind(fields, chunk, spec.action.dim, encoder.shape, head_kind.times)
    head = head_kind(head_fields, backbone, chunk, spec.action.dim, encoder.shape)
    return ActionPolicy(name, spec, chunk, transforms, parts.normalizer, encoder, head)


def _effective(transforms: Mapping[str, InputTransform], keys: Sequence[str]) -> dict[str, InputTransform]:
    """Return the transforms that change what an encoder of `keys` reads, or do not say what they change."""
    return {name: t for name, t in transforms.items() if not t.changes or set(t.changes) & set(keys)}


def _keys(keys: Sequence[str], transforms: Mapping[str, InputTransform]) -> tuple[str, ...]:
    return tuple(dict.fromkeys([*keys, *(key for t in transforms.values() for key in t.reads)]))


def _part(registry: Registry[Any], config: Nested, key: str) -> tuple[Any, Any]:
    """Return the class that a section names and its configuration."""
    values = dict(_mapping(config.get(key) or {}, key))
    if NAME not in values:
        fields = f": there is none that {', '.join(values)} could be of" if values else ""
        raise ConfigError(f"{key} has no {NAME}{fields}; name one of {', '.join(registry.names())}")
    name = values.pop(NAME)
    if not isinstance(name, str):
        raise ConfigError(f"{key}.{NAME} takes a word, got {name!r}")
    kind = registry.get(name)
    return kind, section(kind.Config, values, key)


def _mapping(value: Any, path: str) -> Nested:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{path} takes keys of its own, got {value!r}")
    return value


def _name_of(registry: Registry[Any], part: Any) -> str:
    name = registry.name_of(type(getattr(part, "_orig_mod", part)))  # what `torch.compile` wraps
    if name is None:
        raise ConfigError(f"a {type(part).__name__} cannot be described: it is no registered {registry.kind}")
    return name


def _channels(spec: EnvSpec, keys: tuple[str, ...]) -> dict[str, int]:
    """Return the channels of what is normalised by its range: the last axis of each observation, and the actions."""
    fields = {key: spec.observation(key) for key in keys}
    shapes = {key: field.shape for key, field in fields.items() if field.by_range}
    if unfit := [key for key, shape in shapes.items() if shape[-1] == ANY]:
        raise ConfigError(f"{', '.join(unfit)} has no fixed number of channels, so that it cannot be normalised")
    return {**{key: shape[-1] for key, shape in shapes.items()}, ACTION: spec.action.dim}
