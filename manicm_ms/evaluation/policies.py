"""Loads the policies of an evaluation: names, roles, and whether the environment can serve them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.evaluation.origins import Origin, require_unseen
from manicm_ms.evaluation.protocol import CONTROL, OTHER, STUDENT, TEACHER, EvaluatedPolicy
from manicm_ms.paths import sha256
from manicm_ms.spec import DP3_FRAME, EnvSpec, require_compatible

if TYPE_CHECKING:
    from manicm_ms.policies.base import Policy


def load_policies(checkpoints: Sequence[Path], device: str = "cpu", control: bool = True) -> list[EvaluatedPolicy]:
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
    policies = []
    for name, path in zip(names, paths, strict=True):
        policy = load_checkpoint(path, device=device)
        origin = Origin.read(policy.spec.env_id, read_manifest(path)["provenance"])
        policies.append(EvaluatedPolicy(name, role_of(policy), str(path), policy, origin))
    first = policies[0]
    if control and isinstance(first.policy, DiffusionPolicy):
        one_step = replace(first, name=f"{first.name}, one step", role=CONTROL, policy=OneStepTeacher(first.policy))
        policies.insert(1, one_step)
    return policies


def role_of(policy: Policy) -> str:
    """Return the role of a checkpoint's policy, by the tag that it is registered with."""
    from manicm_ms.policies.base import POLICIES

    tags = POLICIES.tags(policy.name)
    return next((role for role in (TEACHER, STUDENT) if role in tags), OTHER)


def require_playable(policies: Sequence[EvaluatedPolicy], offered: EnvSpec, held_out: Sequence[int]) -> None:
    """Raise before anything is written where a policy cannot, or must not, be evaluated.

    Args:
        policies: all of the evaluation.
        offered: what the environment can serve.
        held_out: seeds that no policy may have seen as demonstrations.

    Raises:
        ConfigError: one has seen some of the seeds.
        SpecMismatchError: the environment cannot serve one of them.
    """
    require_unseen(policies, offered.env_id, held_out)
    require_made_for(offered, policies)


def require_made_for(spec: EnvSpec, policies: Sequence[EvaluatedPolicy]) -> None:
    """Raise SpecMismatchError before anything is written where the environment cannot serve one of the policies."""
    for evaluated in policies:
        theirs = evaluated.policy.spec
        if theirs.obs.frame == DP3_FRAME != spec.obs.frame:
            raise SpecMismatchError(
                f"checkpoint {evaluated.checkpoint} learnt from clouds of the observation preset dp3: "
                "add --obs-preset dp3"
            )
        # The environment is made with or without colours, as the policy wants.
        offered = replace(spec, obs=replace(spec.obs, point_channels=theirs.obs.point_channels))
        require_compatible(offered, theirs, f"environment {spec.env_id}", f"checkpoint {evaluated.checkpoint}")


def checkpoint_digest(folder: str) -> str:
    """Return what tells this checkpoint from another one under the same path: its manifest's SHA-256."""
    return sha256(Path(folder) / "manifest.json")
