"""The model card of a checkpoint, generated from what is known about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.methods import METHODS
from manicm_ms.spec import AGENT_POS, DEPTH, IMAGE, POINT_CLOUD, STATE, VOXEL_GRID, EnvSpec

LICENSE = "MIT"
_LONG_LIST = 12  # numbers; longer lists are shown by their range

_CHANNELS = {3: "x, y, z", 6: "x, y, z, r, g, b"}
_SEEN: Mapping[str, tuple[str, Callable[[EnvSpec], str]]] = {
    POINT_CLOUD: (
        "point clouds",
        lambda spec: f"clouds of {_CHANNELS[spec.obs.point_channels]} (metres, frame `{spec.obs.frame}`)"
    ),
    AGENT_POS: ("proprioception", lambda spec: f"agent_pos of {spec.obs.agent_pos_dim}"),
    IMAGE: ("images", lambda spec: f"images of {_sides(spec.obs.image_size)} pixels"),
    DEPTH: ("depth images", lambda spec: f"depth of {_sides(spec.obs.image_size)} pixels (metres)"),
    STATE: ("states", lambda spec: f"the privileged state of {spec.state_dim}"),
    VOXEL_GRID: (
        "voxel grids",
        lambda spec: f"voxel grids of {_sides(spec.observation(VOXEL_GRID).shape)} (frame `{spec.obs.frame}`)",
    ),
}  # fmt: skip
"""Observation key -> what it is called, and how its form is described."""


def _sides(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


_TITLES = {"teacher": "diffusion teacher", "student": "consistency student"}


def model_card(policy: ActionPolicy, provenance: Mapping[str, Any], dtype: str) -> str:
    """Return the Markdown text that stands beside the weights of `policy`.

    Args:
        policy: what is described.
        provenance: JSON values, each shown as given.
        dtype: of the stored weights.
    """
    spec, chunk = policy.spec, policy.chunk
    role = _TITLES.get(policy.role or "", "policy")
    parameters = sum(p.numel() for p in policy.parameters())
    seen = [_SEEN[key] for key in policy.keys]
    method = [f"| Method | {METHODS.get(policy.name).sentence} |"] if policy.name in METHODS.names() else []
    lines = [
        "---",
        f"license: {LICENSE.lower()}",
        "library_name: manicm_ms",
        f"tags: [robotics, imitation-learning, {seen[0][0].rstrip('s').replace(' ', '-')}]",
        "---",
        f"# {policy.name} for {spec.env_id}",
        "",
        f"A {role} that maps {seen[0][0]} to action chunks, written by manicm_ms.",
        "",
        "| | |",
        "|---|---|",
        *method,
        f"| Parameters | {parameters:,}, stored as {dtype} |",
        f"| Network evaluations a decision | {policy.nfe} |",
        f"| Reads | {chunk.n_obs_steps} frames: {', '.join(describe(spec) for _, describe in seen)} |",
        f"| Predicts | {chunk.horizon} actions, of which {chunk.n_action_steps} are executed |",
        f"| Action | {', '.join(spec.action.names)}; normalised to [-1, 1] |",
        f"| Control | `{spec.action.control_mode}` at {spec.action.control_hz:g} Hz |",
        f"| Licence | {LICENSE} |",
        "",
        "## Where it comes from",
        "",
        *_bullets(provenance),
        "",
        "## Limits",
        "",
        f"Made for {spec.env_id} in simulation, from scripted demonstrations. Its success rate belongs in a report "
        "with seeds and an interval; other tasks, cameras and real robots are untested.",
    ]
    return "\n".join(lines) + "\n"


def _bullets(values: Mapping[str, Any], indent: str = "") -> list[str]:
    lines = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            lines += [f"{indent}- {key}:", *_bullets(value, indent + "  ")]
        elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
            numbered = {str(number): item for number, item in enumerate(value, start=1)}
            lines += [f"{indent}- {key}:", *_bullets(numbered, indent + "  ")]
        else:
            lines.append(f"{indent}- {key}: {_short(value)}")
    return lines or [f"{indent}- not recorded"]


def _short(value: Any) -> Any:
    """Return `value`, or the length and range of a long list of numbers, which the manifest holds in full."""
    if not isinstance(value, list) or len(value) <= _LONG_LIST or not all(isinstance(v, int | float) for v in value):
        return value
    return f"{len(value)} numbers from {min(value)} to {max(value)}"
