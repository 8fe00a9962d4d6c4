"""Way-points against kinematics worked out by hand, and the independence of rows."""

import pytest
import torch

from manicm_ms.demos.waypoints import Motion, WaypointFollower, Waypoints, stopping_speed, waypoint_table
from manicm_ms.spec import ActionSpec, EnvSpec, ObsSpec

LAYOUT = {"tcp_pose": (0, 7), "tcp_target_pose": (7, 14)}
MOTION = Motion(metres_per_unit=0.02, radians_per_unit=0.08, max_opening=0.09)
DT = 1 / MOTION.control_hz
LAG = 0.4  # share of its distance to the target that the simulated arm makes good in a control step
SPEC = EnvSpec(
    env_id="toy/arm",
    obs=ObsSpec(8, 3, 3, "robot_base"),
    action=ActionSpec(("dx", "dy", "dz", "drx", "dry", "drz", "opening"), "target_delta", MOTION.control_hz),
    max_episode_steps=400,
    agent_pos_names=("x", "y", "z"),
    state_layout=LAYOUT,
)


class LaggingArm:
    """An arm whose target obeys the actions exactly and whose tool follows the target with a first-order lag."""

    def __init__(self, start):
        self.target = start.double().clone()
        self.tcp = self.target.clone()
        self.yaw = torch.zeros(len(start), dtype=torch.float64)

    @property
    def state(self):
        state = torch.zeros(len(self.tcp), 14)
        state[:, 0:3], state[:, 7:10] = self.tcp, self.target
        return state

    def step(self, action):
        self.target = self.target + action[:, :3].double() * MOTION.metres_per_unit
        self.yaw = self.yaw + action[:, 5].double() * MOTION.radians_per_unit
        self.tcp = self.tcp + LAG * (self.target - self.tcp)


def random_plan(n, seed=0):
    rng = torch.Generator().manual_seed(seed)
    start = torch.rand(n, 3, generator=rng) * 0.2
    table = [
        (torch.rand(n, 3, generator=rng) * 0.3, torch.rand(n, generator=rng) - 0.5, 0.02 * k, 0.05 + 0.08 * k, k)
        for k in range(3)
    ]
    return start, waypoint_table(table, start)


def rows_of(plan, rows):
    return Waypoints(plan.position[rows], plan.yaw[rows], plan.opening[rows], plan.speed, plan.dwell)


def play(start, plan, steps=220):
    """Return the arm's targets (T+1, N, 3), tools (T+1, N, 3), actions (T, N, 7) and the arm at the end."""
    arm, follower = LaggingArm(start), WaypointFollower(SPEC, len(start), MOTION)
    follower.reset(plan, torch.ones(len(start), dtype=torch.bool))
    targets, tools, actions = [arm.target], [arm.tcp], []
    for _ in range(steps):
        actions.append(follower.act(arm.state))
        arm.step(actions[-1])
        targets.append(arm.target)
        tools.append(arm.tcp)
    return torch.stack(targets), torch.stack(tools), torch.stack(actions), arm


@pytest.fixture(scope="module")
def episode():
    start, plan = random_plan(16)
    return plan, *play(start, plan)


def test_every_waypoint_is_met_in_order_and_the_last_one_kept(episode):
    plan, _, tools, actions, arm = episode
    gap = (tools[:, :, None] - plan.position[None]).norm(dim=-1)  # (T+1, N, W)
    assert gap.amin(dim=0).max() < MOTION.tcp_tolerance
    first = (gap < MOTION.tcp_tolerance).int().argmax(dim=0)  # (N, W)
    assert (first.diff(dim=1) > 0).all()
    torch.testing.assert_close(arm.tcp, plan.position[:, -1], atol=1e-5, rtol=0)
    torch.testing.assert_close(arm.yaw, plan.yaw[:, -1], atol=1e-5, rtol=0)
    opening = (actions[-1, :, 6].double() + 1) / 2 * MOTION.max_opening
    torch.testing.assert_close(opening, plan.opening[:, -1], atol=1e-5, rtol=0)


def test_speed_and_acceleration_stay_within_their_limits(episode):
    plan, targets, *_ = episode
    velocity = targets.diff(dim=0) / DT
    start = torch.zeros_like(velocity[:1])
    acceleration = torch.cat([start, velocity]).diff(dim=0).norm(dim=-1) / DT
    assert velocity.norm(dim=-1).max() <= plan.speed.max() + 1e-4
    assert acceleration.max() <= MOTION.acceleration * 1.01
    assert acceleration.max() > MOTION.acceleration * 0.9, "the limit is used"


def test_turns_stay_within_their_limit(episode):
    *_, actions, _ = episode
    assert actions[..., 3:5].abs().max() == 0
    assert actions[..., 5].abs().max() * MOTION.radians_per_unit <= MOTION.turn_speed * DT + 1e-6
    assert actions.abs().max() <= 1


def test_a_straight_line_has_no_overshoot_and_takes_the_time_of_its_trapezoid():
    length, speed = 0.30, 0.2
    start = torch.zeros(1, 3)
    plan = waypoint_table([(torch.tensor([[length, 0.0, 0.0]]), 0.0, 0.0, speed, 0)], start)
    targets, *_ = play(start, plan, steps=80)
    along = targets[:, 0, 0]
    assert targets[:, 0, 1:].abs().max() == 0
    assert along.max() <= length + 1e-6
    assert (along.diff() > -1e-6).all()
    steps = int((along > length - 1e-4).int().argmax())
    ideal = (length / speed + speed / MOTION.acceleration) / DT
    assert ideal - 1 <= steps <= ideal + 2


@pytest.mark.parametrize("distance", [1e-4, 1.4e-3, 1.6e-3, 0.01, 0.0333, 0.2])
def test_stopping_speed_just_stops(distance):
    """Braking by a dt a step from the returned speed covers the distance exactly."""
    a = 0.6
    speed = stopping_speed(torch.tensor([distance], dtype=torch.float64), a, DT).item()
    covered, v = 0.0, speed
    while v > 0:
        covered, v = covered + v * DT, v - a * DT
    assert covered == pytest.approx(distance, rel=1e-9)


def test_dwell_waits_that_many_steps():
    start, goal = torch.zeros(1, 3), torch.tensor([[0.05, 0.0, 0.0]])

    def steps_until_it_leaves(dwell):
        plan = waypoint_table([(goal, 0.0, 0.0, 0.2, dwell), (goal * 2, 0.0, 0.0, 0.2, 0)], start)
        targets, *_ = play(start, plan, steps=80)
        return int((targets[:, 0, 0] > 0.052).int().argmax())

    assert steps_until_it_leaves(12) - steps_until_it_leaves(3) == 9  # both leave from rest


def test_rows_do_not_depend_on_their_number_bit_for_bit():
    start, plan = random_plan(64, seed=1)
    _, _, together, _ = play(start, plan)
    for row in range(0, 64, 7):
        pick = slice(row, row + 1)
        _, _, alone, _ = play(start[pick], rows_of(plan, pick))
        assert torch.equal(alone[:, 0], together[:, row])


def test_partial_reset_leaves_the_other_rows_alone():
    start, plan = random_plan(4, seed=2)
    _, new = random_plan(4, seed=3)
    arms = [LaggingArm(start), LaggingArm(start)]
    followers = [WaypointFollower(SPEC, 4, MOTION) for _ in arms]
    for follower in followers:
        follower.reset(plan, torch.ones(4, dtype=torch.bool))
    mask = torch.tensor([False, True, False, True])
    for k in range(40):
        if k == 15:
            followers[1].reset(new, mask)
        actions = [follower.act(arm.state) for follower, arm in zip(followers, arms, strict=True)]
        for arm, action in zip(arms, actions, strict=True):
            arm.step(action)
        same = (actions[0] == actions[1]).all(dim=1)
        assert same[~mask].all()
    assert not same[mask].any()
