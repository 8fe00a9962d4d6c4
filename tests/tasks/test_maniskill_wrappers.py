"""Every wrapper that ManiSkill ships, and what its own tests ask of a task, on our three; or PickCube fails likewise.

State contract: test_maniskill_state.py. Registration and `gymnasium.make`: tests/test_gym_ids.py. Conversion of actions
and worker processes: test_slide_block_maniskill.py.
"""

import json

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

import manicm_ms.envs.maniskill  # noqa: F401  (chooses the Vulkan driver before SAPIEN is imported)

from mani_skill.utils.wrappers import CPUGymWrapper, FrameStack, RecordEpisode  # isort: skip
from mani_skill.utils.wrappers.action_repeat import ActionRepeatWrapper  # isort: skip
from mani_skill.utils.wrappers.cached_reset import CachedResetWrapper  # isort: skip
from mani_skill.utils.wrappers.flatten import (  # isort: skip
    FlattenActionSpaceWrapper,
    FlattenObservationWrapper,
    FlattenRGBDObservationWrapper,
)
from mani_skill.utils.wrappers.visual_encoders import VisualEncoderWrapper  # isort: skip
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv  # isort: skip

from manicm_ms.errors import ConfigError
from manicm_ms.gym_ids import MANISKILL

PICK_CUBE = "PickCube-v1"
SMALL = {"sensor_configs": {"width": 32, "height": 32}, "human_render_camera_configs": {"width": 40, "height": 30}}


def make(gym_id, **options):
    torch.set_num_threads(1)
    return gym.make(gym_id, **{"num_envs": 1, "sim_backend": "physx_cpu", "render_mode": "rgb_array"} | options)


@pytest.fixture(scope="module")
def envs():
    """Environments by id and observation mode, each made once."""
    made = {}

    def get(gym_id, obs_mode):
        if (gym_id, obs_mode) not in made:
            made[gym_id, obs_mode] = make(gym_id, obs_mode=obs_mode, **(SMALL if "rgb" in obs_mode else {}))
        return made[gym_id, obs_mode]

    yield get
    for env in made.values():
        env.close()


@pytest.fixture(params=MANISKILL)
def gym_id(request):
    return request.param


@pytest.fixture
def env(envs, gym_id):
    """An environment with states as observations, as it was made: wrappers change the base's observation space."""
    yield from as_made(envs(gym_id, "state"))


@pytest.fixture
def seen(envs, gym_id):
    """An environment with small pictures as observations, as it was made."""
    yield from as_made(envs(gym_id, "rgb+depth+segmentation"))


def as_made(env):
    raw = env.unwrapped._init_raw_obs
    yield env
    env.unwrapped.update_obs_space(raw)


# ---- wrappers -------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*Box observation space m", "ignore:.*different from the unwrapped version")
def test_gymnasiums_checker_passes_through_the_cpu_wrapper(env):
    # ManiSkill's wrappers record no arguments, so that no spec of theirs can be made again: PickCube's neither.
    check_env(CPUGymWrapper(env), skip_render_check=True, skip_close_check=True)


def test_the_cpu_wrapper_gives_numpy_and_metrics(env):
    wrapped = CPUGymWrapper(env, ignore_terminations=True, record_metrics=True)
    obs, _ = wrapped.reset(seed=0)
    assert obs in wrapped.observation_space
    obs, reward, terminated, truncated, info = wrapped.step(wrapped.action_space.sample())
    assert obs in wrapped.observation_space
    assert isinstance(float(reward), float)
    assert (bool(terminated), bool(truncated)) == (False, False)
    assert {"success_once", "fail_once", "success_at_end", "return", "episode_len"} <= set(info["episode"])


def test_stacked_frames(env):
    stacked = FrameStack(env, num_stack=3)
    first, _ = stacked.reset(seed=0)
    assert first.shape == (1, 3, *env.unwrapped._init_raw_obs.shape[2:])
    assert torch.equal(first[:, 0], first[:, 2])
    second, *_ = stacked.step(stacked.action_space.sample())
    assert torch.equal(second[:, 1], first[:, 2])
    assert not torch.equal(second[:, 2], first[:, 2])


def test_repeated_actions(env):
    repeated = ActionRepeatWrapper(env, repeat=3)
    repeated.reset(seed=0)
    _, reward, *_ = repeated.step(repeated.action_space.sample())
    assert env.unwrapped.elapsed_steps.tolist() == [3]
    assert torch.isfinite(reward).all()


def test_cached_resets(env):
    cached = CachedResetWrapper(env, config={"num_resets": 2, "seed": 3})
    starts = {tuple(np.round(cached.reset()[0][0].tolist(), 5)) for _ in range(8)}
    assert 1 <= len(starts) <= 2
    cached.step(cached.action_space.sample())


def test_vector_wrapper_resets_itself_and_tells_the_final_info(env):
    vector = ManiSkillVectorEnv(env, record_metrics=True)
    vector.reset(seed=0)
    base, still = vector.base_env, torch.zeros(1, 7)
    base._elapsed_steps[:] = gym.spec(base.spec.id).max_episode_steps - 1
    obs, _, _, truncated, info = vector.step(still)
    assert truncated.tolist() == [True]
    assert base.elapsed_steps.tolist() == [0]
    assert info["final_info"]["episode"]["success_once"].tolist() == [False]
    assert info["final_observation"].shape == obs.shape


@pytest.mark.parametrize("mode", ["state", "rgb+depth+segmentation"])
def test_recorder_writes_states_observations_and_video(envs, gym_id, mode, tmp_path):
    made = envs(gym_id, mode)
    recorder = RecordEpisode(made, str(tmp_path), trajectory_name="t", save_video=mode != "state", video_fps=20)
    recorder.reset(seed=4)
    for _ in range(3):
        recorder.step(recorder.action_space.sample())
    recorder.flush_trajectory()
    if mode != "state":
        recorder.flush_video()
        assert (tmp_path / "0.mp4").stat().st_size > 0
    recorder._h5_file.close()  # not the environment, which other tests use
    episode = json.loads((tmp_path / "t.json").read_text())["episodes"][0]
    assert (episode["episode_seed"], episode["elapsed_steps"]) == (4, 3)
    with h5py.File(tmp_path / "t.h5") as file:
        trajectory = file["traj_0"]
        assert trajectory["actions"].shape == (3, 7)
        assert set(trajectory["env_states"]) >= {"actors", "articulations", "controller", "asleep"}
        obs = trajectory["obs"] if mode == "state" else trajectory["obs/sensor_data/d435i/rgb"]
        assert len(obs) == 4


def test_flattened_pictures(seen):
    flat = FlattenRGBDObservationWrapper(seen)
    obs, _ = flat.reset(seed=0)
    assert obs["rgb"].shape == (1, 32, 32, 3)
    assert obs["depth"].shape == (1, 32, 32, 1)
    assert obs["state"].shape[0] == 1
    stacked = FrameStack(flat, num_stack=2)
    assert stacked.reset(seed=0)[0]["rgb"].shape == (1, 2, 32, 32, 3)


def flatten_actions(env):
    """Flattens dictionaries of actions, which environments with several robots have."""
    FlattenActionSpaceWrapper(env).step(env.action_space.sample())


def flatten_observations(env):
    """Flattens dictionaries of observations, but not those that hold dictionaries, as every task's do."""
    FlattenObservationWrapper(env)


def encode_pictures(env):
    """Needs the package r3m."""
    VisualEncoderWrapper(env, "r3m")


@pytest.mark.parametrize("use", [flatten_actions, flatten_observations, encode_pictures])
def test_three_wrappers_fit_neither_ours_nor_pick_cube(envs, use):
    reasons = []
    for name in (next(iter(MANISKILL)), PICK_CUBE):
        with pytest.raises(Exception) as reason:  # noqa: PT011 (compared below)
            use(envs(name, "state_dict"))
        reasons.append((reason.type, str(reason.value)))
    assert reasons[0] == reasons[1]


# ---- what ManiSkill's tests ask of a task ---------------------------------------------------------------------------


def test_pictures_and_render_modes(seen):
    obs, _ = seen.reset(seed=0)
    for source in (obs, seen.step(seen.action_space.sample())[0]):
        camera = source["sensor_data"]["d435i"]
        assert {name: tuple(value.shape) for name, value in camera.items()} == {
            "rgb": (1, 32, 32, 3), "depth": (1, 32, 32, 1), "segmentation": (1, 32, 32, 1)
        }  # fmt: skip
    base = seen.unwrapped
    assert base.render_rgb_array().shape == (1, 30, 40, 3)
    assert base.render_sensors().ndim == base.render_all().ndim == 4


def test_a_restore_leaves_the_pictures_as_they_were(seen):
    before = seen.reset(seed=6)[0]["sensor_data"]["d435i"]
    before = {name: value.clone() for name, value in before.items()}
    base = seen.unwrapped
    state = base.get_state_dict()
    seen.step(torch.ones(1, 7))
    for _ in range(3):
        base.set_state_dict(state)
    after = base.get_obs()["sensor_data"]["d435i"]
    assert all(torch.equal(after[name], before[name]) for name in before)


def test_seeds_decide_one_episode_and_those_after_it(env):
    def sequence():
        first = env.reset(seed=11)[0]
        return torch.stack([first, env.reset()[0], env.reset()[0]])

    once, again = sequence(), sequence()
    assert torch.equal(once, again)
    assert not torch.equal(once[0], once[1])
    assert not torch.equal(once[1], once[2])


@pytest.mark.parametrize("mode", ["pd_ee_delta_pose", "pd_ee_pose", "pd_joint_pos", "pd_joint_delta_pos"])
def test_every_control_mode_steps(env, gym_id, mode):
    base = env.unwrapped
    env.reset(seed=0)
    try:
        base.agent.set_control_mode(mode)
        base.agent.controller.reset()
        action = torch.from_numpy(base.agent.single_action_space.sample())[None]
        obs, *_ = base.step(action)
        assert torch.isfinite(obs).all()
    finally:
        base.agent.set_control_mode("pd_ee_target_delta_pose")
        base.agent.controller.reset()


def test_actions_that_are_no_numbers_are_refused(env):
    env.reset(seed=0)
    with pytest.raises(ValueError, match="nan"):
        env.step(torch.full((1, 7), torch.nan))


def test_reconfiguring_gives_the_same_start(env):
    first = env.reset(seed=9)[0].clone()
    assert torch.equal(env.reset(seed=9, options={"reconfigure": True})[0], first)


def test_another_robot_is_refused_in_one_line(gym_id):
    with pytest.raises(ConfigError, match=r"Env has the robot 'ur3e_ag95', got robot_uids='panda': leave") as error:
        gym.make(gym_id, robot_uids="panda")
    assert "\n" not in str(error.value)


def test_reward_modes(gym_id, envs):
    base = envs(gym_id, "state").unwrapped
    before = base.reward_mode
    try:
        for mode in base.SUPPORTED_REWARD_MODES:
            base._reward_mode = mode
            base.reset(seed=0)
            assert torch.isfinite(base.step(torch.zeros(1, 7))[1]).all()
    finally:
        base._reward_mode = before
