"""ManiSkill's own tools on `UR3eSlideBlock-v1`, for real, on a CPU."""

import json

import gymnasium as gym
import numpy as np
import pytest
import torch

import manicm_ms.envs.maniskill  # noqa: F401  (chooses the Vulkan driver before SAPIEN is imported)

from mani_skill.trajectory import replay_trajectory  # isort: skip
from mani_skill.utils.wrappers import CPUGymWrapper, RecordEpisode  # isort: skip
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv  # isort: skip

from manicm_ms.tasks.slide_block import ENV_ID, GYM_ID, MAX_EPISODE_STEPS, SPEC

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.robots.ur3e_ag95 import JOINT_SPEED

SMALL = {"sensor_configs": {"width": 32, "height": 32}}


def make(**options):
    return gym.make(GYM_ID, **{"num_envs": 1, "sim_backend": "physx_cpu"} | options)


@pytest.fixture
def env(plain_env):
    return plain_env(GYM_ID)


def expert_episode(env, seed, on_step=lambda *_: None, style=None):
    """Drive `env` with the expert until it ends; return its last step."""
    env.reset(seed=seed)
    base = env.unwrapped
    expert = EXPERTS.get(ENV_ID)(SPEC, 1, torch.device("cpu"), style)
    expert.reset(base.privileged_state(), [seed], torch.ones(1, dtype=torch.bool))
    for _ in range(MAX_EPISODE_STEPS):
        last = env.step(expert.act(base.privileged_state()))
        on_step(*last)
        if bool(last[2] | last[3]):
            break
    return last


@pytest.mark.parametrize("obs_mode", ["state", "state_dict", "pointcloud", "rgbd"])
def test_observation_modes(obs_mode, keep_compiled):
    env = make(obs_mode=obs_mode, **SMALL)
    try:
        obs, _ = env.reset(seed=0)
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        if obs_mode in ("pointcloud", "rgbd"):
            keep_compiled(env)
    finally:
        env.close()
    assert reward.shape == terminated.shape == truncated.shape == info["success"].shape == (1,)
    if obs_mode == "state":
        assert obs.shape == env.observation_space.shape
        assert torch.isfinite(obs).all()
    elif obs_mode == "state_dict":
        assert obs["extra"]["block_pose"].shape == (1, 7)
    elif obs_mode == "pointcloud":
        assert obs["pointcloud"]["xyzw"].shape == (1, 32 * 32, 4)
        assert "block_pose" not in obs["extra"], "privileged state must not reach a policy that sees clouds"
    else:
        camera = obs["sensor_data"]["d435i"]
        assert camera["rgb"].shape == (1, 32, 32, 3)
        assert camera["depth"].max() > 0


def test_seed_decides_the_episode(env):
    def start(seed):
        env.reset(seed=seed)
        return env.unwrapped.privileged_state()

    first, other, again = start(5), start(6), start(5)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_state_matches_its_layout(env):
    env.reset(seed=0)
    base = env.unwrapped
    state = base.privileged_state()
    assert state.shape == (1, SPEC.state_dim)

    def part(name):
        start, stop = SPEC.state_layout[name]
        return state[:, start:stop]

    assert torch.equal(part("block_pose"), base.block.pose.raw_pose)
    assert torch.equal(part("cube_pose"), base.cube.pose.raw_pose)
    assert torch.equal(part("tcp_pose"), base.agent.tcp_pose_at_base)
    assert torch.equal(part("arm_qvel"), base.agent.robot.get_qvel()[:, :6])
    agent_pos = base.agent_pos()
    assert agent_pos.shape == (1, SPEC.obs.agent_pos_dim)
    torch.testing.assert_close(agent_pos[:, :3], part("tcp_pose")[:, :3])
    columns = agent_pos[0, 3:9].view(2, 3)
    torch.testing.assert_close(columns @ columns.T, torch.eye(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(columns[0].cross(columns[1], dim=0)[2], torch.tensor(-1.0), atol=0.05, rtol=0)


def test_objects_rest_where_they_are_placed(env):
    env.reset(seed=1)
    base = env.unwrapped
    before = torch.cat([base.cube.pose.p, base.block.pose.p])
    for _ in range(20):
        *_, info = env.step(torch.zeros(1, 7))
    after = torch.cat([base.cube.pose.p, base.block.pose.p])
    assert (after - before).abs().max() < 1e-3
    assert info["still"].item()
    assert not info["success"].item()


@pytest.mark.parametrize("seed", [100, 101])
@pytest.mark.parametrize("style", ["one-sided", "two-sided"])
def test_expert_succeeds_within_the_joint_speed_limits(env, style, seed):
    start, stop = SPEC.state_layout["arm_qvel"]
    speeds = []

    def note(*_):
        speeds.append(env.unwrapped.privileged_state()[0, start:stop].abs())

    *_, truncated, info = expert_episode(env, seed, note, style)
    assert info["success"].item()
    assert not truncated.item()
    fastest = torch.stack(speeds).amax(dim=0)
    assert (fastest <= torch.tensor(JOINT_SPEED)).all(), fastest
    assert fastest.max() > 0.1, "the arm moves"


def test_a_pushed_cube_is_a_failure_and_ends_the_episode(env):
    env.reset(seed=0)
    base = env.unwrapped
    pose = base.cube.pose.raw_pose.clone()
    pose[:, 0] += 0.03
    base.cube.set_pose(type(base.cube.pose).create(pose))
    _, reward, terminated, _, info = env.step(torch.zeros(1, 7))
    assert info["cube_moved"].item()
    assert info["fail"].item()
    assert terminated.item()
    assert not info["success"].item()
    assert reward.item() < 1


def test_sparse_reward_is_the_success():
    env = make(obs_mode="none", reward_mode="sparse")
    try:
        env.reset(seed=0)
        _, reward, *_ = env.step(torch.zeros(1, 7))
        assert reward.item() == 0
        _, reward, *_ = expert_episode(env, 0)
        assert reward.item() == 1
    finally:
        env.close()


# ---- wrappers -------------------------------------------------------------------------------------------------------


def test_maniskill_vector_env_resets_by_itself_and_tells_the_final_info():
    env = ManiSkillVectorEnv(make(obs_mode="state"), 1, ignore_terminations=False, record_metrics=True)
    try:
        env.reset(seed=0)
        base = env.unwrapped
        expert = EXPERTS.get(ENV_ID)(SPEC, 1, torch.device("cpu"), None)
        expert.reset(base.privileged_state(), [0], torch.ones(1, dtype=torch.bool))
        for _ in range(MAX_EPISODE_STEPS):
            _, _, terminated, _, info = env.step(expert.act(base.privileged_state()))
            if terminated.any():
                break
        assert info["final_info"]["episode"]["success_once"].tolist() == [True]
        assert base.elapsed_steps.tolist() == [0]
    finally:
        env.close()


def cpu_row():
    """Return one row as ManiSkill's CPU users make it; a worker process imports it by name."""
    torch.set_num_threads(1)
    return CPUGymWrapper(make(obs_mode="state"), ignore_terminations=True, record_metrics=True)


def test_cpu_wrapper_in_worker_processes():
    envs = gym.vector.AsyncVectorEnv([cpu_row] * 2, context="forkserver")
    try:
        obs, _ = envs.reset(seed=[3, 4])
        assert obs.shape == (2, *envs.single_observation_space.shape)
        assert not np.array_equal(obs[0], obs[1])
        obs, reward, terminated, *_ = envs.step(np.zeros((2, 7), dtype=np.float32))
        assert reward.shape == terminated.shape == (2,)
        again, _ = envs.reset(seed=[4, 3])
        assert np.isfinite(obs).all()
        first, _ = envs.reset(seed=[3, 4])
        np.testing.assert_array_equal(again[::-1], first)
    finally:
        envs.close()


# ---- replaying; recordings of the task itself are replayed in tests/demos/test_convert_maniskill.py ------------------


def replay(recording, *options):
    """Run ManiSkill's command in this process; return the success of the replayed episodes, as it wrote them."""
    before = set(recording.parent.glob("*.json"))
    replay_trajectory.main(
        replay_trajectory.parse_args(["--traj-path", str(recording), "--save-traj", "--allow-failure", *options])
    )
    (written,) = set(recording.parent.glob("*.json")) - before
    return [episode["success"] for episode in json.loads(written.read_text())["episodes"]]


def test_joint_trajectory_converts_to_the_tasks_own_controller(env, tmp_path):
    targets = []

    def note(*_):
        arm = env.unwrapped.agent.controller.controllers["arm"]
        targets.append(torch.cat([arm._target_qpos, torch.full((1, 1), -1.0)], dim=1))  # gripper stays closed

    expert_episode(env, 0, note)
    joints = make(obs_mode="none", control_mode="pd_joint_pos")
    joints = RecordEpisode(joints, str(tmp_path), trajectory_name="joints", save_video=False)
    joints.reset(seed=0)
    for target in targets + targets[-1:] * 10:  # the converter may arrive a little later than the original
        *_, info = joints.step(target)
    joints.close()
    assert info["success"].item()
    assert replay(tmp_path / "joints.h5", "-c", SPEC.action.control_mode, "-o", "none") == [True]
