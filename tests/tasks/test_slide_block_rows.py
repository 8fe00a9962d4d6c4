"""Slide Block's batched code on 4 and 64 rows: rows do not know of each other, and each flag means what it says."""

import math

import pytest
import torch
from fake_rows import FakeSlideBlock
from manicm_ms.tasks import slide_block
from manicm_ms.tasks.slide_block import BLOCK_HALF, CUBE_HALF, ENV_ID, SPEC, SlideBlockExpert

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.errors import UnknownNameError

SIZES = (4, 64)


def fresh(n, first_seed=0):
    env = FakeSlideBlock(n)
    env.reset(range(n), range(first_seed, first_seed + n))
    return env


def scramble(env, seed):
    """Move everything to random places, some of them solved, some failed, some in motion."""
    rng = torch.Generator().manual_seed(seed)
    n = env.num_envs

    def noise(width, scale):
        return (torch.rand(n, width, generator=rng) * 2 - 1) * scale

    env.cube.raw[:, :3] += noise(3, 0.02)
    turned = env.cube.raw[:, 3:] + noise(4, 0.1)
    env.cube.raw[:, 3:] = turned / turned.norm(dim=1, keepdim=True)
    env.block.raw[:, :2] += noise(2, 0.06)
    env.block.raw[:, 2] = torch.rand(n, generator=rng) * 0.1 - 0.01
    env.block.linear_velocity = noise(3, 0.01)
    env.agent.tcp[:, :3] = torch.rand(n, 3, generator=rng) * 0.4
    return env


def single(env, row):
    """Return a one-row copy of a row."""
    one = FakeSlideBlock(1)
    pick = slice(row, row + 1)
    one.cube.raw, one.block.raw, one.cube_start = env.cube.raw[pick], env.block.raw[pick], env.cube_start[pick]
    one.block.linear_velocity = env.block.linear_velocity[pick]
    one.agent.tcp = env.agent.tcp[pick]
    return one


@pytest.mark.parametrize("n", SIZES)
def test_partial_reset_changes_its_rows_and_no_other_bit(n):
    env = fresh(n)
    before = [t.clone() for t in env.tensors()]
    rows = torch.arange(1, n, 3)
    env.reset(rows, range(1000, 1000 + len(rows)))
    others = torch.ones(n, dtype=torch.bool)
    others[rows] = False
    for old, new in zip(before, env.tensors(), strict=True):
        assert torch.equal(old[others], new[others])
        assert (old[rows] != new[rows]).any(dim=1).all()


@pytest.mark.parametrize("n", SIZES)
def test_an_episode_depends_on_its_seed_alone(n):
    env = fresh(n, first_seed=7)
    backwards = FakeSlideBlock(n)
    order = list(range(n))[::-1]
    for row in order:  # one at a time, in another order, mapped to another row
        backwards.reset([n - 1 - row], [7 + row])
    for together, alone in zip(env.tensors(), backwards.tensors(), strict=True):
        assert torch.equal(together, alone.flip(0))


def test_randomisation_covers_its_ranges_and_stays_in_them():
    env = fresh(400)
    cube, block, arm = env.cube.raw, env.block.raw, env.agent.robot.qpos[:, :6]
    yaw = 2 * torch.atan2(cube[:, 6], cube[:, 3])
    relative = 2 * torch.atan2(block[:, 6], block[:, 3]) - yaw
    off = block[:, :2] - cube[:, :2]
    start = torch.tensor(env.start_qpos)
    ranges = [
        (cube[:, 0], 0.25, 0.35),
        (cube[:, 1], -0.08, 0.08),
        (yaw, -math.pi / 12, math.pi / 12),
        (relative, -math.pi / 12, math.pi / 12),
        *((column, -0.005, 0.005) for column in off.unbind(dim=1)),
        *((column, -0.02, 0.02) for column in (arm - start).unbind(dim=1)),
    ]
    for values, low, high in ranges:
        assert values.min() >= low - 1e-6
        assert values.max() <= high + 1e-6
        assert values.max() - values.min() > 0.95 * (high - low)


@pytest.mark.parametrize("n", SIZES)
def test_evaluate_and_reward_equal_those_of_single_rows(n):
    env = scramble(fresh(n), seed=n)
    facts = env.evaluate()
    terms = env.reward_terms(facts)
    dense = env.compute_normalized_dense_reward(None, None, facts)
    assert dense.shape == (n,)
    for row in range(n):
        one = single(env, row)
        alone = one.evaluate()
        assert {name: v.item() for name, v in alone.items()} == {name: v[row].item() for name, v in facts.items()}
        for name, value in one.reward_terms(alone).items():
            torch.testing.assert_close(value[0], terms[name][row])
        torch.testing.assert_close(one.compute_normalized_dense_reward(None, None, alone)[0], dense[row])


def test_scrambled_rows_show_every_flag_both_ways():
    """The comparison above would mean little if all rows said the same."""
    facts = scramble(fresh(64), seed=64).evaluate()
    for name, values in facts.items():
        assert 0 < values.sum() < len(values), name


def test_reward_terms_and_weights_share_their_names_and_lie_in_the_unit_interval():
    env = scramble(fresh(64), seed=1)
    facts = env.evaluate()
    terms = env.reward_terms(facts)
    assert list(terms) == list(env.reward_weights)
    for values in terms.values():
        assert values.min() >= 0
        assert values.max() <= 1
    dense = env.compute_normalized_dense_reward(None, None, facts)
    assert dense.min() >= 0
    assert dense.max() <= 1
    assert (dense[facts["success"]] == 1).all()
    assert (dense[~facts["success"]] < 1).all()


# ---- constructed states: four rows, the last three untouched at the start ------------------------------------------


def turned(angle, axis):
    """Return the quaternion wxyz of a rotation about a coordinate axis (0, 1, 2)."""
    q = torch.zeros(4)
    q[0], q[1 + axis] = math.cos(angle / 2), math.sin(angle / 2)
    return q


def with_block(offset, height, cube_yaw=0.0):
    """Return a scene whose first row's block stands at `offset` (m, cube frame) from the cube, at `height` (m)."""
    env = fresh(4)
    env.cube.raw[0] = torch.cat([torch.tensor([0.3, 0.0, CUBE_HALF]), turned(cube_yaw, 2)])
    env.cube_start[0] = env.cube.raw[0]
    c, s = math.cos(cube_yaw), math.sin(cube_yaw)
    x, y = offset
    env.block.raw[0, :3] = torch.tensor([0.3 + c * x - s * y, s * x + c * y, height])
    env.block.raw[0, 3:] = turned(0.0, 2)
    return env


def flags(env):
    facts = {name: values.tolist() for name, values in env.evaluate().items()}
    for name, values in facts.items():
        assert values[1:] == [name == "still"] * 3, "the untouched rows: block on top, everything still"
    return {name for name, values in facts.items() if values[0]}


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


def random_states(n, steps, seed=0):
    """Return privileged states (steps, n, S) of scenes at random, with a tool somewhere above the table."""
    rng = torch.Generator().manual_seed(seed)
    states = torch.rand(steps, n, SPEC.state_dim, generator=rng) * 0.1
    for name in ("tcp_pose", "tcp_target_pose", "cube_pose", "block_pose"):
        start, _ = SPEC.state_layout[name]
        states[..., start] += 0.25
        states[..., start + 3 : start + 7] = turned(0.0, 2)
    return states


def play(expert, states, seeds):
    n = states.shape[1]
    expert.reset(states[0], seeds, torch.ones(n, dtype=torch.bool))
    return torch.stack([expert.act(state) for state in states])


@pytest.mark.parametrize("style", SlideBlockExpert.styles)
@pytest.mark.parametrize("n", SIZES)
def test_expert_of_n_rows_equals_n_experts_bit_for_bit(n, style):
    factory = EXPERTS.get(ENV_ID)
    states, seeds = random_states(n, steps=30), list(range(50, 50 + n))
    together = play(factory(SPEC, n, torch.device("cpu"), style), states, seeds)
    assert together.dtype == torch.float32
    assert together.abs().max() <= 1
    for row in range(n):
        alone = play(factory(SPEC, 1, torch.device("cpu"), style), states[:, row : row + 1], seeds[row : row + 1])
        assert torch.equal(alone[:, 0], together[:, row])


def side(expert_style, seeds):
    """Return the side (+1, -1) from which the expert comes: first action along y with the tool above the block."""
    expert = SlideBlockExpert(SPEC, len(seeds), "cpu", expert_style)
    states = random_states(1, steps=1).expand(-1, len(seeds), -1)
    return -torch.sign(play(expert, states, seeds)[0, :, 1])


def test_styles_push_to_one_side_or_to_either():
    assert side("one-sided", range(60)).unique().tolist() == [1.0]
    two = side("two-sided", range(60))
    assert set(two.unique().tolist()) == {-1.0, 1.0}
    assert abs(two.mean()) < 0.4  # fair: beyond 3 sigma of 60 coins
    assert torch.equal(two, side("two-sided", range(60)))


def test_unknown_style_names_those_that_exist():
    with pytest.raises(UnknownNameError, match="one-sided, two-sided"):
        SlideBlockExpert(SPEC, 1, "cpu", "left-handed")


def test_expert_is_registered_for_the_task():
    assert EXPERTS.get(slide_block.ENV_ID) is SlideBlockExpert
