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

_MANICM = "Gao, Lu et al. 2024, ManiCM, arXiv:2406.01586"
_ROBOMIMIC = "Mandlekar et al. 2021, robomimic, arXiv:2108.03298"
_SIMPLE_UNET = {NAME: "unet1d", "down_dims": (128, 256, 384), "resnets_per_stage": 1, "mid_blocks": 1}
_PLAIN_ADAM: Nested = {"betas": (0.9, 0.999), "weight_decay": 0.0}  # robomimic's

# The other rows say how they depart from this one.
_DP3 = Method(
    sentence="DP3's diffusion teacher: a U-Net of 512, 1024 and 2048 channels, evaluated 10 times a decision.",
    reference="Ze et al. 2024, 3D Diffusion Policy, arXiv:2403.03954",
    encoder="dp3",
    backbone="unet1d",
    head="diffusion",
    objective="averaged",
    nfe=10,
    chunk=ChunkSpec(2, 4, 3),
    size_chunks={"paper": ChunkSpec(2, 4, 2)},  # ManiCM, section 4.1
    inputs={"cloud_crop": {}, "points": {}, "cloud_frame": {}},
)
METHODS.add("dp3", _DP3)
METHODS.add(
    "simple_dp3",
    replace(
        _DP3,
        sentence="Simple DP3's diffusion teacher: the same with a U-Net of 128, 256 and 384 channels.",
        backbone=_SIMPLE_UNET,
    ),
)
METHODS.add(
    "dp",
    replace(
        _DP3,
        sentence="Diffusion Policy from images: its hybrid ResNet-18 encoder on DP3's protocol, predicting noise.",
        reference="Chi et al. 2023, Diffusion Policy, arXiv:2303.04137",
        encoder="image",
        head={NAME: "diffusion", "prediction_type": "epsilon"},
        inputs={"image_crop": {}},
    ),
)
METHODS.add(
    "voxel_dp",
    replace(
        _DP3,
        sentence="DP3's teacher from voxel grids: eight 3D convolutions in place of the encoder of clouds.",
        reference="encoder: Wang et al. 2024, Equivariant Diffusion Policy, arXiv:2407.01812",
        encoder="voxel",
        inputs={"voxel_crop": {}},
    ),
)
METHODS.add(
    "pocket_dp3",
    replace(
        _DP3,
        sentence="Pocket DP3: a mixer of 2.5 million weights in place of the U-Net, evaluated twice a decision.",
        reference="arXiv:2601.22018, arXiv:2605.01581",
        backbone="mixer",
        head={NAME: "diffusion", "num_inference_steps": 2},
        nfe=2,
    ),
)


def _student_row(teachers: tuple[str, ...], sentence: str) -> Method:
    """Return the row of what is distilled as ManiCM: the last teacher's parts with a student's head."""
    row = METHODS.get(teachers[-1])
    shared = ("prediction_type", "num_train_timesteps", "beta_schedule", "clip_range")
    process = {name: value for name, value in described(row.head).items() if name in shared}
    spacing = PREDICTIONS.get(process.get("prediction_type", "sample")).timestep_spacing
    head = {NAME: "consistency", **process, "timestep_spacing": spacing}
    return replace(
        row, sentence=sentence, reference=f"{_MANICM}; teacher: {row.reference}", head=head, objective="consistency",
        nfe=1, teachers=teachers,
    )  # fmt: skip


for _name, _teachers, _sentence in (
    (STUDENT, ("simple_dp3", "dp3"), "ManiCM's student, distilled from DP3 or Simple DP3: evaluated once a decision."),
    ("image_manicm", ("dp",), "ManiCM from camera images: the student of dp, evaluated once a decision."),
    ("voxel_manicm", ("voxel_dp",), "ManiCM from voxel grids: the student of voxel_dp, evaluated once a decision."),
    (
        "pocket_manicm",
        ("pocket_dp3",),
        "Pocket DP3's student, distilled as ManiCM: the mixer evaluated once a decision.",
    ),
):
    METHODS.add(_name, _student_row(_teachers, _sentence))

METHODS.add(
    "bc_gmm_3d",
    replace(
        _DP3,
        sentence="Behaviour cloning with a mixture of 5 Gaussians, one action a decision.",
        reference=_ROBOMIMIC,
        backbone=None,
        head="gmm",
        objective="plain",
        nfe=1,
        chunk=ChunkSpec(1, 1, 1),
        size_chunks={},
        optimizer=_PLAIN_ADAM,
    ),
)
METHODS.add(
    "bc_rnn_3d",
    replace(
        _DP3,
        sentence="Behaviour cloning with an LSTM over the last 10 frames, one action a decision.",
        reference=_ROBOMIMIC,
        backbone=None,
        head="rnn",
        objective="plain",
        nfe=1,
        chunk=ChunkSpec(10, 10, 1),
        size_chunks={},
        optimizer=_PLAIN_ADAM,
    ),
)
METHODS.add(
    "meanflow",
    replace(
        _DP3,
        sentence="MeanFlow: one evaluation a decision, learnt from demonstrations without a teacher.",
        reference="Geng et al. 2025, arXiv:2505.13447; MP1, arXiv:2507.10543",
        backbone=_SIMPLE_UNET,
        head="meanflow",
        nfe=1,
    ),
)
METHODS.add(
    "drift",
    replace(
        _DP3,
        sentence="Drifting: samples move to demonstrations and away from one another; one evaluation, no teacher.",
        reference="Deng et al. 2026, arXiv:2602.04770; DBP, arXiv:2604.03540",
        backbone=_SIMPLE_UNET,
        head="drift",
        nfe=1,
    ),
)
METHODS.add(
    "uca_flow",
    replace(
        _DP3,
        sentence="UCA-Flow: average velocity on joint tokens of frames and actions; one evaluation, no teacher.",
        reference="arXiv:2608.16153",
        backbone="tokens",
        head="uca_flow",
        nfe=1,
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
