"""Stack Cube and Transfer Piece for real, on a CPU: the expert, forces, ManiSkill's own way in.

What rewards and idle policies earn is tested in test_rewards.py, the vector interface in tests/envs/test_vec_env.py,
for all tasks alike.
"""

import gymnasium as gym
import numpy as np
import pytest
import torch

import manicm_ms.envs.maniskill  # noqa: F401  (chooses the Vulkan driver before SAPIEN is imported)

from manicm_ms.tasks import stack_cube, transfer_piece  # isort: skip

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.simulator import ENVS
from manicm_ms.robots.ur3e_ag95 import JOINT_SPEED

HELD = {stack_cube: "red", transfer_piece: "piece"}
AG95_MOST = 160.0  # N, largest grip force of the gripper (data sheet)


@pytest.fixture(scope="module", params=HELD, ids=lambda task: task.ENV_ID)
def task(request):
    return request.param


@pytest.fixture
def env(task, plain_env):
    return plain_env(task.GYM_ID)


def expert_episode(task, env, seed, on_step):
    env.reset(seed=seed)
    base = env.unwrapped
    expert = EXPERTS.get(task.ENV_ID)(task.SPEC, 1, torch.device("cpu"), None)
    expert.reset(base.privileged_state(), [seed], torch.ones(1, dtype=torch.bool))
    for _ in range(task.MAX_EPISODE_STEPS):
        last = env.step(expert.act(base.privileged_state()))
        on_step(*last)
        if bool(last[2] | last[3]):
            break
    return last


@pytest.mark.parametrize("seed", [300, 301])
def test_expert_succeeds_gently(task, env, seed):
    start, stop = task.SPEC.state_layout["arm_qvel"]
    base, speeds, grips, seen = env.unwrapped, [], [], set()
    fixed = {name: [] for name in ENVS.get(task.ENV_ID).fixed}

    def note(*step):
        info = step[-1]
        assert not (info["grasped"] & info["success"]).any(), "success comes with letting go"
        speeds.append(base.privileged_state()[0, start:stop].abs())
        forces = base.agent.pad_forces(base.objects[HELD[task]])
        grips.append([force.norm(dim=1).item() for force in forces])
        for name, poses in fixed.items():
            poses.append(base.objects[name].pose.raw_pose.clone())
        seen.update(name for name, value in info.items() if value.dtype == torch.bool and value.item())

    _, _, terminated, truncated, info = expert_episode(task, env, seed, note)
    assert info["success"].item()
    assert terminated.item()
    assert not truncated.item()
    assert "grasped" in seen
    assert not info["grasped"].item()
    assert "fail" not in seen
    fastest = torch.stack(speeds).amax(dim=0)
    assert (fastest <= torch.tensor(JOINT_SPEED)).all(), fastest
    strongest, held = np.max(grips), np.min(grips, axis=1).max()
    assert held > 5.0, "both pads hold the object with more than its weight"
    assert strongest <= AG95_MOST
    for poses in fixed.values():
        assert all(torch.equal(pose, poses[0]) for pose in poses)


def test_objects_rest_where_they_are_placed(task, env):
    env.reset(seed=1)
    base = env.unwrapped
    before = torch.cat([actor.pose.p for actor in base.objects.values()])
    for _ in range(20):
        *_, info = env.step(torch.zeros(1, 7))
        assert info["still"].item()
        assert not (info["success"] | info["fail"]).item()
    after = torch.cat([actor.pose.p for actor in base.objects.values()])
    assert (after - before).abs().max() < 1e-3


def test_state_matches_its_layout(task, env):
    env.reset(seed=0)
    state = env.unwrapped.privileged_state()
    assert state.shape == (1, task.SPEC.state_dim)
    for name, actor in env.unwrapped.objects.items():
        assert torch.equal(state[:, slice(*task.SPEC.state_layout[f"{name}_pose"])], actor.pose.raw_pose)


def test_made_by_its_id_alone(task, keep_compiled):
    """As a user of ManiSkill would, with its defaults for everything else."""
    env = gym.make(task.GYM_ID, num_envs=1, obs_mode="pointcloud")
    try:
        obs, _ = env.reset(seed=0)
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        keep_compiled(env)
    finally:
        env.close()
    assert obs["pointcloud"]["xyzw"].shape == (1, 84 * 84, 4)
    assert not [name for name in obs["extra"] if name.removesuffix("_pose") in HELD.values()], "privileged"
    assert reward.shape == terminated.shape == truncated.shape == info["success"].shape == (1,)


# ---- Transfer Piece alone -------------------------------------------------------------------------------------------


def test_half_closed_fingers_fit_between_the_walls_and_fully_open_ones_do_not(plain_env):
    """Why the task says "partially close": the same way-points with an open gripper meet the box."""
    env = plain_env(transfer_piece.GYM_ID)
    assert largest_force_on_box(env, transfer_piece.INSERT_OPENING) < 1.0
    assert largest_force_on_box(env, transfer_piece.OPENING_MAX) > 5.0


def largest_force_on_box(env, opening):
    """Lower the gripper into the left compartment with an opening, m; return the largest force on the box, N."""
    env.reset(seed=0)
    base = env.unwrapped
    expert = EXPERTS.get(transfer_piece.ENV_ID)(transfer_piece.SPEC, 1, torch.device("cpu"), None)
    expert.reset(base.privileged_state(), [0], torch.ones(1, dtype=torch.bool))
    most = 0.0
    for _ in range(50):
        action = expert.act(base.privileged_state())
        if action[0, 6] < -0.9:  # it closes: the fingers are down
            break
        action[0, 6] = 2 * opening / transfer_piece.OPENING_MAX - 1
        env.step(action)
        most = max(most, *(force.norm().item() for force in base.agent.pad_forces(base.box)))
    return most
