"""Specs and observations that the policy tests share."""

from __future__ import annotations

import torch
from torch import Tensor

from manicm_ms.spec import ActionSpec, ChunkSpec, EnvSpec, ObsSpec

TINY = {
    "encoder": {"point_widths": (16, 32)},
    "backbone": {"down_dims": (16, 32), "n_groups": 4, "step_embed_dim": 16},
}
"""A network that acts in a millisecond."""

CHUNK = ChunkSpec(n_obs_steps=2, horizon=4, n_action_steps=3)


def make_spec(
    points: int = 32, agent_pos: int = 5, actions: int = 3, tcp: bool = True, point_channels: int = 3
) -> EnvSpec:
    """Return the spec of an imaginary environment; its TCP stands in entries 2, 0, 1 of agent_pos."""
    return EnvSpec(
        env_id="test/imaginary",
        obs=ObsSpec(points, point_channels, agent_pos, "robot_base"),
        action=ActionSpec(tuple(f"a{i}" for i in range(actions)), "pd_ee_delta_pose", 20.0),
        max_episode_steps=100,
        agent_pos_names=tuple(f"q{i} (m)" for i in range(agent_pos)),
        tcp_indices=(2, 0, 1) if tcp else None,
    )


def adroit_door() -> EnvSpec:
    """Return the shapes on which the public code's parameters were counted."""
    return EnvSpec(
        env_id="adroit/door",
        obs=ObsSpec(512, 3, 24, "world"),
        action=ActionSpec(tuple(f"joint{i}" for i in range(28)), "position", 50.0),
        max_episode_steps=200,
        agent_pos_names=tuple(f"q{i} (rad)" for i in range(24)),
    )


def make_obs(spec: EnvSpec, batch: int, seed: int = 0, chunk: ChunkSpec = CHUNK) -> dict[str, Tensor]:
    """Return random observations (B, To, ...) that fit `spec`."""
    g = torch.Generator().manual_seed(seed)
    cloud = torch.rand(batch, chunk.n_obs_steps, spec.obs.num_points, spec.obs.point_channels, generator=g)
    return {
        "point_cloud": cloud,
        "agent_pos": torch.randn(batch, chunk.n_obs_steps, spec.obs.agent_pos_dim, generator=g),
    }


def wobble(module: torch.nn.Module, seed: int = 0) -> None:
    """Move all parameters by a little noise, so that no layer is an accident of its initialisation."""
    g = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for p in module.parameters():
            p.add_(0.05 * torch.randn(p.shape, generator=g))
