"""Adroit's table against the suite itself, its episodes, clouds and stored states."""

import importlib
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from suite_rows import equal_frames, simulator, smooth_actions

if find_spec("gymnasium_robotics") is None:
    pytest.skip("the MuJoCo suites are an extra, which is not installed", allow_module_level=True)

from manicm_ms.tasks.adroit import TASKS

from manicm_ms.envs.mujoco_render import mujoco
from manicm_ms.spec import AGENT_POS, DEPTH, IMAGE, POINT_CLOUD, STATE

NAMES = [task.env_id.removeprefix("adroit/") for task in TASKS]
HAND_QPOS = {"door": slice(4, -2), "hammer": slice(2, -7), "pen": slice(None, -6)}  # as DP3's wrapper slices it


def suite_env(name, seed):
    """The suite's own environment, reset to a seed."""
    module = importlib.import_module(f"gymnasium_robotics.envs.adroit_hand.adroit_{name}")
    env = getattr(module, f"AdroitHand{name.capitalize()}Env")()
    env.reset(seed=seed)
    return env


@pytest.mark.parametrize("name", NAMES)
def test_the_spec_says_what_the_environment_is_and_it_plays_as_the_suite_does(name):
    theirs = suite_env(name, seed=7)
    with simulator(f"adroit/{name}", seed=7) as ours:
        env, spec = ours.env._env, ours.spec
        assert spec.action.control_hz == pytest.approx(1 / (env.dt * 2))
        actuators = [env.model.actuator(k).name.removeprefix("A_") for k in range(env.model.nu)]
        assert [action.split()[0] for action in spec.action.names] == actuators
        frame = ours.observe()
        assert spec.state_dim == frame[STATE].shape[1] == len(theirs._get_obs())
        for action in smooth_actions(spec.action.dim, 12):
            for _ in range(2):
                *_, info = theirs.step(action[0].numpy().astype(np.float64))
            result = ours.step(action)
            assert np.array_equal(ours.env.data.qpos, theirs.data.qpos), "bit for bit"
            assert result.info["success"].item() == bool(info["success"])
        mujoco.mj_forward(theirs.model, theirs.data)  # what the suite leaves one physics step behind
        assert ours.observe()[STATE][0].numpy() == pytest.approx(theirs._get_obs(), abs=1e-6)
        assert ours.observe()[AGENT_POS][0].numpy() == pytest.approx(theirs.data.qpos[HAND_QPOS[name]], abs=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_parts_of_the_state_are_where_the_layout_says(name):
    where = {"door": ("handle_position", "S_handle"), "hammer": ("palm_position", "S_grasp"), "pen": None}[name]
    with simulator(f"adroit/{name}", seed=2) as rows:
        state, layout, data = rows.env.state(), rows.spec.state_layout, rows.env.data
        if where is not None:
            assert state[slice(*layout[where[0]])] == pytest.approx(data.site(where[1]).xpos, abs=1e-12)
        else:
            assert state[slice(*layout["pen_position"])] == pytest.approx(data.body("Object").xpos, abs=1e-12)
            direction = data.site("target_top").xpos - data.site("target_bottom").xpos
            direction /= np.linalg.norm(direction)
            assert state[slice(*layout["target_direction"])] == pytest.approx(direction, abs=1e-6)


# ---- success and failure --------------------------------------------------------------------------------------------


def test_door_thresholds_of_suite_and_dp3_differ():
    for preset, opened in (("manicm_ms", True), ("dp3", False)):
        with simulator("adroit/door", seed=1, obs_preset=preset, obs=(STATE,)) as rows:
            rows.env.data.joint("door_hinge").qpos = 1.375  # between 1.35 and 1.4 rad
            rows.env.data.joint("door_hinge").qvel = 0
            result = rows.step(torch.zeros(1, 28))
            hinge = rows.env.data.joint("door_hinge").qpos[0]
            assert 1.36 < hinge < 1.39
            assert result.info["success"].item() is opened
            assert not result.terminated.item(), "success ends nothing: it must hold at the end"
            assert result.info["success_steps"].item() == (2 if opened else 0)
            assert result.info["success_last_two"].item() == (0.5 if opened else 0.0)
            assert rows.step(torch.zeros(1, 28)).info["success_last_two"].item() == float(opened)


def test_dp3_judges_the_pen_by_its_direction_alone():
    results = {}
    for preset in ("manicm_ms", "dp3"):
        with simulator("adroit/pen", seed=1, obs_preset=preset, obs=(STATE,)) as rows:
            model, data = rows.env.model, rows.env.data
            model.body_quat[model.body("target").id] = data.body("Object").xquat
            data.joint("OBJTz").qpos -= 0.2  # along the world's x: beside the hand, and falling for 20 ms
            results[preset] = rows.step(torch.zeros(1, 24)).info["success"].item()
    assert results == {"manicm_ms": False, "dp3": True}


def test_a_dropped_pen_ends_the_episode():
    with simulator("adroit/pen", seed=1, obs=(STATE,)) as rows:
        assert not rows.step(torch.zeros(1, 24)).terminated.item()
        rows.env.data.joint("OBJTz").qpos -= 0.25  # along the world's x: beside the hand
        rows.env.data.joint("OBJTx").qpos += 0.19  # down to 6 cm above the table
        result = rows.step(torch.zeros(1, 24))
        assert result.terminated.item()
        assert result.info["fail"].item()
        assert not result.info["success"].item()


# ---- clouds ---------------------------------------------------------------------------------------------------------

DP3_VIEWS = {  # camera position, A and shift of p_dp3 = A (p_world - position) + shift, floor of the crop
    "door": ((0, 0, 1.5), [[-1, 0.00159, 0], [-0.00159, -1, 0], [0, 0, 1]], (0, 0, 1), -0.499),
    "hammer": ((0, 0, 1.1), [[-1, 0.00159, 0], [-0.00159, -1, 0], [0, 0, 1]], (0, 0, 1), -0.099),
}


def dp3_reference(env, name):
    """The public wrapper's cropped cloud (K, 3), from its definitions: not with this package's code."""
    eye, A, shift, floor = DP3_VIEWS[name]
    model, data = env.model, env.data
    camera = model.camera("vil_camera").id
    model.cam_pos[camera], model.cam_quat[camera] = eye, (0.000796, 0, 0, 0.9999997)
    model.site_rgba[(model.site_rgba[:, 3] < 1), 3] = 0  # MuJoCo's depth mode draws the translucent solid, RGB mode not
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 84, 84) as renderer:
        renderer.enable_depth_rendering()
        renderer.update_scene(data, "vil_camera")
        depth = renderer.render().astype(np.float64)
    focal = 42 / np.tan(np.deg2rad(45) / 2)
    v, u = np.mgrid[:84, :84]
    seen = np.stack([(u - 42) / focal * depth, -(v - 42) / focal * depth, -depth], axis=-1).reshape(-1, 3)
    cloud = seen @ data.cam_xmat[camera].reshape(3, 3).T @ np.array(A).T + shift
    return cloud[((cloud > [-10, -10, floor]) & (cloud < 10)).all(axis=1)]


@pytest.mark.parametrize("name", list(DP3_VIEWS))
def test_dp3_s_preset_is_the_public_wrapper_s_cloud(name):
    expected = dp3_reference(suite_env(name, seed=4), name)
    with simulator(f"adroit/{name}", seed=4, obs_preset="dp3", num_points=len(expected) + 100) as rows:
        cloud = rows.observe()[POINT_CLOUD][0].numpy()
    kept = cloud[np.abs(cloud).sum(axis=1) > 0]
    assert abs(len(kept) - len(expected)) <= 2
    gaps = np.array([np.abs(expected - point).sum(axis=1).min() for point in kept[::5]])
    assert gaps.max() < 1e-4
    if name == "hammer":
        assert len(expected) < 512, "so that there is something to pad"
        with simulator(f"adroit/{name}", seed=4, obs_preset="dp3") as rows:
            padded = rows.observe()[POINT_CLOUD][0].numpy()
        assert padded[: len(kept)].any(axis=1).all()
        assert not padded[len(kept) :].any()
        with simulator(f"adroit/{name}", seed=4) as rows:
            repeated = rows.observe()[POINT_CLOUD][0].numpy()
        assert repeated.any(axis=1).all(), "the package's own clouds repeat points"


@pytest.mark.parametrize("name", NAMES)
def test_the_cloud_holds_the_object_and_no_table(name):
    body = {"door": "latch", "hammer": "nail_board", "pen": "target"}[name]
    with simulator(f"adroit/{name}", seed=1, num_points=3000) as rows:
        cloud = rows.observe()[POINT_CLOUD][0]
        assert cloud[:, 2].min() > 0.004
        where = torch.tensor(rows.env.data.body(body).xpos, dtype=torch.float32)
        assert (cloud - where).norm(dim=1).min() < 0.08


def test_image_and_depth_are_of_one_pixel_grid():
    with simulator("adroit/pen", seed=1, obs=(IMAGE, DEPTH, POINT_CLOUD), num_points=4000, image_size=(60, 80)) as rows:
        frame = rows.observe()
        assert frame[IMAGE].shape == (1, 60, 80, 3)
        depth = frame[DEPTH][0].numpy()
        assert depth.shape == (60, 80)
        assert (depth == 0).any(), "the sky is nothing"
        assert depth.max() < 10
        nearest = frame[POINT_CLOUD][0].numpy() - rows.env.data.cam_xpos[rows._camera]
        along = -nearest @ rows.env.data.cam_xmat[rows._camera].reshape(3, 3)[:, 2]
        assert along.min() == pytest.approx(depth[depth > 0].min(), abs=1e-5)


# ---- stored states --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_stored_states_bring_back_the_observations(name):
    with simulator(f"adroit/{name}", seed=3) as rows:
        states, frames, exact = [rows.save_state()], [rows.observe()], [rows.env.state()]
        actions = smooth_actions(rows.spec.action.dim, 10, seed=1)
        for action in actions:
            rows.step(action)
            states.append(rows.save_state())
            frames.append(rows.observe())
            exact.append(rows.env.state())
    with simulator(f"adroit/{name}", seed=8) as other:
        for state, frame, numbers in list(zip(states, frames, exact, strict=True))[::-2]:
            other.restore_state(state)
            assert other.env.state() == pytest.approx(numbers, abs=1e-12 if name == "pen" else 0)
            assert equal_frames(other.observe(), frame) == []
        for action, frame in zip(actions, frames[1:], strict=True):
            other.step(action)
            assert equal_frames(other.observe(), frame) == []
