"""Loads the policies of an evaluation: names, roles, and whether the environment can serve them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.evaluation.origins import Origin, require_unseen
from manicm_ms.evaluation.protocol import CONTROL, OTHER, STUDENT, TEACHER, EvaluatedPolicy
from manicm_ms.paths import sha256
from manicm_ms.spec import DP3_FRAME, EnvSpec, require_compatible

if TYPE_CHECKING:
    from manicm_ms.policies.action_policy import ActionPolicy


def load_policies(checkpoints: Sequence[Path], device: str = "cpu", control: bool = True) -> list[EvaluatedPolicy]:
    """Load the checkpoints, with the control row behind the first where it is a teacher and the row is asked for.

    Names are the folders' names, with their parents' where two are alike.
    """
    from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest

    paths = [Path(p) for p in checkpoints]
    names = [p.resolve().name for p in paths]
    if len(set(names)) < len(names):
        names = [f"{p.resolve().parent.name}/{p.resolve().name}" for p in paths]
    if len(set(names)) < len(names):
        raise ConfigError(f"two checkpoints have one name ({', '.join(names)}): name different ones")
    policies = []
    loaded = [load_checkpoint(path, device=device) for path in paths]
    for name, path, policy in zip(names, paths, loaded, strict=True):
        origin = Origin.read(policy.spec.env_id, read_manifest(path)["provenance"])
        role, digest = role_of(policy), checkpoint_digest(str(path))
        policies.append(EvaluatedPolicy(name, role, str(path), policy, origin, digest))
    if control and loaded and (once := loaded[0].one_step()) is not None:
        named = f"{policies[0].name}, one step"
        policies.insert(1, replace(policies[0], name=named, role=CONTROL, policy=once))
    return policies


def with_users(policies: Sequence[EvaluatedPolicy], sources: Sequence[str], spec: EnvSpec) -> list[EvaluatedPolicy]:
    """Return the policies with those of the user's own behind them.

    Args:
        policies: loaded from checkpoints.
        sources: FILE.py:FUNCTION of each of the user's.
        spec: of the environment; theirs has clouds, pictures and grids as the first checkpoint's, where there is one.

    Raises:
        UserPolicyError: one cannot be made, or its first actions are unfit.
        ConfigError: there is no policy at all.
    """
    from manicm_ms.evaluation.user_policy import file_of, load_user_policy

    if not policies and not sources:
        raise ConfigError("name at least one checkpoint folder, or a policy of your own by --policy FILE.py:FUNCTION")
    if policies:
        seen = policies[0].policy.spec.obs
        forms = {n: getattr(seen, n) for n in ("num_points", "point_channels", "image_size", "voxel_size")}
        spec = replace(spec, obs=replace(spec.obs, **forms))
    found = list(policies)
    for source in sources:
        policy = load_user_policy(source, spec)
        name = _free_name(policy.name, {p.name for p in found})
        found.append(EvaluatedPolicy(name, OTHER, source, policy, digest=sha256(file_of(source))))
    return found


def _free_name(name: str, taken: Collection[str]) -> str:
    """Return `name`, with a number behind it where it is taken."""
    numbered = (f"{name} {k}" for k in count(2))
    return name if name not in taken else next(n for n in numbered if n not in taken)


def role_of(policy: ActionPolicy) -> str:
    """Return the role of a checkpoint's policy: what its head is in a distillation."""
    return policy.role if policy.role in (TEACHER, STUDENT) else OTHER


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
        require_compatible(offered, theirs, f"environment {spec.env_id}", _called(evaluated))


def _called(evaluated: EvaluatedPolicy) -> str:
    from manicm_ms.evaluation.user_policy import UserPolicy

    return f"{'policy' if isinstance(evaluated.policy, UserPolicy) else 'checkpoint'} {evaluated.checkpoint}"


def checkpoint_digest(folder: str) -> str:
    """Return what tells this checkpoint from another one under the same path: its manifest's SHA-256."""
    return sha256(Path(folder) / "manifest.json")
