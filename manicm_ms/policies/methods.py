"""The table of methods: one row each. What a row names is registered by the files beside this one, or by a user's own.

A new method is one row, and one file for each part that does not exist yet (docs/guides/add_a_method.md).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch

from manicm_ms.errors import ConfigError
from manicm_ms.policies.action_policy import ActionPolicy, NormalizerConfig, build_policy, read_parts
from manicm_ms.policies.backbones.backbone import BACKBONES
from manicm_ms.policies.configuration import NAME, PARTS, Nested, merged, section
from manicm_ms.policies.encoders.encoder import ENCODERS
from manicm_ms.policies.encoders.transform import TRANSFORMS
from manicm_ms.policies.heads.consistency import ConsistencyHead
from manicm_ms.policies.heads.diffusion import DiffusionHead
from manicm_ms.policies.heads.head import HEADS
from manicm_ms.policies.policy import ChannelStats
from manicm_ms.registry import TASKS, Registry
from manicm_ms.spec import ChunkSpec, EnvSpec

STUDENT = "manicm"
"""The method that a distillation makes."""


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

    def __post_init__(self) -> None:
        for key in PARTS:
            part = getattr(self, key)
            described = _described(part)
            optional = key == "backbone" and part is None
            if not optional and not (isinstance(described, Mapping) and isinstance(described.get(NAME), str)):
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
            **{key: _described(getattr(self, key)) for key in ("encoder", "backbone", "head")},
        }
        chosen = merged(row, changes)
        for key, registry in (("encoder", ENCODERS), ("backbone", BACKBONES), ("head", HEADS)):
            if isinstance(chosen[key], Mapping) and isinstance(chosen[key].get(NAME), str):
                name = chosen[key][NAME]
                start = row[key] if row[key] and row[key][NAME] == name else {NAME: name}
                chosen[key] = merged(
                    merged(start, registry.get(name).sizes.get(size, {})), _described(changes.get(key))
                )
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


def _described(part: str | Nested | None) -> Any:
    return {NAME: part} if isinstance(part, str) else part or {}


METHODS: Registry[Method] = Registry("method", group="manicm_ms.methods", outside=TASKS)
"""name -> row."""

_CLOUD_INPUTS: Mapping[str, Nested] = {"points": {}, "cloud_frame": {}}
_DP3 = "Ze et al. 2024, 3D Diffusion Policy, arXiv:2403.03954"
_PAPER = {"paper": ChunkSpec(2, 4, 2)}  # ManiCM, section 4.1
_SIMPLE_UNET = {NAME: "unet1d", "down_dims": (128, 256, 384), "resnets_per_stage": 1, "mid_blocks": 1}

METHODS.add(
    "dp3",
    Method(
        sentence="DP3's diffusion teacher: a U-Net of 512, 1024 and 2048 channels, evaluated 10 times a decision.",
        reference=_DP3,
        encoder="dp3",
        backbone="unet1d",
        head="diffusion",
        objective="averaged",
        nfe=10,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs=_CLOUD_INPUTS,
    ),
)
METHODS.add(
    "simple_dp3",
    Method(
        sentence="Simple DP3's diffusion teacher: the same with a U-Net of 128, 256 and 384 channels.",
        reference=_DP3,
        encoder="dp3",
        backbone=_SIMPLE_UNET,
        head="diffusion",
        objective="averaged",
        nfe=10,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs=_CLOUD_INPUTS,
    ),
)
METHODS.add(
    "dp",
    Method(
        sentence="Diffusion Policy from images: its hybrid ResNet-18 encoder on DP3's protocol, predicting noise.",
        reference="Chi et al. 2023, Diffusion Policy, arXiv:2303.04137",
        encoder="image",
        backbone="unet1d",
        head={NAME: "diffusion", "prediction_type": "epsilon"},
        objective="averaged",
        nfe=10,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs={"image_crop": {}},
    ),
)
METHODS.add(
    "voxel_dp",
    Method(
        sentence="DP3's teacher from voxel grids: eight 3D convolutions in place of the encoder of clouds.",
        reference="encoder: Wang et al. 2024, Equivariant Diffusion Policy, arXiv:2407.01812",
        encoder="voxel",
        backbone="unet1d",
        head="diffusion",
        objective="averaged",
        nfe=10,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs={"voxel_crop": {}},
    ),
)
METHODS.add(
    STUDENT,
    Method(
        sentence="ManiCM's student, distilled from either teacher: evaluated once a decision.",
        reference="Gao, Lu et al. 2024, ManiCM, arXiv:2406.01586",
        encoder="dp3",
        backbone="unet1d",
        head="consistency",
        objective="consistency",
        nfe=1,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs=_CLOUD_INPUTS,
    ),
)
METHODS.add(
    "bc_gmm_3d",
    Method(
        sentence="Behaviour cloning with a mixture of 5 Gaussians, one action a decision.",
        reference="Mandlekar et al. 2021, robomimic, arXiv:2108.03298",
        encoder="dp3",
        head="gmm",
        objective="plain",
        nfe=1,
        chunk=ChunkSpec(1, 1, 1),
        inputs=_CLOUD_INPUTS,
        optimizer={"betas": (0.9, 0.999), "weight_decay": 0.0},
    ),
)
METHODS.add(
    "pocket_dp3",
    Method(
        sentence="Pocket DP3: a mixer of 2.5 million weights in place of the U-Net, evaluated twice a decision.",
        reference="arXiv:2601.22018, arXiv:2605.01581",
        encoder="dp3",
        backbone="mixer",
        head={NAME: "diffusion", "num_inference_steps": 2},
        objective="averaged",
        nfe=2,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs=_CLOUD_INPUTS,
    ),
)
METHODS.add(
    "bc_rnn_3d",
    Method(
        sentence="Behaviour cloning with an LSTM over the last 10 frames, one action a decision.",
        reference="Mandlekar et al. 2021, robomimic, arXiv:2108.03298",
        encoder="dp3",
        head="rnn",
        objective="plain",
        nfe=1,
        chunk=ChunkSpec(10, 10, 1),
        inputs=_CLOUD_INPUTS,
        optimizer={"betas": (0.9, 0.999), "weight_decay": 0.0},
    ),
)


def methods_of(role: str) -> tuple[str, ...]:
    """Return the names of the methods whose head has this role in a distillation."""
    heads = {name: HEADS.get(name).role for name in HEADS.names()}  # a row may name a head that does not exist
    return tuple(name for name in METHODS.names() if heads.get(_described(METHODS.get(name).head)[NAME]) == role)


def make_policy(
    name: str,
    spec: EnvSpec,
    chunk: ChunkSpec | None = None,
    config: Nested | None = None,
    *,
    size: str = "paper",
    stats: Mapping[str, ChannelStats] | None = None,
    seed: int | None = None,
) -> ActionPolicy:
    """Build an untrained policy.

    Args:
        name: a name in `METHODS`.
        spec: the environment that it is made for.
        chunk: To, Tp, Ta; the method's own where None.
        config: departures from the method's configuration, for example
            `{"backbone": {"down_dims": (64, 128, 256)}, "inputs": {"cloud_frame": {"frame": "tcp"}}}`.
        size: "paper", "quick" or "smoke"; see `Method.configuration`.
        stats: ranges of the training data; without them the normalizer is the identity.
        seed: of the initial weights; torch's default generator is left as it was. None draws from it.

    Raises:
        UnknownNameError: no method, part or field has this name.
        ConfigError: a value is out of range, or does not fit `spec` or `chunk`.
    """
    row = METHODS.get(name)
    full, lengths = row.configuration(size, config), chunk or row.chunk_of(size)
    if seed is None:
        policy = build_policy(name, full, spec, lengths)
    else:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            policy = build_policy(name, full, spec, lengths)
    if stats is not None:
        policy.fit_normalizer(stats)
    return policy


def student_of(teacher: ActionPolicy, nfe: int = 1, **consistency: Any) -> ActionPolicy:
    """Return a student that starts from a copy of the teacher's weights and normalizer.

    Args:
        teacher: a trained policy, left untouched.
        nfe: network evaluations of one decision.
        **consistency: further fields of `ConsistencyConfig`.

    Raises:
        ConfigError: the policy cannot be distilled, or the fields do not fit.
    """
    head = teacher.head
    if not isinstance(head, DiffusionHead):
        raise ConfigError(f"{teacher.name} cannot be distilled: give one of {', '.join(methods_of('teacher'))}")
    return copy.deepcopy(teacher.with_head(ConsistencyHead.from_teacher(head, nfe, **consistency), STUDENT))


def with_nfe(student: ActionPolicy, nfe: int) -> ActionPolicy:
    """Return a policy that shares a student's weights and evaluates its network `nfe` times a decision."""
    assert isinstance(student.head, ConsistencyHead)
    return student.with_head(student.head.with_nfe(nfe))
