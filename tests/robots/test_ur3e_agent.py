"""The agent in simulation: controllers, signs, limits, opening, grasp."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.agents.controllers.utils.kinematics import Kinematics
from mani_skill.trajectory.utils.actions.conversion import delta_pose_to_pd_ee_delta
from mani_skill.utils.geometry.rotation_conversions import matrix_to_quaternion
from mani_skill.utils.structs import Pose

from manicm_ms.errors import ConfigError
from manicm_ms.robots.controllers import LimitedPoseControllerConfig
from manicm_ms.robots.limits import quat_conjugate, quat_from_rotvec, quat_multiply, rotvec_from_quat
from manicm_ms.robots.ur3e_ag95 import (
    ARM_JOINTS,
    FINGER_SPEED,
    JOINT_EFFORT,
    JOINT_SPEED,
    OPENING_MAX,
    TCP_STEP,
    TCP_TURN,
    WORKSPACE_LOWER,
    WORKSPACE_UPPER,
    opening_to_action,
)

MODES = ("pd_ee_target_delta_pose", "pd_ee_delta_pose", "pd_ee_pose", "pd_joint_pos", "pd_joint_delta_pos")


def play(env: Any, action: list[float], steps: int = 1) -> None:
    for _ in range(steps):
        env.step(torch.tensor([action], dtype=torch.float32))


def put_cube_away(env: Any) -> None:
    env.cube.set_pose(Pose.create_from_pq(torch.tensor([[0.6, 0.4, 0.02]])))


def rotation_between(pose: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    return rotvec_from_quat(quat_multiply(pose[:, 3:], quat_conjugate(reference[:, 3:])))[0]


def test_modes_and_the_default(make_robot_env: Any) -> None:
    agent = make_robot_env().agent
    assert set(agent.supported_control_modes) == set(MODES)
    assert agent.control_mode == "pd_ee_target_delta_pose"
    assert agent.single_action_space.shape == (7,)
    assert (agent.single_action_space.low == -1).all()
    assert (agent.single_action_space.high == 1).all()


@pytest.mark.parametrize("mode", MODES)
def test_action_spaces_are_finite(make_robot_env: Any, mode: str) -> None:
    space = make_robot_env(control_mode=mode).agent.single_action_space
    assert space.shape == (7,)
    assert np.isfinite(space.low).all()
    assert np.isfinite(space.high).all()
    assert (space.low < space.high).all()


def test_ready_pose(make_robot_env: Any) -> None:
    agent = make_robot_env().agent
    pose = agent.tcp_pose_at_base
    np.testing.assert_allclose(pose[0, :3], [0.30, 0.0, 0.25], atol=1e-4)
    down = agent.tcp.pose.to_transformation_matrix()[0, :3, 2]
    np.testing.assert_allclose(down, [0, 0, -1], atol=1e-4)
    assert float(agent.opening) == pytest.approx(OPENING_MAX, abs=1e-6)


@pytest.mark.parametrize("name", ["ready", "ready_closed", "rest", "upright"])
def test_keyframes_touch_nothing_and_stand(make_robot_env: Any, name: str) -> None:
    env = make_robot_env(control_mode="pd_joint_pos")
    put_cube_away(env)
    keyframe = env.agent.keyframes[name]
    qpos = torch.tensor(keyframe.qpos)[None]
    env.agent.reset(qpos)
    env.agent.controller.reset()
    opening = opening_to_action(float(keyframe.qpos[6:].sum()))
    play(env, [*keyframe.qpos[:6].tolist(), opening], 5)
    own = {link.name for link in env.agent.robot.links}
    for contact in env.scene.get_contacts():
        names = {body.entity.name.split("_", 1)[-1] for body in contact.bodies}
        assert not names & own, contact.bodies
    np.testing.assert_allclose(env.agent.robot.get_qpos(), qpos, atol=1e-3)
    assert bool(env.agent.is_static()[0])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_target_mode_moves_the_tcp_as_commanded(make_robot_env: Any, axis: int, sign: int) -> None:
    env = make_robot_env()
    play(env, [0, 0, -1, 0, 0, 0, 1], 8)  # away from the edge of the reachable set
    play(env, [0, 0, 0, 0, 0, 0, 1], 20)
    start, target = env.agent.tcp_pose_at_base, env.agent.tcp_target_pose
    action = [0.0] * 6 + [1.0]
    action[axis] = float(sign)
    play(env, action, 4)
    asked = torch.zeros(3)
    asked[axis] = sign * 4 * TCP_STEP
    torch.testing.assert_close(env.agent.tcp_target_pose[0, :3] - target[0, :3], asked, atol=1e-6, rtol=0)
    play(env, [0, 0, 0, 0, 0, 0, 1], 20)
    torch.testing.assert_close(env.agent.tcp_pose_at_base[0, :3] - start[0, :3], asked, atol=5e-4, rtol=0)
    assert rotation_between(env.agent.tcp_pose_at_base, start).norm() < 2e-3


@pytest.mark.parametrize("mode", ["pd_ee_target_delta_pose", "pd_ee_delta_pose"])
@pytest.mark.parametrize("axis", [3, 4, 5])
@pytest.mark.parametrize("sign", [1, -1])
def test_positive_action_turns_counter_clockwise(make_robot_env: Any, mode: str, axis: int, sign: int) -> None:
    env = make_robot_env(control_mode=mode)
    play(env, [0, 0, -1, 0, 0, 0, 1], 8)
    play(env, [0, 0, 0, 0, 0, 0, 1], 20)
    start = env.agent.tcp_pose_at_base
    action = [0.0] * 6 + [1.0]
    action[axis] = float(sign)
    play(env, action, 4)
    play(env, [0, 0, 0, 0, 0, 0, 1], 20)
    turned = rotation_between(env.agent.tcp_pose_at_base, start)
    others = [i for i in range(3) if i != axis - 3]
    if mode == "pd_ee_target_delta_pose":
        assert turned[axis - 3] == pytest.approx(sign * 4 * TCP_TURN, abs=5e-3)
    else:  # without a target the drives' lag eats part of every step
        assert 0.1 * TCP_TURN < sign * turned[axis - 3] < 4 * TCP_TURN
    assert turned[others].abs().max() < 0.02


def test_rotation_is_clipped_by_its_norm(make_robot_env: Any) -> None:
    env = make_robot_env()
    start = env.agent.tcp_target_pose.clone()
    play(env, [0, 0, 0, 1, 1, 1, 1])
    turned = rotation_between(env.agent.tcp_target_pose, start)
    torch.testing.assert_close(turned, torch.full((3,), TCP_TURN / 3**0.5), atol=1e-5, rtol=0)


def test_trajectory_converter_finds_the_action(make_robot_env: Any) -> None:
    # ManiSkill's converter (replay_trajectory) hands over the inverse rotation; its result must still lead to the goal.
    env = make_robot_env()
    agent = env.agent
    play(env, [0, 0, -1, 0, 0, 0, 1], 8)
    now = agent.tcp_target_pose
    turn = torch.tensor([[0.02, -0.03, 0.04]])
    goal = torch.cat([now[:, :3] + 0.005, quat_multiply(quat_from_rotvec(turn), now[:, 3:])], dim=1)
    inverse = Pose.create(now).sp * Pose.create(goal).sp.inv()
    delta = sapien.Pose((goal - now)[0, :3].numpy(), inverse.q)
    action = delta_pose_to_pd_ee_delta(agent.controller.controllers["arm"], delta)
    play(env, [*action.tolist(), 1.0])
    reached = agent.tcp_target_pose
    torch.testing.assert_close(reached[:, :3], goal[:, :3], atol=1e-5, rtol=0)
    assert rotation_between(reached, goal).norm() < 1e-4


def test_absolute_pose_is_reached(make_robot_env: Any) -> None:
    env = make_robot_env(control_mode="pd_ee_pose")
    play(env, [0.33, 0.05, 0.12, np.pi, 0.0, np.pi / 2, 1.0], 60)
    pose = env.agent.tcp_pose_at_base
    np.testing.assert_allclose(pose[0, :3], [0.33, 0.05, 0.12], atol=5e-4)
    T = env.agent.tcp.pose.to_transformation_matrix()[0]
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1], atol=5e-3)
    np.testing.assert_allclose(T[:3, 0].abs(), [0, 1, 0], atol=5e-3)


def test_joint_modes(make_robot_env: Any) -> None:
    env = make_robot_env(control_mode="pd_joint_pos")
    goal = (env.agent.arm_qpos[0] + torch.tensor([0.1, -0.1, 0.1, 0.1, -0.1, 0.2])).tolist()
    play(env, [*goal, 1.0], 40)
    np.testing.assert_allclose(env.agent.arm_qpos[0], goal, atol=5e-3)
    env = make_robot_env(control_mode="pd_joint_delta_pos")
    start = env.agent.arm_qpos.clone()
    play(env, [1, 0, 0, 0, 0, -1, 1], 4)
    moved = (env.agent.arm_qpos - start)[0]
    assert moved[0] > 0.05
    assert moved[5] < -0.05
    assert moved[1:5].abs().max() < 0.02


def test_random_actions_keep_joint_speeds_and_workspace(make_robot_env: Any) -> None:
    env, rng = make_robot_env(), np.random.default_rng(0)
    limits = torch.tensor(JOINT_SPEED)
    lower, upper = torch.tensor(WORKSPACE_LOWER), torch.tensor(WORKSPACE_UPPER)
    for seed in range(3):
        env.reset(seed=seed)
        fastest = 0.0
        for _ in range(200):
            play(env, rng.uniform(-1, 1, 7).tolist())
            fastest = max(fastest, float((env.agent.arm_qvel[0].abs() / limits).max()))
            target = env.agent.tcp_target_pose[0, :3]
            assert (target >= lower - 1e-6).all()
            assert (target <= upper + 1e-6).all()
        assert fastest < 1.2


@pytest.mark.parametrize(
    "direction", [(1, 0, 1, 0, 0, 0), (1, 1, 0, 1, 0, 0), (-1, -1, 1, 0, 1, 0), (0, 0, -1, 0, 0, 0)]
)
def test_pushing_against_any_edge_stays_calm(make_robot_env: Any, direction: tuple[int, ...]) -> None:
    env = make_robot_env()
    put_cube_away(env)
    limits = torch.tensor(JOINT_SPEED)
    fastest, lead = 0.0, 0.0
    for _ in range(100):
        play(env, [*map(float, direction), -1.0])
        fastest = max(fastest, float((env.agent.arm_qvel[0].abs() / limits).max()))
        ahead = env.agent.tcp_target_pose - env.agent.tcp_pose_at_base
        lead = max(lead, float(ahead[0, :3].norm()))
    assert fastest < 1.2
    assert lead < 0.15
    play(env, [0, 0, 0, 0, 0, 0, -1.0], 40)
    assert bool(env.agent.is_static()[0])


def test_arm_drives_are_the_real_efforts(make_robot_env: Any) -> None:
    robot = make_robot_env().agent.robot
    for name, effort in zip(ARM_JOINTS, JOINT_EFFORT, strict=True):
        joint = robot.joints_map[name]
        assert float(joint.force_limit) == pytest.approx(effort)
        assert float(joint.stiffness) == pytest.approx(1e3)


def test_opening_follows_the_action(make_robot_env: Any) -> None:
    from gripper_hold import pad_distance

    env = make_robot_env()
    for opening in (0.08, 0.05, 0.01, 0.0, OPENING_MAX):
        play(env, [0, 0, 0, 0, 0, 0, opening_to_action(opening)], 40)
        assert float(env.agent.opening) == pytest.approx(opening, abs=1e-4)
        assert pad_distance(env) == pytest.approx(opening, abs=1e-4)
        left, right = (
            f.pose.to_transformation_matrix()[0, :3, :3] for f in (env.agent.left_finger, env.agent.right_finger)
        )
        np.testing.assert_allclose(left[:, 2], right[:, 2], atol=1e-5)
        np.testing.assert_allclose(left[:, 0], -right[:, 0], atol=1e-5)


def test_opening_target_moves_at_the_real_speed(make_robot_env: Any) -> None:
    env = make_robot_env()
    targets = []
    for _ in range(20):
        play(env, [0, 0, 0, 0, 0, 0, -1])
        targets.append(float(env.agent.opening_target))
    steps = -np.diff([OPENING_MAX, *targets])
    most = 2 * FINGER_SPEED / 20
    assert steps.max() <= most + 1e-7
    np.testing.assert_allclose(steps[:13], most, atol=1e-6)
    assert targets[-1] == pytest.approx(0.0, abs=1e-6)  # after the data sheet's 0.7 s = 14 steps
    assert targets[12] > 0.005


def test_a_hold_neither_slips_nor_tilts(make_robot_env: Any) -> None:
    from gripper_hold import measure_hold

    hold = measure_hold(0.04, seconds=1.5)
    assert max(hold.hold_slip, hold.shake_slip) < 1e-3
    assert max(hold.tilt, hold.shake_tilt) < 0.5
    assert abs(hold.gap_error) < 1e-3
    assert hold.force == pytest.approx((20.0, 20.0), abs=2.0)  # stiffness times half the edge


def test_is_grasping(make_robot_env: Any) -> None:
    from gripper_hold import grasp_and_lift

    env = make_robot_env()
    assert not bool(env.agent.is_grasping(env.cube)[0])
    grasp_and_lift(env)
    assert bool(env.agent.is_grasping(env.cube)[0])
    assert float(env.cube.pose.p[0, 2]) > 0.12
    left, right = env.agent.pad_forces(env.cube)
    assert left.shape == right.shape == (1, 3)
    np.testing.assert_allclose(left + right, torch.zeros(1, 3), atol=1.5)  # the pads balance, but for the weight
    play(env, [0, 0, 0, 0, 0, 0, 1], 20)
    assert not bool(env.agent.is_grasping(env.cube)[0])


def test_reset_forgets_the_target(make_robot_env: Any) -> None:
    env = make_robot_env()
    play(env, [1, -1, -1, 1, 0, 0, -1], 6)
    env.reset(seed=0)
    torch.testing.assert_close(env.agent.tcp_target_pose, env.agent.tcp_pose_at_base, atol=1e-6, rtol=0)
    assert float(env.agent.opening_target) == pytest.approx(OPENING_MAX, abs=1e-6)


def test_batched_inverse_kinematics_of_the_gpu_path(make_robot_env: Any) -> None:
    # The solver that ManiSkill uses on a GPU runs on any device: 64 rows at once, started where the CPU one starts.
    env = make_robot_env()
    agent = env.agent
    arm = agent.controller.controllers["arm"]
    kinematics = Kinematics(agent.urdf_path, "tcp", agent.robot, arm.active_joint_indices)
    kinematics._setup_gpu()
    rng = torch.Generator().manual_seed(0)
    play(env, [0, 0, -1, 0, 0, 0, 1], 8)  # away from the edge of the reachable set
    q0 = agent.robot.get_qpos().repeat(64, 1) + 0.05 * torch.randn(64, 8, generator=rng)
    T = kinematics.pk_chain.forward_kinematics(q0[:, :6]).get_matrix()
    shift = 0.01 * torch.randn(64, 3, generator=rng)
    turn = quat_from_rotvec(0.05 * torch.randn(64, 3, generator=rng))
    pose = torch.cat([T[:, :3, 3] + shift, quat_multiply(turn, matrix_to_quaternion(T[:, :3, :3]))], dim=1)
    stand_in = SimpleNamespace(
        articulation=SimpleNamespace(get_qpos=lambda: q0),
        active_joint_indices=arm.active_joint_indices,
        kinematics=kinematics,
        config=arm.config,
    )
    solution = q0[:, :6]
    for _ in range(3):  # one step per control step: the error shrinks quadratically
        solution = type(arm)._solve(stand_in, Pose.create(pose), solution)
    reached = kinematics.pk_chain.forward_kinematics(solution).get_matrix()
    np.testing.assert_allclose(reached[:, :3, 3], pose[:, :3], atol=2e-4)
    assert solution.shape == (64, 6)


def test_speeds_must_match_the_joints() -> None:
    with pytest.raises(ConfigError, match="one per joint"):
        LimitedPoseControllerConfig(joint_names=["a", "b"], pos_lower=-1, pos_upper=1, max_joint_speed=(1.0,))
