"""All tasks' batched code on 4 and 256 rows: rows do not know of each other, whatever a task computes."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from fake_rows import FakeTask, fresh, turned
from manicm_ms.tasks import slide_block, stack_cube, transfer_piece

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.errors import UnknownNameError
from manicm_ms.robots.limits import pose_in_frame, yaw_of_quat

SIZES = (4, 256)


@dataclass(frozen=True)
class Case:
    """A task under test.

    Attributes:
        module: the task's module.
        env_class: its environment class.
        scramble: moves objects of an env to random places, by a function that draws noise (width, scale).
        ranges: what the start of an episode draws: (values, least, greatest) each.
        placed: names of the tensors that every reset writes anew.
    """

    module: object
    env_class: type
    scramble: Callable
    ranges: Callable
    placed: tuple[str, ...]


def scramble_slide(env, noise):
    env.cube.raw[:, :3] += noise(3, 0.02)
    tilted = env.cube.raw[:, 3:] + noise(4, 0.1)
    env.cube.raw[:, 3:] = tilted / tilted.norm(dim=1, keepdim=True)
    env.block.raw[:, :2] += noise(2, 0.06)
    env.block.raw[:, 2] = 0.04 + noise(1, 0.05)[:, 0]
    env.block.linear_velocity[:] = noise(3, 0.01)


def scramble_stack(env, noise):
    env.white.raw[:, :3] += noise(3, 0.012)
    on_top = noise(1, 1.0) > -0.5
    above = env.white.raw[:, :3] + torch.tensor([0.0, 0.0, 0.045]) + torch.cat([noise(2, 0.016), noise(1, 0.006)], 1)
    env.red.raw[:, :3] = torch.where(on_top, above, env.red.raw[:, :3] + noise(3, 0.06))
    env.red.linear_velocity[:] = noise(3, 0.008)


def scramble_transfer(env, noise):
    near = torch.tensor([0.0, -transfer_piece.COMPARTMENT_Y, 0.0]) + env.box.raw[:, :3]
    inside = noise(1, 1.0) > -0.4
    env.piece.raw[:, :2] = torch.where(inside, near[:, :2] + noise(2, 0.045), env.piece.raw[:, :2] + noise(2, 0.3))
    env.piece.raw[:, 2] = 0.026 + noise(1, 0.012)[:, 0]
    env.piece.linear_velocity[:] = noise(3, 0.008)


def slide_ranges(env):
    cube, block = env.cube.raw, env.block.raw
    yaw = yaw_of_quat(cube[:, 3:])
    off = block[:, :2] - cube[:, :2]
    most = math.pi / 12
    return [
        (cube[:, 0], 0.25, 0.35),
        (cube[:, 1], -0.08, 0.08),
        (yaw, -most, most),
        (yaw_of_quat(block[:, 3:]) - yaw, -most, most),
        *((column, -0.005, 0.005) for column in off.T),
    ]


def stack_ranges(env):
    bodies = (env.red.raw, env.white.raw)
    most = math.pi / 6
    distance = (bodies[0] - bodies[1])[:, :2].norm(dim=1)
    return [
        *((body[:, 0], 0.24, 0.38) for body in bodies),
        *((body[:, 1], -0.14, 0.14) for body in bodies),
        *((yaw_of_quat(body[:, 3:]), -most, most) for body in bodies),
        (distance, 0.12, math.hypot(0.14, 0.28)),
    ]


def transfer_ranges(env):
    box, piece = env.box.raw, pose_in_frame(env.piece.raw, env.box.raw)
    return [
        (box[:, 0], 0.30, 0.34),
        (box[:, 1], -0.02, 0.02),
        (yaw_of_quat(box[:, 3:]), -math.radians(5), math.radians(5)),
        (piece[:, 0], -0.008, 0.008),
        (piece[:, 1], 0.0425 - 0.015, 0.0425 + 0.015),
        (yaw_of_quat(piece[:, 3:]), -math.radians(10), math.radians(10)),
    ]


CASES = {
    case.module.ENV_ID: case
    for case in (
        Case(
            slide_block,
            slide_block.SlideBlockEnv,
            scramble_slide,
            slide_ranges,
            ("cube pose", "block pose", "cube_start", "qpos"),
        ),
        Case(
            stack_cube,
            stack_cube.StackCubeEnv,
            scramble_stack,
            stack_ranges,
            ("red pose", "white pose", "white_start", "qpos"),
        ),
        Case(
            transfer_piece,
            transfer_piece.TransferPieceEnv,
            scramble_transfer,
            transfer_ranges,
            ("box pose", "piece pose", "qpos"),
        ),
    )
}


@pytest.fixture(params=CASES, scope="module")
def case(request):
    return CASES[request.param]


def scrambled(case, n, seed=0):
    """Return N rows with everything at random places: some solved, some failed, some in motion, some held."""
    env = fresh(case.env_class, n)
    generator = torch.Generator().manual_seed(seed)

    def noise(width, scale):
        return (torch.rand(n, width, generator=generator) * 2 - 1) * scale

    case.scramble(env, noise)
    kept = env.tensors()
    kept["tcp pose"][:, :3] = env.objects[list(env.objects)[-1]].raw[:, :3] + noise(3, 0.08)
    kept["qpos"][:, 6:] = noise(2, 0.02) + 0.02
    for name in kept:
        if " on " in name:
            kept[name][:] = torch.cat([noise(1, 1.5) + 1.0, noise(2, 0.2)], dim=1)
    return env


@pytest.mark.parametrize("n", SIZES)
def test_partial_reset_changes_its_rows_and_no_other_bit(case, n):
    env = fresh(case.env_class, n)
    before = {name: values.clone() for name, values in env.tensors().items()}
    rows = torch.arange(1, n, 3)
    env.reset(rows, range(1000, 1000 + len(rows)))
    others = torch.ones(n, dtype=torch.bool)
    others[rows] = False
    after = env.tensors()
    for name, old in before.items():
        assert torch.equal(old[others], after[name][others]), name
    for name in case.placed:
        assert (before[name][rows] != after[name][rows]).any(dim=1).all(), name


def test_a_setter_that_gets_a_value_for_every_row_is_refused_by_the_fake(case):
    """The fake's own check: a task that sets N poses while two rows are being reset would be caught."""
    env = FakeTask(case.env_class, 4)
    env.scene._reset_mask = torch.tensor([True, True, False, False])
    with pytest.raises(AssertionError, match="4 values for 2 rows"):
        next(iter(env.objects.values())).set_pose(next(iter(env.objects.values())).pose)


@pytest.mark.parametrize("n", SIZES)
def test_an_episode_depends_on_its_seed_alone(case, n):
    together = fresh(case.env_class, n, first_seed=7).tensors()
    backwards = FakeTask(case.env_class, n)
    for row in reversed(range(n)):  # one at a time, in another order, mapped to another row
        backwards.reset([n - 1 - row], [7 + row])
    alone = backwards.tensors()
    for name, values in together.items():
        assert torch.equal(values, alone[name].flip(0)), name


def test_randomisation_covers_its_ranges_and_stays_in_them(case):
    env = fresh(case.env_class, 600)
    arm = env.agent.robot.qpos[:, :6] - torch.tensor(env.start_qpos)
    for values, low, high in [*case.ranges(env), *((column, -0.02, 0.02) for column in arm.T)]:
        assert values.min() >= low - 1e-6
        assert values.max() <= high + 1e-6
        assert values.max() - values.min() > 0.85 * (high - low)


def test_episodes_start_upright_still_and_undecided(case):
    env = fresh(case.env_class, 64)
    for actor in env.objects.values():
        torch.testing.assert_close(actor.raw[:, 4:6], torch.zeros(64, 2))  # turned about z alone
    facts = env.evaluate()
    assert facts["still"].all()
    assert not (facts["success"] | facts["fail"]).any()


@pytest.mark.parametrize("n", SIZES)
def test_evaluate_and_reward_equal_those_of_single_rows(case, n):
    env = scrambled(case, n)
    facts = env.evaluate()
    terms = env.reward_terms(facts)
    dense = env.compute_normalized_dense_reward(None, None, facts)
    assert dense.shape == (n,)
    for row in range(n):
        one = env.single(row)
        alone = one.evaluate()
        assert {name: v.item() for name, v in alone.items()} == {name: v[row].item() for name, v in facts.items()}
        for name, value in one.reward_terms(alone).items():
            torch.testing.assert_close(value[0], terms[name][row])
        torch.testing.assert_close(one.compute_normalized_dense_reward(None, None, alone)[0], dense[row])


def test_scrambled_rows_show_every_flag_both_ways(case):
    """The comparison above would mean little if all rows said the same."""
    for name, values in scrambled(case, 256).evaluate().items():
        assert 0 < values.sum() < len(values), name


def test_reward_terms_and_weights_share_their_names_and_lie_in_the_unit_interval(case):
    env = scrambled(case, 256)
    facts = env.evaluate()
    terms = env.reward_terms(facts)
    assert list(terms) == list(env.reward_weights)
    for name, values in terms.items():
        assert values.shape == (256,), name
        assert values.min() >= 0, name
        assert values.max() <= 1, name
    dense = env.compute_normalized_dense_reward(None, None, facts)
    assert dense.min() >= 0
    assert (dense[facts["success"]] == 1).all()
    assert (dense[~facts["success"]] <= 1).all()
    torch.testing.assert_close(env.compute_dense_reward(None, None, facts), dense * sum(env.reward_weights.values()))


# ---- experts --------------------------------------------------------------------------------------------------------


def random_states(spec, n, steps, seed=0):
    """Return privileged states (steps, n, S) of scenes at random, with a tool somewhere above the table."""
    generator = torch.Generator().manual_seed(seed)
    states = torch.rand(steps, n, spec.state_dim, generator=generator) * 0.1
    for name, (start, _) in spec.state_layout.items():
        if name.endswith("_pose"):
            states[..., start] += 0.25
            states[..., start + 3 : start + 7] = turned(0.3, 2)
    return states


def play(expert, states, seeds):
    expert.reset(states[0], seeds, torch.ones(states.shape[1], dtype=torch.bool))
    return torch.stack([expert.act(state) for state in states])


STYLES = [(case.module.ENV_ID, style) for case in CASES.values() for style in EXPERTS.get(case.module.ENV_ID).styles]


@pytest.mark.parametrize(("env_id", "style"), STYLES)
@pytest.mark.parametrize("n", SIZES)
def test_expert_of_n_rows_equals_n_experts_bit_for_bit(env_id, style, n):
    spec, factory = CASES[env_id].module.SPEC, EXPERTS.get(env_id)
    states, seeds = random_states(spec, n, steps=8), list(range(50, 50 + n))
    together = play(factory(spec, n, torch.device("cpu"), style), states, seeds)
    assert together.dtype == torch.float32
    assert together.abs().max() <= 1
    assert not torch.equal(together[:, 0], together[:, 1])
    for row in range(n):
        alone = play(factory(spec, 1, torch.device("cpu"), style), states[:, row : row + 1], seeds[row : row + 1])
        assert torch.equal(alone[:, 0], together[:, row])


@pytest.mark.parametrize(("env_id", "style"), STYLES)
def test_an_expert_that_begins_anew_in_some_rows_goes_on_in_the_others(env_id, style):
    spec, factory, n = CASES[env_id].module.SPEC, EXPERTS.get(env_id), 4
    states, seeds = random_states(spec, n, steps=6), list(range(n))
    undisturbed, disturbed = (factory(spec, n, torch.device("cpu"), style) for _ in range(2))
    play(undisturbed, states[:3], seeds)
    play(disturbed, states[:3], seeds)
    mask = torch.tensor([False, True, False, True])
    disturbed.reset(states[3], [9, 10, 11, 12], mask)
    for state in states[3:]:
        expected, actual = undisturbed.act(state), disturbed.act(state)
        assert torch.equal(expected[~mask], actual[~mask])
        assert not torch.equal(expected[mask], actual[mask])


def test_unknown_style_names_those_that_exist(case):
    factory = EXPERTS.get(case.module.ENV_ID)
    with pytest.raises(UnknownNameError, match=", ".join(sorted(factory.styles))):
        factory(case.module.SPEC, 1, torch.device("cpu"), "left-handed")
