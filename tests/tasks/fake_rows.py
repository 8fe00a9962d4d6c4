"""Fakes that let the batched task code run on N rows without a simulator: no GPU is at hand, and a CPU scene has one.

The fakes keep ManiSkill's rule: a setter writes the rows of `scene._reset_mask`, and takes one value for each of them.
"""

from types import SimpleNamespace

import torch
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from mani_skill.utils.structs import Pose
from manicm_ms.tasks.slide_block import SlideBlockEnv


class FakeActor:
    def __init__(self, scene, n):
        self._scene = scene
        self.raw = torch.zeros(n, 7)
        self.raw[:, 3] = 1.0
        self.linear_velocity, self.angular_velocity = torch.zeros(n, 3), torch.zeros(n, 3)

    @property
    def pose(self):
        return Pose.create(self.raw.clone())

    def set_pose(self, pose):
        mask = self._scene._reset_mask
        if pose.raw_pose.shape[0] != int(mask.sum()):
            raise AssertionError(f"{len(pose.raw_pose)} poses for {int(mask.sum())} rows being reset")
        self.raw[mask] = pose.raw_pose.to(self.raw.dtype)

    def is_static(self, lin_thresh, ang_thresh):
        return (self.linear_velocity.norm(dim=1) <= lin_thresh) & (self.angular_velocity.norm(dim=1) <= ang_thresh)


class FakeRobot:
    def __init__(self, scene, n):
        self._scene = scene
        self.qpos = torch.zeros(n, 8)
        self.root = FakeActor(scene, n)
        self.set_pose = lambda pose: None  # the base never moves


class FakeAgent:
    def __init__(self, scene, n):
        self._scene, self.robot = scene, FakeRobot(scene, n)
        self.tcp = torch.zeros(n, 7)
        self.tcp[:, 3] = 1.0

    def reset(self, qpos):
        mask = self._scene._reset_mask
        if qpos.shape[0] != int(mask.sum()):
            raise AssertionError(f"{len(qpos)} joint vectors for {int(mask.sum())} rows being reset")
        self.robot.qpos[mask] = qpos

    @property
    def tcp_pose(self):
        return Pose.create(self.tcp.clone())


class FakeSlideBlock:
    """The task's own methods, unbound, on N fake rows."""

    start_qpos, start_opening = SlideBlockEnv.start_qpos, SlideBlockEnv.start_opening
    reward_weights = SlideBlockEnv.reward_weights
    device = torch.device("cpu")

    def __init__(self, n):
        self.num_envs = n
        self.scene = SimpleNamespace(_reset_mask=torch.ones(n, dtype=torch.bool))
        self.cube, self.block = FakeActor(self.scene, n), FakeActor(self.scene, n)
        self.agent = FakeAgent(self.scene, n)
        self.cube_start = self.cube.raw.clone()
        self._batched_episode_rng = BatchedRNG.from_seeds([0] * n)

    def reset(self, rows, seeds):
        """Reset `rows` with `seeds`, as ManiSkill does for `options={"env_idx": rows}`."""
        rows = torch.as_tensor(rows)
        self.scene._reset_mask = torch.zeros(self.num_envs, dtype=torch.bool)
        self.scene._reset_mask[rows] = True
        self._batched_episode_rng[rows] = BatchedRNG.from_seeds(list(seeds))
        self._initialize_episode(rows, {})
        self.scene._reset_mask[:] = True

    def tensors(self):
        return [self.cube.raw, self.block.raw, self.cube_start, self.agent.robot.qpos]

    _initialize_episode = SlideBlockEnv._initialize_episode
    _place_objects = SlideBlockEnv._place_objects
    evaluate = SlideBlockEnv.evaluate
    reward_terms = SlideBlockEnv.reward_terms
    compute_dense_reward = SlideBlockEnv.compute_dense_reward
    compute_normalized_dense_reward = SlideBlockEnv.compute_normalized_dense_reward
