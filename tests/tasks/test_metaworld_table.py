"""Meta-World's table against the suite itself, its episodes, clouds and stored states."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch
from suite_rows import equal_frames, simulator, smooth_actions

if find_spec("metaworld") is None:
    pytest.skip("the MuJoCo suites are an extra, which is not installed", allow_module_level=True)

from manicm_ms.tasks.metaworld import TASKS, MetaWorldEnv

from manicm_ms.envs import mujoco_task
from manicm_ms.envs.mujoco_render import mujoco
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import BackendError, ConfigError
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, STATE

ROWS = {task.env_id: task for task in TASKS}
BENCHMARK = {
    "adroit": "door hammer pen",
    "easy": "button-press button-press-wall coffee-button dial-turn door-close door-open drawer-close faucet-open "
    "handle-press-side handle-pull handle-pull-side lever-pull peg-unplug-side plate-slide plate-slide-back-side "
    "reach reach-wall window-close",
    "medium": "box-close soccer sweep-into",
    "hard": "hand-insert pick-out-of-hole pick-place",
    "very-hard": "pick-place-wall shelf-place stick-pull stick-push",
}


def suite_env(name, seed):
    """The suite's own environment, used as its documentation says, reset to a seed."""
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

    env = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{name}-v3-goal-observable"](seed=3)
    env._freeze_rand_vec, env.seeded_rand_vec = False, True
    env.seed(seed)
    env.reset()
    return env


# ---- the table ------------------------------------------------------------------------------------------------------


def test_the_table_is_the_suite():
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    assert sorted(task.suite_id for task in TASKS) == sorted(ALL_V3_ENVIRONMENTS)
    assert {task.env_id for task in TASKS} == set(ENVS.names("metaworld"))


def test_the_benchmark_s_31_and_their_groups():
    tagged = {name: ENVS.tags(name) for name in ENVS.names("benchmark31")}
    assert len(tagged) == 31
    for group, names in BENCHMARK.items():
        suite = "adroit" if group == "adroit" else "metaworld"
        assert {f"{suite}/{name}" for name in names.split()} == {name for name in tagged if group in tagged[name]}
    counts = {group: len(ENVS.names(group)) for group in ("easy", "medium", "hard", "very-hard")}
    assert counts == {"easy": 28, "medium": 11, "hard": 6, "very-hard": 5}  # DP3, table XVIII


def test_the_spec_says_what_the_environment_is():
    with simulator("metaworld/pick-place", seed=1) as rows:
        env, spec = rows.env._env, rows.spec
        assert spec.action.control_hz == pytest.approx(1 / env.dt)
        assert spec.action.dim == env.action_space.shape[0]
        assert spec.state_dim == len(env._get_obs()) == 39
        assert spec.max_episode_steps <= env.max_path_length
        frame = rows.observe()
        low, high = (spec.state_layout["first_position"][k] for k in (0, 1))
        assert frame[STATE][0, low:high].numpy() == pytest.approx(env.data.body("obj").xpos, abs=1e-6)
        low, high = spec.state_layout["goal_position"]
        assert frame[STATE][0, low:high].numpy() == pytest.approx(env._target_pos, abs=1e-6)
        assert frame[AGENT_POS][0, list(spec.tcp_indices)].numpy() == pytest.approx(env.get_endeff_pos(), abs=1e-6)
        fingers = np.concatenate([env._get_site_pos(f"{side}EndEffector") for side in ("right", "left")])
        assert frame[AGENT_POS][0, 3:].numpy() == pytest.approx(fingers, abs=1e-6)


# ---- episodes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["soccer", "stick-push"])
def test_it_plays_as_the_suite_does_bit_for_bit(name):
    theirs = suite_env(name, seed=7)
    with simulator(f"metaworld/{name}", seed=7, obs=(STATE,)) as ours:
        assert np.array_equal(ours.env.data.qpos, theirs.data.qpos)
        for action in smooth_actions(4, 25):
            obs, _, _, _, info = theirs.step(action[0].numpy().astype(np.float64))
            result = ours.step(action)
            assert np.array_equal(ours.env.data.qpos, theirs.data.qpos)
            assert result.info["success"].item() == bool(info["success"])
            # The suite's first frames hold what was there before its reset had moved everything.
            assert np.array_equal(ours.env.state()[:18], obs[:18])
            assert np.array_equal(ours.env.state()[36:], obs[36:])


@pytest.mark.parametrize("env_id", ["metaworld/reach", "metaworld/pick-place", "metaworld/soccer"])
def test_the_goal_s_marker_is_at_the_goal_on_the_first_frame(env_id):
    with simulator(env_id, seed=5, num_points=2000) as rows:
        for seed in (5, 6):
            rows.reset(torch.zeros(1, dtype=torch.int64), [seed])
            frame = rows.observe()
            goal = frame[STATE][0, 36:]
            assert rows.env.data.site("goal").xpos == pytest.approx(rows.env._env._target_pos, abs=1e-9)
            distance = (frame[POINT_CLOUD][0] - goal).norm(dim=1)
            radius = rows.env.model.site("goal").size[0]
            assert ((distance - radius).abs() < 2e-3).sum() >= 2, "points on the marker's sphere"


def test_success_is_told_and_ends_nothing():
    """Reach the goal by walking there: a policy of one line."""
    with simulator("metaworld/reach", seed=2, obs=(STATE,)) as rows:
        solved = []
        for _ in range(60):
            state = rows.observe()[STATE][0]
            move = ((state[36:] - state[:3]) * 15).clamp(-1, 1)
            result = rows.step(torch.cat([move, torch.zeros(1)])[None])
            solved.append(result.info["success"].item())
            assert not result.terminated.any()
        assert sum(solved) >= 5
        assert result.info["success_steps"].item() == sum(solved)
        assert result.reward.item() == 1.0


def test_bad_surroundings_are_told(monkeypatch):
    versions = {"mujoco": "3.4.0", "metaworld": "3.1.1"}
    monkeypatch.setattr(mujoco_task.metadata, "version", versions.__getitem__)
    with pytest.raises(BackendError, match=r"metaworld 3.1.1 needs mujoco==3.3.0, installed is 3.4.0: pip install"):
        MetaWorldEnv(ROWS["metaworld/reach"])

    def missing(name):
        raise mujoco_task.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(mujoco_task.metadata, "requires", missing)
    with pytest.raises(BackendError, match="metaworld is not installed: run 'make setup', or pip install"):
        MetaWorldEnv(ROWS["metaworld/reach"])


# ---- clouds ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["metaworld/drawer-close", "metaworld/hand-insert", "metaworld/pick-out-of-hole"])
def test_the_cloud_is_in_the_world_and_holds_no_table(env_id):
    with simulator(env_id, seed=1, num_points=5000) as rows:
        cloud = np.unique(rows.observe()[POINT_CLOUD][0].numpy(), axis=0)
        model, data = rows.env.model, rows.env.data
        eye = data.cam_xpos[rows._camera]
        flat, told = np.zeros(1, np.int32), []
        for point in cloud[:: max(1, len(cloud) // 150)]:
            ray = (point - eye) / np.linalg.norm(point - eye)
            hit = mujoco.mj_ray(model, data, eye, ray, np.array([1, 1, 1, 0, 0, 0], np.uint8), 1, -1, flat)
            if abs(hit - np.linalg.norm(point - eye)) < 5e-3:  # else a site, or an edge
                told.append(model.body(model.geom_bodyid[flat[0]]).name)
        assert len(told) > 100
        assert not {"tablelink", "RetainingWall"} & set(told)


def dp3_reference(env):
    """The public wrapper's cropped cloud (K, 3), from its definitions: not with this package's code."""
    model, data, size = env.model, env.data, 128
    eye = np.array([0.6, 0.295, 0.8])
    model.cam_pos[model.camera("corner2").id] = eye
    model.vis.map.znear, model.vis.map.zfar = 0.1, 1.5
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, size, size) as renderer:
        renderer.enable_depth_rendering()
        renderer.update_scene(data, "corner2")
        depth = renderer.render().astype(np.float64)
    focal = size / 2 / np.tan(np.deg2rad(60) / 2)
    v, u = np.mgrid[:size, :size]
    # As Open3D unprojects with the principal point (64, 64); then OpenCV's axes to OpenGL's, and to the world's.
    camera = np.stack([(u - 64) / focal * depth, (v - 64) / focal * depth, depth], axis=-1).reshape(-1, 3)
    away = (camera * [1, -1, -1]) @ data.cam_xmat[model.camera("corner2").id].reshape(3, 3).T
    # p_dp3 = A (p_world - eye), measured on the wrapper's own transform
    A = np.array([[-0.63668, -0.77113, -0.00094], [0.77108, -0.63666, 0.00970], [-0.00808, 0.00545, 0.99995]])
    cloud = away @ A.T
    return cloud[((cloud > [-0.5, -1.5, -0.795]) & (cloud < [1, -0.4, 100])).all(axis=1)]


@pytest.mark.parametrize("name", ["button-press", "shelf-place"])
def test_dp3_s_preset_is_the_public_wrapper_s_cloud(name):
    env = suite_env(name, seed=4)
    expected = dp3_reference(env)
    with simulator(f"metaworld/{name}", seed=4, obs_preset="dp3", num_points=len(expected) + 100) as rows:
        assert rows.spec.obs.frame == "dp3"
        assert rows.spec.tcp_indices is None
        cloud = rows.observe()[POINT_CLOUD][0].numpy()
    kept = cloud[np.abs(cloud).sum(axis=1) > 0]
    assert abs(len(kept) - len(expected)) <= 3, "points at the crop's edge"
    assert not cloud[len(kept) :].any(), "zeros behind"
    gaps = np.array([np.abs(expected - point).sum(axis=1).min() for point in kept[::7]])
    assert gaps.max() < 2e-4, "A has five digits"
    with simulator(f"metaworld/{name}", seed=4, obs_preset="dp3") as rows:
        sampled = rows.observe()[POINT_CLOUD][0].numpy()
    assert len(np.unique(sampled, axis=0)) == 512
    reach = np.array([np.linalg.norm(sampled - point, axis=1).min() for point in expected[::11]]).max()
    spacing = np.array([np.sort(np.linalg.norm(sampled - point, axis=1))[1] for point in sampled]).min()
    assert reach <= spacing + 1e-3, "farthest points: none is farther from the sample than its points from each other"


# ---- stored states --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["pick-place", "stick-pull", "door-open"])
def test_stored_states_bring_back_the_observations_bit_for_bit(name):
    with simulator(f"metaworld/{name}", seed=3) as rows:
        states, frames = [rows.save_state()], [rows.observe()]
        actions = smooth_actions(4, 12, seed=1)
        for action in actions:
            rows.step(action)
            states.append(rows.save_state())
            frames.append(rows.observe())
    with simulator(f"metaworld/{name}", seed=8) as other:
        for state, frame in list(zip(states, frames, strict=True))[::-2]:
            other.restore_state(state)
            assert equal_frames(other.observe(), frame) == []
        for action, frame in zip(actions, frames[1:], strict=True):  # the last one restored was the first
            other.step(action)
            assert equal_frames(other.observe(), frame) == []


def test_a_state_of_another_task_is_refused():
    with simulator("metaworld/reach", seed=1, obs=(STATE,)) as rows:
        state = rows.save_state()
    with simulator("metaworld/soccer", obs=(STATE,)) as other, pytest.raises(ConfigError, match="another task"):
        other.restore_state(state)
