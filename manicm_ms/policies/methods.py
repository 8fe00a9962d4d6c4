"""The table of methods: one row each. What a row names is registered by the files beside this one, or by a user's own.

A new method is one row, and one file for each part that does not exist yet (docs/guides/add_a_method.md).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from manicm_ms.errors import ConfigError
from manicm_ms.policies.action_policy import ActionPolicy, build_policy
from manicm_ms.policies.configuration import NAME, Nested
from manicm_ms.policies.heads.consistency import ConsistencyHead
from manicm_ms.policies.heads.diffusion import PREDICTIONS, DiffusionHead
from manicm_ms.policies.heads.head import HEADS
from manicm_ms.policies.method import METHODS, Method, described
from manicm_ms.policies.policy import ChannelStats
from manicm_ms.spec import ChunkSpec, EnvSpec

STUDENT = "manicm"
"""The method that a distillation makes of a teacher that no row names."""


_CLOUD_INPUTS: Mapping[str, Nested] = {"cloud_crop": {}, "points": {}, "cloud_frame": {}}
_DP3 = "Ze et al. 2024, 3D Diffusion Policy, arXiv:2403.03954"
_MANICM = "Gao, Lu et al. 2024, ManiCM, arXiv:2406.01586"
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


def _student_row(teacher: str, sentence: str) -> Method:
    """Return the row of what is distilled from a teacher as ManiCM: the teacher's parts with a student's head."""
    row = METHODS.get(teacher)
    shared = ("prediction_type", "num_train_timesteps", "beta_schedule", "clip_range")
    process = {name: value for name, value in described(row.head).items() if name in shared}
    spacing = PREDICTIONS.get(process.get("prediction_type", "sample")).timestep_spacing
    head = {NAME: "consistency", **process, "timestep_spacing": spacing}
    reference = f"{_MANICM}; the teacher's: {row.reference}"
    return replace(
        row, sentence=sentence, reference=reference, head=head, objective="consistency", nfe=1, teachers=(teacher,)
    )


METHODS.add(
    STUDENT,
    Method(
        sentence="ManiCM's student, distilled from DP3 or Simple DP3: evaluated once a decision.",
        reference=_MANICM,
        encoder="dp3",
        backbone="unet1d",
        head="consistency",
        objective="consistency",
        nfe=1,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs=_CLOUD_INPUTS,
        teachers=("simple_dp3", "dp3"),
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
    "pocket_manicm",
    _student_row("pocket_dp3", "Pocket DP3's student, distilled as ManiCM: the mixer evaluated once a decision."),
)
METHODS.add(
    "image_manicm", _student_row("dp", "ManiCM from camera images: the student of dp, evaluated once a decision.")
)
METHODS.add(
    "voxel_manicm",
    _student_row("voxel_dp", "ManiCM from voxel grids: the student of voxel_dp, evaluated once a decision."),
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
METHODS.add(
    "meanflow",
    Method(
        sentence="MeanFlow: one evaluation a decision, learnt from demonstrations without a teacher.",
        reference="Geng et al. 2025, arXiv:2505.13447; MP1, arXiv:2507.10543",
        encoder="dp3",
        backbone=_SIMPLE_UNET,
        head="meanflow",
        objective="averaged",
        nfe=1,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs=_CLOUD_INPUTS,
    ),
)
METHODS.add(
    "drift",
    Method(
        sentence="Drifting: samples move to demonstrations and away from one another; one evaluation, no teacher.",
        reference="Deng et al. 2026, arXiv:2602.04770; DBP, arXiv:2604.03540",
        encoder="dp3",
        backbone=_SIMPLE_UNET,
        head="drift",
        objective="averaged",
        nfe=1,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs=_CLOUD_INPUTS,
    ),
)
METHODS.add(
    "uca_flow",
    Method(
        sentence="UCA-Flow: average velocity on joint tokens of frames and actions; one evaluation, no teacher.",
        reference="arXiv:2608.16153",
        encoder="dp3",
        backbone="tokens",
        head="uca_flow",
        objective="averaged",
        nfe=1,
        chunk=ChunkSpec(2, 4, 3),
        size_chunks=_PAPER,
        inputs=_CLOUD_INPUTS,
    ),
)


def student_name(teacher: str) -> str:
    """Return the method that a distillation of this one makes."""
    return next((name for name in METHODS.names() if teacher in METHODS.get(name).teachers), STUDENT)


def methods_of(role: str) -> tuple[str, ...]:
    """Return the names of the methods whose head has this role in a distillation."""
    heads = {name: HEADS.get(name).role for name in HEADS.names()}  # a row may name a head that does not exist
    return tuple(name for name in METHODS.names() if heads.get(described(METHODS.get(name).head)[NAME]) == role)


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
        teacher: a trained policy, left untouched; the student's row is the one whose `teachers` name it.
        nfe: network evaluations of one decision.
        **consistency: further fields of `ConsistencyConfig`.

    Raises:
        ConfigError: the policy cannot be distilled, or the fields do not fit.
    """
    head = teacher.head
    if not isinstance(head, DiffusionHead):
        raise ConfigError(f"{teacher.name} cannot be distilled: give one of {', '.join(methods_of('teacher'))}")
    made = ConsistencyHead.from_teacher(head, nfe, **consistency)
    return copy.deepcopy(teacher.with_head(made, student_name(teacher.name)))


def head_with_nfe(method: str, nfe: int) -> Nested:
    """Return the section `head` with which a method evaluates its network `nfe` times a decision.

    Raises:
        UnknownNameError: no such method.
        ConfigError: it cannot.
    """
    row = METHODS.get(method)
    field_ = HEADS.get(described(row.head)[NAME]).nfe_field
    if field_ is None and nfe != row.nfe:
        raise ConfigError(f"{method} takes {row.nfe} network evaluations a decision and no other number, got {nfe}")
    changes = {} if field_ is None else {field_: nfe}
    row.configuration(changes={"head": changes})  # raises where the number is out of range
    return changes
