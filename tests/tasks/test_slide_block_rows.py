"""Slide Block on constructed states: each flag means what it says, and the expert's styles choose their sides."""

import math

import fake_rows
import pytest
import torch
from fake_rows import fresh, turned
from manicm_ms.tasks.slide_block import BLOCK_HALF, CUBE_HALF, SPEC, SlideBlockEnv, SlideBlockExpert

# ---- constructed states: four rows, the last three untouched at the start ------------------------------------------


def with_block(offset, height, cube_yaw=0.0):
    """Return a scene whose first row's block stands at `offset` (m, cube frame) from the cube, at `height` (m)."""
    env = fresh(SlideBlockEnv, 4)
    env.cube.raw[0] = torch.cat([torch.tensor([0.3, 0.0, CUBE_HALF]), turned(cube_yaw, 2)])
    env.cube_start[0] = env.cube.raw[0]
    c, s = math.cos(cube_yaw), math.sin(cube_yaw)
    x, y = offset
    env.block.raw[0, :3] = torch.tensor([0.3 + c * x - s * y, s * x + c * y, height])
    env.block.raw[0, 3:] = turned(0.0, 2)
    return env


def flags(env):
    return fake_rows.flags(env, untouched={"still"})


LYING = BLOCK_HALF[0]  # m, height of the centre of a block that lies on its side
BESIDE = (0.0, CUBE_HALF + BLOCK_HALF[2] + 0.001)


def test_block_beside_the_cube_is_success():
    assert flags(with_block(BESIDE, LYING)) == {"success", "block_fallen", "still"}


@pytest.mark.parametrize("side", [(0.0, -0.05), (0.05, 0.0), (-0.05, 0.0), (0.2, 0.1)])
def test_any_side_counts(side):
    assert "success" in flags(with_block(side, LYING))


def test_block_on_top_is_not():
    assert flags(with_block((0.0, 0.0), 2 * CUBE_HALF + BLOCK_HALF[2])) == {"still"}


def test_block_hanging_over_the_edge_is_not():
    assert flags(with_block((0.0, 0.031), 2 * CUBE_HALF + BLOCK_HALF[2])) == {"still"}


def test_falling_block_is_not_yet():
    env = with_block(BESIDE, LYING)
    env.block.linear_velocity[0, 2] = -0.3
    assert flags(env) == {"block_fallen"}


def test_rolling_block_is_not_yet():
    env = with_block(BESIDE, LYING)
    env.block.angular_velocity[0, 0] = 1.0
    assert flags(env) == {"block_fallen"}


def test_cube_frame_decides_what_is_beside():
    """At 45 deg a corner reaches 42 mm out: 38 mm along it lies inside the footprint, 38 mm along a face outside."""
    corner = 0.038 / math.sqrt(2)
    assert flags(with_block((corner, corner), LYING, cube_yaw=math.pi / 4)) == {"still"}
    assert "success" in flags(with_block((0.038, 0.0), LYING, cube_yaw=math.pi / 4))


def test_moved_cube_fails():
    env = with_block(BESIDE, LYING)
    env.cube_start[0, 0] -= 0.021
    assert flags(env) == {"fail", "block_fallen", "block_fell_wrong", "cube_moved", "still"}


def test_cube_moved_less_than_allowed_is_fine():
    env = with_block(BESIDE, LYING)
    env.cube_start[0, 0] -= 0.019
    assert "success" in flags(env)


@pytest.mark.parametrize(("degrees", "fails"), [(9.0, False), (11.0, True)])
@pytest.mark.parametrize("axis", [0, 1])
def test_tilted_cube(degrees, fails, axis):
    env = with_block((0.0, 0.10), LYING)
    env.cube.raw[0, 3:] = turned(math.radians(degrees), axis)
    assert ("fail" in flags(env)) == fails


def test_turned_cube_is_not_tilted():
    env = with_block((0.0, 0.10), LYING)
    env.cube.raw[0, 3:] = turned(math.radians(40.0), 2)
    assert "success" in flags(env)


def test_block_off_the_table_fails():
    assert flags(with_block((0.0, 0.6), -0.3)) == {"fail", "block_fell_wrong", "still"}


def test_reward_grows_from_start_over_push_to_success():
    stages = [
        with_block((0.0, 0.0), 2 * CUBE_HALF + BLOCK_HALF[2]),
        with_block((0.0, 0.02), 2 * CUBE_HALF + BLOCK_HALF[2]),
        with_block(BESIDE, LYING),
    ]
    values = [env.compute_normalized_dense_reward(None, None, env.evaluate())[0].item() for env in stages]
    assert values == sorted(values)
    assert values[-1] == 1.0


# ---- expert ---------------------------------------------------------------------------------------------------------


def side(expert_style, seeds):
    """Return the side (+1, -1) from which the expert comes: first action along y with the tool above the block."""
    expert = SlideBlockExpert(SPEC, len(seeds), "cpu", expert_style)
    state = torch.zeros(len(seeds), SPEC.state_dim)
    state[:, SPEC.state_layout["block_pose"][0]] = 0.3
    expert.reset(state, seeds, torch.ones(len(seeds), dtype=torch.bool))
    return -torch.sign(expert.act(state)[:, 1])


def test_styles_push_to_one_side_or_to_either():
    assert side("one-sided", range(60)).unique().tolist() == [1.0]
    assert side("other-sided", range(60)).unique().tolist() == [-1.0]
    two = side("two-sided", range(60))
    assert set(two.unique().tolist()) == {-1.0, 1.0}
    assert abs(two.mean()) < 0.4  # fair: beyond 3 sigma of 60 coins
    assert torch.equal(two, side("two-sided", range(60)))
