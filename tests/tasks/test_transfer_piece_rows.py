"""Transfer Piece on constructed states: each flag means what it says, and the reward grows from stage to stage."""

import itertools
import math

import fake_rows
import pytest
import torch
from fake_rows import fresh, turned
from manicm_ms.tasks.transfer_piece import TransferPieceEnv

from manicm_ms.envs.cameras import D435I
from manicm_ms.robots.limits import pose_in_frame, quat_rotate

RIGHT = -0.0425  # m: y of the right compartment's centre in the box's frame
LYING = 0.023  # m: height of the centre of a piece that stands on the floor of the box
ON_WALL = 0.058  # m: the same on a wall
WITHDRAWN_TCP = 0.038 + 0.003 + 0.017  # m: walls, clearance, and from the TCP to the fingertips
MOTIONS = [("linear_velocity", 0.009, 0.011), ("angular_velocity", 0.4, 0.6)]  # m/s, rad/s
DONE = {"success", "placed", "withdrawn", "still"}
IDLE = {"withdrawn", "still"}


def with_piece(x, y, z=LYING, box_yaw=0.08, tcp_z=0.10):
    """Return a scene whose first row's piece stands at (x, y, z), m, in the frame of a box that is turned."""
    env = fresh(TransferPieceEnv, 4)
    env.agent.tcp.raw[:, 2] = 0.25
    env.agent.tcp.raw[0, 2] = tcp_z
    env.box.raw[0] = torch.cat([torch.tensor([0.32, 0.01, 0.0]), turned(box_yaw, 2)])
    env.piece.raw[0, :3] = env.box.raw[0, :3] + quat_rotate(env.box.raw[:1, 3:], torch.tensor([[x, y, z]]))[0]
    env.piece.raw[0, 3:] = turned(0.5, 2)
    return env


def flags(env):
    return fake_rows.flags(env, untouched=IDLE)


def test_piece_in_the_right_compartment_is_success():
    assert flags(with_piece(0.0, RIGHT)) == DONE


def test_right_is_the_robots_right():
    """Base -y, seen from behind the robot; the piece starts at +y."""
    env = fresh(TransferPieceEnv, 8)
    assert (env.piece.raw[:, 1] > env.box.raw[:, 1]).all()
    env = with_piece(0.0, RIGHT, box_yaw=0.0)
    assert env.piece.raw[0, 1] < env.box.raw[0, 1]
    assert flags(env) == DONE


def test_in_the_cameras_picture_left_and_right_are_swapped():
    """The camera looks at the robot: what lies in the robot's left compartment is on the right of the picture."""
    to_base = D435I.pose.to_transformation_matrix()  # SAPIEN's camera axes: x forward, y to the picture's left, z up
    left, right = (to_base[:3, 1] @ ([0.32, y, 0.02] - to_base[:3, 3]) for y in (-RIGHT, RIGHT))
    assert left < right


def test_piece_in_the_left_compartment_is_not():
    assert flags(with_piece(0.0, -RIGHT)) == IDLE


def test_piece_on_the_divider_is_not():
    assert flags(with_piece(0.0, 0.0, ON_WALL)) == IDLE


@pytest.mark.parametrize(("x", "y"), [(0.06, RIGHT), (0.0, -0.08), (0.06, -0.08)])
def test_piece_on_an_outer_wall_is_not(x, y):
    assert flags(with_piece(x, y, ON_WALL)) == IDLE


@pytest.mark.parametrize(
    ("x", "y", "counts"),
    [
        (0.064, RIGHT, True),
        (0.066, RIGHT, False),
        (-0.064, RIGHT, True),
        (-0.066, RIGHT, False),
        (0.0, RIGHT + 0.039, True),
        (0.0, RIGHT + 0.041, False),
        (0.0, RIGHT - 0.039, True),
        (0.0, RIGHT - 0.041, False),
    ],
)
@pytest.mark.parametrize("box_yaw", [0.0, 0.087, 1.2])
def test_the_compartments_inner_walls_bound_it_in_the_boxs_frame(x, y, counts, box_yaw):
    assert flags(with_piece(x, y, box_yaw=box_yaw)) == (DONE if counts else IDLE)


@pytest.mark.parametrize(("z", "counts"), [(0.018, True), (0.029, True), (0.031, False)])
def test_how_high_a_piece_counts_as_lying(z, counts):
    assert flags(with_piece(0.0, RIGHT, z)) == (DONE if counts else IDLE)


@pytest.mark.parametrize(("above", "counts"), [(-0.001, False), (0.001, True)])
def test_the_fingertips_must_be_out_of_the_box(above, counts):
    found = flags(with_piece(0.0, RIGHT, tcp_z=WITHDRAWN_TCP + above))
    assert found == (DONE if counts else {"placed", "still"})


@pytest.mark.parametrize(("motion", "slow", "fast"), MOTIONS)
def test_moving_piece_is_not_yet(motion, slow, fast):
    for speed, expected in ((slow, DONE), (fast, {"placed", "withdrawn"})):
        env = with_piece(0.0, RIGHT)
        getattr(env.piece, motion)[0, 2] = speed
        assert flags(env) == expected


def test_grasped_piece_is_not_yet():
    env = with_piece(0.0, RIGHT)
    env.hold("piece", 1.0)
    assert flags(env) == {"placed", "withdrawn", "still", "grasped"}


def test_one_pad_alone_is_no_grasp():
    env = with_piece(0.0, RIGHT)
    env.press(env.agent.right_finger, "piece", (5.0, 0.0, 0.0))
    assert flags(env) == DONE


@pytest.mark.parametrize(
    ("x", "y", "fails"),
    [
        (0.069, RIGHT, False),
        (0.071, RIGHT, True),
        (-0.071, -RIGHT, True),
        (0.0, -0.087, False),
        (0.0, -0.088, True),
        (0.0, 0.088, True),
    ],
)
def test_piece_outside_the_box_fails(x, y, fails):
    assert flags(with_piece(x, y, 0.02)) == (IDLE | {"fail"} if fails else IDLE)


def test_piece_fallen_off_the_table_fails():
    assert flags(with_piece(0.5, 0.0, -0.4)) == IDLE | {"fail"}


def test_piece_carried_past_the_box_does_not_fail():
    env = with_piece(0.12, 0.0, 0.10)
    assert flags(env) == IDLE
    low = with_piece(0.12, 0.0, 0.02)
    low.hold("piece", 5.0)
    assert flags(low) == IDLE | {"grasped"}


def test_the_piece_starts_on_the_boxs_floor_as_high_as_it_is():
    env = fresh(TransferPieceEnv, 4)
    env.half_sizes["piece"][:, 2] = torch.tensor([0.018, 0.020, 0.021, 0.022])
    env.reset(range(4), range(4))
    torch.testing.assert_close(env.piece.raw[:, 2], 0.003 + env.half_sizes["piece"][:, 2] + 3e-4)


def test_the_piece_starts_clear_of_the_walls():
    """Half its diagonal and the largest offset leave room to every wall of the compartment."""
    env = fresh(TransferPieceEnv, 600)
    reach = math.hypot(0.015, 0.015)
    off = pose_in_frame(env.piece.raw, env.box.raw)[:, :2] - torch.tensor([0.0, -RIGHT])
    assert (off.abs() + reach < torch.tensor([0.065, 0.040])).all()


def test_the_goal_lies_as_high_as_the_piece_is():
    """A larger piece that is held where it would stand has been carried all the way."""
    env = with_piece(0.0, RIGHT, z=0.003 + 0.023)
    env.half_sizes["piece"][0, 2] = 0.023
    env.hold("piece", 10.0)
    facts = env.evaluate() | {"placed": torch.zeros(4, dtype=torch.bool)}  # which earns the whole term by itself
    torch.testing.assert_close(env.reward_terms(facts)["carry"][0].item(), 1.0, atol=1e-5, rtol=0)


def staged(x, y, z, tcp_above, held=False):
    env = with_piece(x, y, z)
    env.agent.tcp.raw[0, :3] = env.piece.raw[0, :3] + torch.tensor([0.0, 0.0, tcp_above])
    if held:
        env.hold("piece", 10.0)
    return env


def test_reward_grows_from_start_over_grasp_and_carry_to_success():
    stages = [
        staged(0.0, -RIGHT, LYING, tcp_above=0.2),
        staged(0.0, -RIGHT, LYING, tcp_above=0.0),
        staged(0.0, -RIGHT, LYING, tcp_above=0.0, held=True),
        staged(0.0, 0.0, 0.06, tcp_above=0.0, held=True),
        staged(0.0, RIGHT, 0.05, tcp_above=0.0, held=True),
        staged(0.0, RIGHT, LYING, tcp_above=0.0, held=True),
        staged(0.0, RIGHT, LYING, tcp_above=0.02),
        staged(0.0, RIGHT, LYING, tcp_above=0.08),
    ]
    values = [env.compute_normalized_dense_reward(None, None, env.evaluate())[0].item() for env in stages]
    assert all(later > earlier for earlier, later in itertools.pairwise(values)), values
    assert values[-1] == 1.0


def test_every_term_reaches_one_at_success():
    env = staged(0.0, RIGHT, LYING, tcp_above=0.08)
    terms = env.reward_terms(env.evaluate())
    assert {name: round(values[0].item(), 4) for name, values in terms.items()} == dict.fromkeys(terms, 1.0)
