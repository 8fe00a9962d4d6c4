"""What identifies an evaluation in its folder, and the command line that asks for it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manicm_ms.evaluation.decided import StoppingRule
from manicm_ms.evaluation.protocol import CLEAN, CONTROL, OBS_PRESET, OTHER, STUDENT, TEACHER, EvaluatedPolicy, Protocol
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.realism import REALISM

if TYPE_CHECKING:
    from manicm_ms.envs.env_request import EnvRequest


def identity_of(
    protocol: Protocol,
    policies: Sequence[EvaluatedPolicy],
    env: EnvRequest,
    device: str,
    rule: StoppingRule | None = None,
) -> dict[str, Any]:
    """Return what identifies an evaluation in its folder: an interrupted one goes on where all of it is the same."""
    return {
        "env_id": protocol.env_id,
        "seed": protocol.seeds[0],
        "episodes": len(protocol.seeds),
        "backend": env.backend,
        "device": device,
        "policies": [[c.name, _place(i, c), c.digest] for i, c in enumerate(policies)],
        **requested_realism(protocol.realism, env.camera_model),
        **({} if rule is None else rule.identity()),
        **({} if env.obs_preset == OBS_PRESET else {"obs_preset": env.obs_preset}),
    }


def _place(index: int, policy: EvaluatedPolicy) -> str:
    """Return what folders of all versions call the place of a policy in the list; its role is another matter."""
    return policy.role if policy.role in (CONTROL, OTHER) else STUDENT if index else TEACHER


def requested_realism(presets: tuple[str, ...], camera: CameraModel | None) -> dict[str, Any]:
    """Return what identifies presets and camera of an evaluation; nothing in the ideal world, as ever."""
    requested: dict[str, Any] = {}
    if presets != (CLEAN,):
        requested["realism"] = [[name, REALISM.get(name).to_dict()] for name in presets]
    if camera is not None:
        requested["camera"] = camera.to_dict()
    return requested


def command_of(
    checkpoints: Sequence[Path],
    policies: Sequence[str],
    env: EnvRequest,
    episodes: int,
    seed: int,
    out: Path,
    allow_seen_seeds: bool,
    to_the_end: bool,
    rule: StoppingRule | None = None,
) -> str:
    """Return the command line of `evaluate` with these arguments; those left at their default are left out."""
    flags = (["--allow-seen-seeds"] if allow_seen_seeds else []) + ([] if to_the_end else ["--no-to-the-end"])
    flags += [] if rule is None else ["--until-decided", "--margin", f"{100 * rule.margin:g}"]
    words = ["manicm-ms", "evaluate", *map(str, checkpoints), "--env", env.env_id]
    words += [word for source in policies for word in ("--policy", source)]
    words += ["--episodes", str(episodes), "--seed", str(seed), "--out", str(out)]
    return shlex.join([*words, *env.options(), *flags])
