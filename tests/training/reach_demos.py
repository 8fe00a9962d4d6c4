"""Demonstrations that a small policy can learn: a hand moves straight to a cluster of points.

The relation between cloud, hand and action is exact, so a test knows what should be learned.
"""

import numpy as np

from manicm_ms.demos.layout import Episode
from manicm_ms.demos.store import DemoStore
from manicm_ms.spec import ActionSpec, EnvSpec, ObsSpec

STEP = 0.05  # metres that an action of 1 moves the hand


def reach_spec(num_points=64, action_names=("dx [m]", "dy [m]", "dz [m]"), env_id="test/reach"):
    return EnvSpec(
        env_id=env_id,
        obs=ObsSpec(num_points=num_points, point_channels=3, agent_pos_dim=4, frame="robot_base"),
        action=ActionSpec(names=action_names, control_mode="pd_ee_delta_pos", control_hz=20.0),
        max_episode_steps=50,
        agent_pos_names=("x [m]", "y [m]", "z [m]", "opening [m]"),
        tcp_indices=(0, 1, 2),
    )


def expert_action(hand, target):
    """(..., 3) normalised: straight to the target, as fast as allowed."""
    return np.clip((target - hand) / STEP, -1.0, 1.0)


def cloud_at(target, num_points, rng):
    """(P, 3) metres: points around the target, in random order."""
    return (target + 0.01 * rng.normal(size=(num_points, 3))).astype(np.float32)


def reach_episode(seed, spec, length=12):
    rng = np.random.default_rng(seed)
    target = rng.uniform([0.3, -0.2, 0.0], [0.6, 0.2, 0.1])
    hand = target + rng.uniform(-0.3, 0.3, 3)
    clouds, poses, actions = [], [], []
    for _ in range(length):
        action = expert_action(hand, target)
        clouds.append(cloud_at(target, spec.obs.num_points, rng))
        poses.append([*hand, 0.04])
        actions.append(np.resize(action, spec.action.dim))
        hand = hand + STEP * action
    arrays = (np.asarray(a, dtype=np.float32) for a in (clouds, poses, actions))
    return Episode(*arrays, seed=seed, success=True)


def make_store(path, episodes=6, first_seed=0, **spec):
    """Write a store of `episodes` reaching motions, of the seeds from `first_seed` on, and return its path."""
    env_spec = reach_spec(**spec)
    with DemoStore.create(path, env_spec, {"expert": "straight"}) as store:
        for seed in range(first_seed, first_seed + episodes):
            store.append(reach_episode(seed, env_spec))
    return path
