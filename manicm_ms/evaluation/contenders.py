"""The policies of an evaluation: their names, their roles, and whether the environment can serve them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.evaluation.origins import UNKNOWN, Origin
from manicm_ms.paths import sha256
from manicm_ms.spec import DP3_FRAME, EnvSpec, require_compatible

if TYPE_CHECKING:
    from manicm_ms.policies.base import Policy

TEACHER, CONTROL, STUDENT, OTHER = "teacher", "control", "student", "policy"
"""Roles: a diffusion policy, the same in one step without distillation, a distilled policy, any other."""


@dataclass(frozen=True)
class Contender:
    """A policy to be evaluated.

    Attributes:
        name: its name in tables and files, unique among the contenders.
        role: what its checkpoint is, one of the four above.
        checkpoint: folder it was loaded from, as the caller named it.
        policy: the policy itself, on the device it shall run on.
        origin: what its checkpoint says of its making.
    """

    name: str
    role: str
    checkpoint: str
    policy: Policy
    origin: Origin = UNKNOWN


def load_contenders(checkpoints: Sequence[Path], device: str = "cpu", control: bool = True) -> list[Contender]:
    """Load the checkpoints, with the control row behind the first where it is a teacher and the row is asked for.

    Names are the folders' names, with their parents' where two are alike.
    """
    from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest
    from manicm_ms.policies.diffusion import DiffusionPolicy, OneStepTeacher

    if not checkpoints:
        raise ConfigError("name at least one checkpoint folder")
    paths = [Path(p) for p in checkpoints]
    names = [p.resolve().name for p in paths]
    if len(set(names)) < len(names):
        names = [f"{p.resolve().parent.name}/{p.resolve().name}" for p in paths]
    if len(set(names)) < len(names):
        raise ConfigError(f"two checkpoints have one name ({', '.join(names)}): name different ones")
    contenders = []
    for name, path in zip(names, paths, strict=True):
        policy = load_checkpoint(path, device=device)
        origin = Origin.read(policy.spec.env_id, read_manifest(path)["provenance"])
        contenders.append(Contender(name, role_of(policy), str(path), policy, origin))
    first = contenders[0]
    if control and isinstance(first.policy, DiffusionPolicy):
        one_step = replace(first, name=f"{first.name}, one step", role=CONTROL, policy=OneStepTeacher(first.policy))
        contenders.insert(1, one_step)
    return contenders


def role_of(policy: Policy) -> str:
    """Return the role of a checkpoint's policy, by the tag that it is registered with."""
    from manicm_ms.policies.base import POLICIES

    tags = POLICIES.tags(policy.name)
    return next((role for role in (TEACHER, STUDENT) if role in tags), OTHER)


def require_made_for(spec: EnvSpec, contenders: Sequence[Contender]) -> None:
    """Raise SpecMismatchError before anything is written where the environment cannot serve one of the policies."""
    for contender in contenders:
        theirs = contender.policy.spec
        if theirs.obs.frame == DP3_FRAME != spec.obs.frame:
            raise SpecMismatchError(
                f"checkpoint {contender.checkpoint} learnt from clouds of the observation preset dp3: "
                "add --obs-preset dp3"
            )
        # The environment is made with or without colours, as the policy wants.
        offered = replace(spec, obs=replace(spec.obs, point_channels=theirs.obs.point_channels))
        require_compatible(offered, theirs, f"environment {spec.env_id}", f"checkpoint {contender.checkpoint}")


def checkpoint_digest(folder: str) -> str:
    """Return what tells this checkpoint from another one under the same path: its manifest's SHA-256."""
    return sha256(Path(folder) / "manifest.json")
