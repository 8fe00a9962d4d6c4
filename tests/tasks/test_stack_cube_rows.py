"""Stack Cube on constructed states: each flag means what it says, and the reward grows from stage to stage."""

import itertools
import math

import fake_rows
import pytest
import torch
from fake_rows import fresh, turned
from manicm_ms.tasks.stack_cube import OPENING_MAX, RELEASE_OPENING, StackCubeEnv

CENTRES = 0.045  # m between the centres of stacked cubes
MOTIONS = [("linear_velocity", 0.009, 0.011), ("angular_velocity", 0.4, 0.6)]  # m/s, rad/s
DONE = {"success", "stacked", "still"}


def with_red(offset, height=CENTRES):
    """Return a scene whose first row's red cube stands `offset` (m) off the white one's centre and `height` above."""
    env = fresh(StackCubeEnv, 4)
    env.white.raw[0] = torch.cat([torch.tensor([0.30, 0.02, 0.025]), turned(0.2, 2)])
    env.white_start[0] = env.white.raw[0]
    env.red.raw[0, :3] = env.white.raw[0, :3] + torch.tensor([*offset, height])
    env.red.raw[0, 3:] = turned(0.7, 2)
    return env


def flags(env):
    return fake_rows.flags(env, untouched={"still"})


def test_the_start_is_neither_success_nor_failure():
    assert flags(fresh(StackCubeEnv, 4)) == {"still"}


def test_red_on_white_is_success():
    assert flags(with_red((0.0, 0.0))) == DONE


@pytest.mark.parametrize("angle", [0.0, 0.8, 2.4, 4.0])
@pytest.mark.parametrize(("distance", "counts"), [(0.019, True), (0.021, False)])
def test_how_far_off_the_centre_counts(distance, counts, angle):
    found = flags(with_red((distance * math.cos(angle), distance * math.sin(angle))))
    assert found == (DONE if counts else {"still"})


@pytest.mark.parametrize(("error", "counts"), [(-0.006, False), (-0.004, True), (0.004, True), (0.006, False)])
def test_how_far_off_the_height_counts(error, counts):
    assert flags(with_red((0.0, 0.0), CENTRES + error)) == (DONE if counts else {"still"})


def test_height_follows_the_actual_sizes():
    env = with_red((0.0, 0.0), height=0.055)
    assert flags(env) == {"still"}
    env.half_sizes["red"][0, 2] = 0.030
    assert flags(env) == DONE


def test_stacked_but_grasped_is_not_yet():
    env = with_red((0.0, 0.0))
    env.hold("red", 0.6)
    assert flags(env) == {"stacked", "grasped", "still"}


def test_a_weak_touch_is_no_grasp():
    env = with_red((0.0, 0.0))
    env.hold("red", 0.4)
    assert flags(env) == DONE


def test_one_pad_alone_is_no_grasp():
    env = with_red((0.0, 0.0))
    env.press(env.agent.left_finger, "red", (5.0, 0.0, 0.0))
    assert flags(env) == DONE


def test_force_across_the_closing_direction_is_no_grasp():
    env = with_red((0.0, 0.0))
    for finger in (env.agent.left_finger, env.agent.right_finger):
        env.press(finger, "red", (0.0, 0.0, 5.0))
    assert flags(env) == DONE


def test_holding_the_white_cube_is_no_grasp_of_the_red_one():
    env = with_red((0.0, 0.0))
    env.hold("white", 5.0)
    assert flags(env) == DONE


@pytest.mark.parametrize("cube", ["red", "white"])
@pytest.mark.parametrize(("motion", "slow", "fast"), MOTIONS)
def test_stacked_but_moving_is_not_yet(cube, motion, slow, fast):
    for speed, expected in ((slow, DONE), (fast, {"stacked"})):
        env = with_red((0.0, 0.0))
        getattr(env.objects[cube], motion)[0, 1] = speed
        assert flags(env) == expected


@pytest.mark.parametrize(("shift", "fails"), [(0.019, False), (0.021, True)])
def test_white_moved(shift, fails):
    env = with_red((0.0, 0.0))
    env.white_start[0, 1] -= shift
    assert flags(env) == ({"stacked", "still", "white_moved", "fail"} if fails else DONE)


@pytest.mark.parametrize(("degrees", "fails"), [(9.0, False), (11.0, True)])
@pytest.mark.parametrize("axis", [0, 1])
def test_white_tilted(degrees, fails, axis):
    env = with_red((0.1, 0.0), 0.0)
    env.white.raw[0, 3:] = turned(math.radians(degrees), axis)
    env.white_start[0, 3:] = turned(0.0, 2)
    assert flags(env) == ({"still", "white_moved", "fail"} if fails else {"still"})


def test_white_turned_about_the_vertical_is_not_tilted():
    env = with_red((0.0, 0.0))
    env.white.raw[0, 3:] = turned(math.radians(80.0), 2)
    assert flags(env) == DONE


def test_red_beside_white_is_not_stacked():
    assert flags(with_red((0.05, 0.0), -0.005)) == {"still"}


def test_red_below_the_table_fails():
    assert flags(with_red((0.5, 0.0), -0.3)) == {"still", "fail"}


def test_white_below_the_table_fails():
    env = with_red((0.1, 0.0), 0.0)
    env.white.raw[0, 2] = env.white_start[0, 2] = -0.2
    env.red.raw[0, 2] = 0.02
    assert flags(env) == {"still", "fail"}


def test_cubes_stand_on_the_table_as_high_as_they_are():
    env = fresh(StackCubeEnv, 4)
    env.half_sizes["red"][:, 2] = torch.tensor([0.018, 0.020, 0.021, 0.022])
    env.reset(range(4), range(4))
    torch.testing.assert_close(env.red.raw[:, 2], env.half_sizes["red"][:, 2] + 3e-4)
    torch.testing.assert_close(env.white.raw[:, 2], torch.full((4,), 0.025 + 3e-4))


def test_open_fingers_around_one_cube_miss_the_other():
    """The centres keep 12 cm, whatever the seed; 2000 of them."""
    env = fresh(StackCubeEnv, 2000)
    distance = (env.red.raw - env.white.raw)[:, :2].norm(dim=1)
    assert distance.min() >= 0.12 - 1e-6
    assert distance.min() < 0.122, "no further apart than they must be"


def staged(height, offset=(0.0, 0.0), tcp_above=0.0, opening=0.04, held=False):
    env = with_red(offset, height)
    env.agent.tcp.raw[0, :3] = env.red.raw[0, :3] + torch.tensor([0.0, 0.0, tcp_above])
    env.agent.robot.qpos[0, 6:] = opening / 2
    if held:
        env.hold("red", 10.0)
    return env


def test_reward_grows_from_start_over_grasp_and_carry_to_success():
    stages = [
        staged(-0.005, (0.15, 0.0), tcp_above=0.2, opening=OPENING_MAX),
        staged(-0.005, (0.15, 0.0)),
        staged(-0.005, (0.15, 0.0), held=True),
        staged(0.06, (0.15, 0.0), held=True),
        staged(0.08, held=True),
        staged(CENTRES, held=True),
        staged(CENTRES, opening=RELEASE_OPENING, tcp_above=0.1),
    ]
    values = [env.compute_normalized_dense_reward(None, None, env.evaluate())[0].item() for env in stages]
    assert all(later > earlier for earlier, later in itertools.pairwise(values)), values
    assert values[-1] == 1.0


def test_every_term_reaches_one_at_success():
    """Else the bonus of a success would jump, and a hovering policy could earn more than a finished one."""
    env = staged(CENTRES, opening=RELEASE_OPENING, tcp_above=0.1)
    terms = env.reward_terms(env.evaluate())
    assert {name: round(values[0].item(), 4) for name, values in terms.items()} == dict.fromkeys(terms, 1.0)
