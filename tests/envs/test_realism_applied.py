"""What the simulator applied is what was sampled, read back from PhysX, the renderer and the observations."""

import math

import numpy as np
import pytest
import torch

from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.errors import ConfigError
from manicm_ms.robots.ur3e_ag95 import FINGER_JOINTS, UR3eAG95
from manicm_ms.sensing.camera_files import default_camera
from manicm_ms.sensing.realism import REALISM, Realism, believed_poses, displaced, true_cameras
from manicm_ms.spec import AGENT_POS, DEPTH, IMAGE, POINT_CLOUD, STATE

ENV_ID, SEED = "ur3e/slide-block", 11
ROW = torch.zeros(1, dtype=torch.int64)
NOMINAL = {"cube": (0.4, 0.20, (0.030,) * 3), "block": (0.2, 0.05, (0.020, 0.020, 0.015)), "table": (0.8, None, None)}
"""Friction, mass in kg, half edges in m: what the task is documented to have."""


def build(realism, obs=(POINT_CLOUD, AGENT_POS, STATE), env_id=ENV_ID, **options):
    entry = ENVS.get(env_id)
    config = SimulatorConfig(obs=obs, realism=realism, **options)
    return entry.build(config.specialise(entry.spec), config)


@pytest.fixture(scope="module")
def simulator():
    simulator = build(REALISM.get("d435i+dr"), obs=(POINT_CLOUD, AGENT_POS, STATE, IMAGE), colors=True)
    yield simulator
    simulator.close()


@pytest.fixture(scope="module")
def ideal():
    """The ideal world, for comparison."""
    simulator = build(Realism(), obs=(POINT_CLOUD, DEPTH, STATE))
    yield simulator
    simulator.close()


@pytest.fixture(scope="module")
def drawn(simulator):
    simulator.reset(ROW, [SEED])  # tests that reset to another seed come back to this one
    return ENVS.get(ENV_ID).conditions(REALISM.get("d435i+dr"), SEED)


def shape_of(actor):
    (shape,) = actor._bodies[0].collision_shapes
    return shape


def test_friction_mass_and_size_are_as_drawn(simulator, drawn):
    for name in ("cube", "block", "table"):
        friction, mass, half = NOMINAL[name]
        actor = simulator.env.table if name == "table" else simulator.env.objects[name]
        material = shape_of(actor).physical_material
        assert material.static_friction == pytest.approx(friction * drawn[f"{name}.friction_factor"])
        assert material.dynamic_friction == material.static_friction
        if mass is None:
            continue
        size = np.array(half) * drawn[f"{name}.size_factor"]
        assert actor._bodies[0].mass == pytest.approx(mass * drawn[f"{name}.mass_factor"])
        np.testing.assert_allclose(shape_of(actor).half_size, size, rtol=1e-6)
        np.testing.assert_allclose(simulator.env.half_sizes[name][0], size, rtol=1e-6)


def test_gains_are_as_drawn(simulator, drawn):
    nominal = {"arm": (UR3eAG95.arm_stiffness, UR3eAG95.arm_damping)}
    nominal["finger"] = (UR3eAG95.finger_stiffness, UR3eAG95.finger_damping)
    for joint in simulator.env.agent.robot.active_joints:
        part = "finger" if joint.name in FINGER_JOINTS else "arm"
        (drive,) = joint._objs
        assert drive.stiffness == pytest.approx(nominal[part][0] * drawn[f"{part}_stiffness_factor"])
        assert drive.damping == pytest.approx(nominal[part][1] * drawn[f"{part}_damping_factor"])


def test_the_table_stands_as_high_as_drawn_and_everything_is_told_in_the_base_frame(simulator, drawn):
    height, env = drawn["table_height"], simulator.env
    assert env.agent.robot.pose.p[0].tolist() == pytest.approx([0, 0, -height], abs=1e-7)
    start, stop = simulator.spec.state_layout["cube_pose"]
    cube = simulator.observe()[STATE][0, start:stop]
    assert float(cube[2]) == pytest.approx(0.030 * drawn["cube.size_factor"] + height, abs=4e-4)
    torch.testing.assert_close(cube[:2], env.cube.pose.p[0, :2])
    # The TCP starts at the same pose in the base frame whatever the table: the joints were set, not the world pose.
    world = env.agent.tcp_pose.p[0]
    torch.testing.assert_close(env.agent_pos()[0, :3] - world, torch.tensor([0.0, 0.0, height]), atol=1e-6, rtol=0)


def test_the_camera_stands_and_looks_as_drawn(simulator, drawn):
    shift = [drawn[f"camera_{axis}"] for axis in "xyz"]
    turn = [drawn[f"camera_r{axis}"] for axis in "xyz"]
    T = default_camera().pose
    angle = math.sqrt(sum(a * a for a in turn))
    T_world_camera = simulator._camera.camera.get_model_matrix()[0].numpy() @ np.diag([1, -1, -1, 1])  # OpenCV axes
    at_base = T_world_camera[:3, 3] + [0, 0, drawn["table_height"]]
    np.testing.assert_allclose(at_base, T[:3, 3] + shift, atol=1e-6)
    turned = T_world_camera[:3, :3] @ T[:3, :3].T  # what was turned, about the axes of the base frame
    assert math.acos((np.trace(turned) - 1) / 2) == pytest.approx(angle, rel=1e-3)
    skew = np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / 2
    np.testing.assert_allclose(skew / math.sin(angle) * angle, turn, atol=2e-6)


def test_the_lens_is_as_drawn(simulator, drawn):
    camera = default_camera()
    K = simulator._camera.camera.get_intrinsic_matrix()[0].numpy()
    focal = [camera.fx * drawn["focal_factor"], camera.fy * drawn["focal_factor"]]
    np.testing.assert_allclose([K[0, 0], K[1, 1]], focal, rtol=1e-6)
    centre = [camera.cx - 169 + 0.5 + drawn["centre_u"], camera.cy - 89 + 0.5 + drawn["centre_v"]]
    np.testing.assert_allclose([K[0, 2], K[1, 2]], centre, rtol=1e-6)


def test_clouds_are_mapped_with_the_extrinsic_error_and_the_scale(simulator, drawn):
    assert simulator._view._clouds._scale.tolist() == pytest.approx([drawn["depth_scale_factor"]])
    truth = simulator._camera.camera.get_model_matrix()[0].double().numpy() @ np.diag([1, -1, -1, 1])
    truth[2, 3] += drawn["table_height"]
    shift, turn = ([drawn[f"extrinsic_{axis}"] for axis in axes] for axes in ("xyz", ("rx", "ry", "rz")))
    expected = displaced(truth, np.array([shift]), np.array([turn]))[0]
    np.testing.assert_allclose(simulator._view._clouds._T_base_camera[0], expected, atol=2e-6)


def test_colours_are_as_drawn(simulator, drawn):
    white = np.array([0.92, 0.92, 0.90]) + [drawn[f"cube.{channel}"] for channel in ("red", "green", "blue")]
    (part,) = simulator.env.cube._objs[0].find_component_by_type(_render_body()).render_shapes
    np.testing.assert_allclose(part.material.base_color[:3], white.clip(0, 1), atol=1e-6)


def _render_body():
    import sapien

    return sapien.render.RenderBodyComponent


def test_the_same_seed_looks_the_same_and_another_does_not(simulator, drawn):
    first = simulator.observe()
    simulator.reset(ROW, [SEED + 1])
    other = simulator.observe()
    simulator.reset(ROW, [SEED])
    again = simulator.observe()
    for key in (POINT_CLOUD, AGENT_POS, STATE, IMAGE):
        assert torch.equal(first[key], again[key]), key
        assert not torch.equal(first[key], other[key]), key


def test_the_tasks_own_scene_does_not_depend_on_realism(simulator, drawn, ideal):
    """Where the task puts its objects comes from the seed alone; only what realism moved differs."""
    start, stop = simulator.spec.state_layout["cube_pose"]
    cube = simulator.observe()[STATE][0, start:stop]
    ideal.reset(ROW, [SEED])
    plain = ideal.observe()[STATE][0, start:stop]
    assert torch.equal(cube[[0, 1, 3, 4, 5, 6]], plain[[0, 1, 3, 4, 5, 6]])


def test_actions_arrive_as_late_as_drawn(ideal):
    """With delays alone the arm's target is that of the undelayed simulator, d steps later; the gripper's too."""
    realism = Realism(action_delay=3, gripper_delay=2)
    seed = next(s for s in range(99) if {1.0} < set(realism.sample(s).values()) == {2.0, 1.0})
    drawn = realism.sample(seed)
    late = build(realism, obs=(STATE,))
    arm, hand = int(drawn["action_delay"]), int(drawn["action_delay"] + drawn["gripper_delay"])
    try:
        targets, openings = [], []
        for simulator in (late, ideal):
            simulator.reset(ROW, [seed])
            targets.append([simulator.env.agent.tcp_target_pose.clone()])
            openings.append([simulator.env.agent.opening_target.clone()])
            for _ in range(8):
                simulator.step(torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]]))
                targets[-1].append(simulator.env.agent.tcp_target_pose.clone())
                openings[-1].append(simulator.env.agent.opening_target.clone())
    finally:
        late.close()
    for k in range(9):
        torch.testing.assert_close(targets[0][k], targets[1][max(k - arm, 0)], atol=3e-4, rtol=0)
        torch.testing.assert_close(openings[0][k], openings[1][max(k - hand, 0)], atol=1e-7, rtol=0)
    assert (targets[1][8] - targets[1][0]).norm() > 0.03
    assert float(openings[1][8]) > 0.02


def test_a_camera_file_alone_gives_exact_depth_of_its_own_view(ideal):
    simulator = build(Realism(), obs=(POINT_CLOUD, DEPTH), camera=default_camera())
    try:
        simulator.reset(ROW, [SEED])
        ideal.reset(ROW, [SEED])
        ours, theirs = simulator.observe(), ideal.observe()
    finally:
        simulator.close()
    assert ours[DEPTH].shape == theirs[DEPTH].shape == (1, 84, 84)
    # The same field of view: a pixel of the one looks within half a pixel of the other's direction.
    difference = (ours[DEPTH] - theirs[DEPTH]).abs()
    assert difference.median() < 2e-3
    nearest = torch.cdist(ours[POINT_CLOUD][0].double(), theirs[POINT_CLOUD][0].double()).amin(dim=1)
    assert nearest.median() < 5e-3


def test_a_box_of_several_parts_must_be_named_as_fixed():
    from manicm_ms.tasks.transfer_piece import ENV_ID as TRANSFER  # the package's name for the folder tasks/

    entry = ENVS.get(TRANSFER)
    assert entry.fixed == ("box",)
    simulator = build(Realism(size=0.05), obs=(STATE,), env_id=TRANSFER)
    try:
        simulator.reset(ROW, [0])  # the tray keeps its size
        sizes = dict.fromkeys(("box.size_factor", "piece.size_factor"), 1.02)
        with pytest.raises(ConfigError, match=r"box is not built by build_box.*EnvEntry\.fixed"):
            simulator.env.reset(seed=0, options={"reconfigure": True, "realism": type(simulator._values)([sizes])})
    finally:
        simulator.close()


# ---- N rows -------------------------------------------------------------------------------------------------------


def samples(count):
    return [REALISM.get("d435i+dr").sample(seed, ("cube",)) for seed in range(count)]


def test_rows_of_cameras_are_those_of_single_rows():
    from manicm_ms.sensing.realism import RealismRows

    camera, drawn = default_camera(), samples(6)
    together = true_cameras(camera, RealismRows(drawn))
    believed = believed_poses(together, RealismRows(drawn))
    for k in range(6):
        (alone,) = true_cameras(camera, RealismRows(drawn[k : k + 1]))
        assert together[k] == alone
        np.testing.assert_array_equal(believed[k], believed_poses([alone], RealismRows(drawn[k : k + 1]))[0])
    assert len({c.fx for c in together}) == 6


def test_displaced_turns_about_the_pose_itself():
    T = default_camera().pose
    (moved,) = displaced(T, np.array([[0.01, 0.0, -0.02]]), np.array([[0.0, 0.0, math.pi / 2]]))
    np.testing.assert_allclose(moved[:3, 3], T[:3, 3] + [0.01, 0.0, -0.02])
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(moved[:3, :3], quarter @ T[:3, :3], atol=1e-12)
    np.testing.assert_array_equal(displaced(T, np.zeros((3, 3)), np.zeros((3, 3))), np.repeat(T[None], 3, axis=0))
