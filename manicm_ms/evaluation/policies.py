"""Loads the policies of an evaluation: names, roles, and whether the environment can serve them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.evaluation.origins import Origin, require_unseen
from manicm_ms.evaluation.protocol import CONTROL, OTHER, STUDENT, TEACHER, EvaluatedPolicy, slug
from manicm_ms.paths import sha256
from manicm_ms.spec import DP3_FRAME, EnvSpec, require_compatible

if TYPE_CHECKING:
    from manicm_ms.policies.action_policy import ActionPolicy


def load_policies(checkpoints: Sequence[Path], device: str = "cpu", control: bool = True) -> list[EvaluatedPolicy]:
    """Load the checkpoints, with the control row behind the first where it is a teacher and the row is asked for.

    Names are the folders' names, with their parents' where two are alike. FOLDER@N is the checkpoint FOLDER with its
    network evaluated N times a decision.

    Raises ConfigError where a network cannot be evaluated so often, CheckpointError where a checkpoint cannot be read.
    """
    from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest

    asked = [AskedCheckpoint.read(p) for p in checkpoints]
    names = _names(asked)
    loaded = [load_checkpoint(a.folder, device=device) for a in asked]
    policies = []
    for name, place, whole in zip(names, asked, loaded, strict=True):
        origin = Origin.read(whole.spec.env_id, read_manifest(place.folder)["provenance"])
        policy = whole if place.nfe is None else whole.with_nfe(place.nfe)
        role, digest = role_of(policy), checkpoint_digest(str(place.folder))
        policies.append(EvaluatedPolicy(name, role, str(place), policy, origin, digest))
    if control and loaded and (once := loaded[0].one_step()) is not None:
        named = f"{policies[0].name}, one step"
        policies.insert(1, replace(policies[0], name=named, role=CONTROL, policy=once))
    return policies


class AskedCheckpoint(NamedTuple):
    """A checkpoint as the caller names it: its folder, and network evaluations where they are not its own."""

    folder: Path
    nfe: int | None = None

    @classmethod
    def read(cls, path: Path) -> AskedCheckpoint:
        """Return what FOLDER or FOLDER@N names; a folder whose own name ends so is that folder."""
        folder, at, number = str(path).rpartition("@")
        if at and number.isdecimal() and not Path(path).exists():
            return cls(Path(folder), int(number))
        return cls(Path(path))

    def __str__(self) -> str:
        return str(self.folder) if self.nfe is None else f"{self.folder}@{self.nfe}"


def _names(asked: Sequence[AskedCheckpoint]) -> list[str]:
    """Return a name for each checkpoint, no two alike."""
    ends = ["" if a.nfe is None else f"@{a.nfe}" for a in asked]
    names = [f"{a.folder.resolve().name}{end}" for a, end in zip(asked, ends, strict=True)]
    if _alike(names):
        longer = [f"{a.folder.resolve().parent.name}/{a.folder.resolve().name}" for a in asked]
        names = [f"{name}{end}" for name, end in zip(longer, ends, strict=True)]
    if _alike(names):
        raise ConfigError(f"two checkpoints have one name ({', '.join(names)}): name different ones")
    return names


def _alike(names: Sequence[str]) -> bool:
    """Return whether two names would share their files."""
    return len({slug(name) for name in names}) < len(names)


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
    """Return `name`, with a number behind it where it, or the name of its files, is taken."""
    files = {slug(other) for other in taken}
    numbered = (f"{name} {k}" for k in count(2))
    return name if slug(name) not in files else next(n for n in numbered if slug(n) not in files)


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
