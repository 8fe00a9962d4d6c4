"""What a method is: a row of the table in `methods`, the parts with their published values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from manicm_ms.errors import ConfigError
from manicm_ms.policies.action_policy import NormalizerConfig, read_parts
from manicm_ms.policies.backbones.backbone import BACKBONES
from manicm_ms.policies.configuration import NAME, PARTS, Nested, merged, section
from manicm_ms.policies.encoders.encoder import ENCODERS
from manicm_ms.policies.encoders.transform import TRANSFORMS
from manicm_ms.policies.heads.head import HEADS
from manicm_ms.registry import TASKS, Registry
from manicm_ms.spec import ChunkSpec


@dataclass(frozen=True, kw_only=True)
class Method:
    """A row: the parts of a method with their published values.

    Attributes:
        sentence: what it is, for users.
        reference: where it was published.
        encoder: name, or a mapping with `name` and the fields that differ from the encoder's own values.
        backbone: the same for the network; None where the head needs none.
        head: the same for the head.
        objective: how it is trained: a name in `OBJECTIVES` for what learns from demonstrations, in `DISTILLATIONS` for
            what learns from a teacher.
        chunk: To, Tp, Ta.
        size_chunks: name of a size -> chunk, where it is another one.
        inputs: transform -> its fields, in order.
        optimizer: fields of a training that are the method's rather than a preset's, as `weight_decay`.
        nfe: network evaluations of one decision.
        teachers: of a student: the methods that it is distilled from, the usual one first.
    """

    sentence: str
    reference: str
    encoder: str | Nested
    head: str | Nested
    objective: str
    nfe: int
    chunk: ChunkSpec
    backbone: str | Nested | None = None
    size_chunks: Mapping[str, ChunkSpec] = field(default_factory=dict)
    inputs: Mapping[str, Nested] = field(default_factory=dict)
    optimizer: Nested = field(default_factory=dict)
    teachers: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for key in PARTS:
            part = getattr(self, key)
            told = described(part)
            optional = key == "backbone" and part is None
            if not optional and not (isinstance(told, Mapping) and isinstance(told.get(NAME), str)):
                raise ConfigError(
                    f"{key} of a method is a name, or a mapping with {NAME!r} and its fields; got {part!r}"
                )
        if not all(isinstance(fields, Mapping) for fields in self.inputs.values()):
            raise ConfigError(f"inputs of a method is a mapping of transforms to their fields, got {self.inputs!r}")
        for lengths in (self.chunk, *self.size_chunks.values()):
            if not isinstance(lengths, ChunkSpec):
                raise ConfigError(f"chunk of a method is a ChunkSpec, got {lengths!r}")

    def chunk_of(self, size: str, changes: Nested | None = None) -> ChunkSpec:
        """Return To, Tp, Ta with a size, with fields of `changes` in place of its own.

        Raises UnknownNameError or ConfigError where these are no lengths that fit together.
        """
        own = self.size_chunks.get(size, self.chunk)
        lengths = {"n_obs_steps": own.n_obs_steps, "horizon": own.horizon, "n_action_steps": own.n_action_steps}
        return section(ChunkSpec, {**lengths, **(changes or {})}, "chunk")

    def configuration(self, size: str = "paper", changes: Nested | None = None) -> dict[str, Any]:
        """Return the nested configuration of a policy: the row, then what the size says of each part, then `changes`.

        Args:
            size: "paper" for the published values, "quick" or "smoke" for each part's own smaller ones.
            changes: sections as those of `build_policy`; one that names another part than the row takes that part's
                values of this size.

        Raises:
            UnknownNameError, ConfigError: the row, or `changes`, names what does not exist or fit; see `build_policy`.
        """
        changes = changes or {}
        row = {
            "inputs": self.inputs,
            "normalizer": {},
            **{key: described(getattr(self, key)) for key in ("encoder", "backbone", "head")},
        }
        chosen = merged(row, changes)
        for key, registry in (("encoder", ENCODERS), ("backbone", BACKBONES), ("head", HEADS)):
            if isinstance(chosen[key], Mapping) and isinstance(chosen[key].get(NAME), str):
                name = chosen[key][NAME]
                start = row[key] if row[key] and row[key][NAME] == name else {NAME: name}
                chosen[key] = merged(merged(start, registry.get(name).sizes.get(size, {})), described(changes.get(key)))
        if isinstance(chosen["inputs"], Mapping):
            chosen["inputs"] = {
                key: _changed(
                    merged(self.inputs.get(key, {}), TRANSFORMS.get(key).sizes.get(size, {})),
                    (changes.get("inputs") or {}).get(key),
                )
                for key in chosen["inputs"]
            }
        chosen["normalizer"] = _changed(NormalizerConfig.sizes.get(size, {}), changes.get("normalizer"))
        read_parts(chosen)
        return chosen


def _changed(fields: Nested, changes: Any) -> Any:
    """Return fields with changes; what is no mapping stands as it is, for `build_policy` to refuse with its path."""
    return merged(fields, changes or {}) if changes is None or isinstance(changes, Mapping) else changes


def described(part: str | Nested | None) -> Any:
    """Return a part of a row as a mapping with its name."""
    return {NAME: part} if isinstance(part, str) else part or {}


METHODS: Registry[Method] = Registry("method", group="manicm_ms.methods", outside=TASKS)
"""name -> row."""
