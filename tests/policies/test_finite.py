"""NaN and infinity: bad points are left out, a bad state and a bad action are refused, and no action is ever one."""

import time
import warnings

import pytest
import torch
from policy_specs import CHUNK, TINY, make_obs, make_spec, wobble

from manicm_ms.errors import NotFiniteError
from manicm_ms.policies.finite import finite_obs, require_finite_actions
from manicm_ms.policies.methods import make_policy, student_of

SPEC = make_spec(points=32)
NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module", params=["teacher", "control", "student"])
def policy(request):
    teacher = make_policy("simple_dp3", SPEC, CHUNK, TINY | {"inputs": {"points": {"max_points": 8}}}, seed=0)
    wobble(teacher)
    return {"teacher": teacher, "control": teacher.one_step(), "student": student_of(teacher)}[request.param]


def act(policy, obs):
    return policy.act(obs, noise=torch.randn(len(obs["agent_pos"]), 4, 3, generator=torch.Generator().manual_seed(0)))


def changed(obs, key, where, value):
    values = obs[key].clone()
    values[where] = value
    return {**obs, key: values}


@pytest.mark.parametrize("value", [NAN, INF, -INF])
@pytest.mark.filterwarnings("ignore:points of NaN")
def test_a_point_that_is_not_finite_is_as_if_it_were_not_there(policy, value):
    obs = make_obs(SPEC, 3)
    cloud = obs["point_cloud"]
    others = [i for i in range(32) if i != 5]
    without = changed(obs, "point_cloud", (1, 1), cloud[1, 1, [*others, 0]])  # 31 points, and the first one again
    spoiled = changed(obs, "point_cloud", (1, 1, 5, 2), value)
    assert torch.equal(act(policy, spoiled), act(policy, without))
    assert not torch.equal(act(policy, without)[1], act(policy, obs)[1])


def test_leaving_points_out_is_said_once(policy):
    obs = changed(make_obs(SPEC, 2), "point_cloud", (0, 0, 3, 0), NAN)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("default")
        for row in range(4):
            act(policy, changed(obs, "point_cloud", (1, 0, row), INF))
    assert [str(w.message) for w in said] == [
        "points of NaN or infinity are left out of point_cloud: depth without a value?"
    ]


def test_points_that_are_left_out_keep_the_order_of_the_others_and_are_replaced_in_turn():
    cloud = torch.arange(6.0)[None, None, :, None].repeat(2, 2, 1, 3)
    cloud[1, 0, [0, 3], 1] = NAN
    cloud[1, 1, 1:, 0] = INF
    with pytest.warns(RuntimeWarning, match="left out"):
        mended = finite_obs({"point_cloud": cloud, "agent_pos": torch.zeros(2, 2, 5)}, SPEC)["point_cloud"]
    assert torch.equal(mended[0], cloud[0])
    assert mended[1, 0, :, 0].tolist() == [1, 2, 4, 5, 1, 2]
    assert mended[1, 1, :, 2].tolist() == [0] * 6


def test_a_frame_without_a_finite_point_is_refused_with_its_row(policy):
    obs = changed(make_obs(SPEC, 3), "point_cloud", (2, 0), NAN)
    with pytest.raises(NotFiniteError, match="no finite point in a frame of row 2: ") as refused:
        act(policy, obs)
    assert refused.value.rows == (2,)


@pytest.mark.parametrize("value", [NAN, INF])
def test_a_state_that_is_not_finite_is_refused_with_its_entries_and_rows(policy, value):
    obs = changed(changed(make_obs(SPEC, 3), "agent_pos", (0, 1, 3), value), "agent_pos", (2, 0, 3), value)
    with pytest.raises(
        NotFiniteError, match=r"agent_pos holds 2 values of NaN or infinity in rows 0, 2 \(q3 \(m\)\)"
    ) as refused:
        act(policy, obs)
    assert refused.value.rows == (0, 2)


@pytest.mark.parametrize("where", ["state", "noise", "weights"])
def test_an_action_that_is_not_finite_is_refused(policy, where):
    obs, noise = make_obs(SPEC, 2), torch.randn(2, 4, 3)
    bias = policy.head.backbone.head[-1].bias
    kept = bias.detach().clone()
    if where == "state":
        obs = changed(obs, "agent_pos", (1, 0), 3e38)  # finite, and beyond what a matrix product holds
    elif where == "noise":
        noise[1, 0, 0] = NAN
    else:
        bias.data.fill_(NAN)
    try:
        with pytest.raises(NotFiniteError, match="came to an action of NaN or infinity in row") as refused:
            policy.act(obs, noise=noise)
    finally:
        bias.data.copy_(kept)
    assert refused.value.rows == ((0, 1) if where == "weights" else (1,))


def test_large_finite_numbers_whose_sum_overflows_are_no_fault():
    actions = torch.full((4, 3), 3e38)
    require_finite_actions(actions, "x")
    obs = {"point_cloud": torch.full((1, 2, 32, 3), 3e38), "agent_pos": torch.full((1, 2, 5), 3e38)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.equal(finite_obs(obs, SPEC)["point_cloud"], obs["point_cloud"])


def test_looking_costs_little_of_a_decision(policy):
    """Measured 8 us beside 4 ms on a network of the quick preset, on a busy core; here the network is far smaller."""
    obs, actions = make_obs(SPEC, 1), torch.zeros(1, 3, 3)

    def least(work):
        times = []
        for _ in range(30):
            begin = time.perf_counter()
            work()
            times.append(time.perf_counter() - begin)
        return min(times)

    looking = least(lambda: (finite_obs(obs, SPEC), require_finite_actions(actions, "x")))
    assert looking < 0.1 * least(lambda: act(policy, obs))
