"""Which points are read when acting and in training: a function of the decision's noise, and what checkpoints say."""

import json

import pytest
import torch
from policy_specs import CHUNK, TINY, make_obs, make_spec, wobble

from manicm_ms.errors import UnknownNameError
from manicm_ms.policies.checkpoint import load_checkpoint, save_checkpoint
from manicm_ms.policies.encoders.points import POINT_CHOICES
from manicm_ms.policies.methods import make_policy, student_of

SPEC = make_spec(points=32)


def teacher(**points):
    policy = make_policy("simple_dp3", SPEC, CHUNK, TINY | {"inputs": {"points": {"max_points": 8} | points}}, seed=0)
    wobble(policy)
    return policy


def noise(rows, seed=0):
    return torch.randn(rows, CHUNK.horizon, SPEC.action.dim, generator=torch.Generator().manual_seed(seed))


def numbered(rows, points):
    """Return clouds (rows, 2, points, 3) whose points hold their own number."""
    return torch.arange(points).float()[None, None, :, None].expand(rows, 2, points, 3)


def chosen(rows, points, count, seed=0):
    """Return the numbers (rows, count) of the points that a random choice reads."""
    read = POINT_CHOICES.get("random").acting(numbered(rows, points), count, noise(rows, seed))
    assert torch.equal(read, read[:, :1, :, :1].expand_as(read)), "the frames of a row read different points"
    return read[:, 0, :, 0].long()


def test_random_points_are_distinct_and_every_point_is_equally_likely():
    """8 of 32 points in 4000 rows: each is read 1000 times, give or take 27.4 (hypergeometric); 5 sigma."""
    read = chosen(4000, 32, 8)
    assert all(len(set(row)) == 8 for row in read.tolist())
    counts = torch.bincount(read.flatten(), minlength=32)
    assert (counts - 1000).abs().max() < 5 * 27.4
    first = torch.bincount(read[:, 0], minlength=32)  # and none comes first more often: 125 +- 11
    assert (first - 125).abs().max() < 5 * 11
    together = (read == 3).any(1) & (read == 4).any(1)  # neighbours: 4000 * 8 * 7 / (32 * 31) = 226 +- 15
    assert abs(int(together.sum()) - 226) < 5 * 15


def test_a_row_s_points_depend_on_its_own_noise_alone():
    together = chosen(6, 512, 128)
    alone = POINT_CHOICES.get("random").acting(numbered(1, 512), 128, noise(6)[3:4])[:, 0, :, 0].long()
    assert torch.equal(together[3:4], alone)
    assert len({tuple(row) for row in together.tolist()}) == 6
    assert not torch.equal(together, chosen(6, 512, 128, seed=1))


def players(points):
    policy = teacher(acting=points)
    student = student_of(policy, nfe=2)
    return {"teacher": policy, "control": policy.one_step(), "student": student}


@pytest.mark.parametrize("who", ["teacher", "control", "student"])
def test_same_seed_same_action_and_the_choice_takes_nothing_from_the_generator(who):
    obs, policy = make_obs(SPEC, 3), players("random")[who]
    first, again = (policy.act(obs, generator=torch.Generator().manual_seed(4)) for _ in range(2))
    assert torch.equal(first, again)
    left = []
    for points in ("random", "prefix"):
        generator = torch.Generator().manual_seed(4)
        players(points)[who].act(obs, generator=generator)
        left.append(generator.get_state())
    assert torch.equal(*left)


@pytest.mark.parametrize("who", ["teacher", "control", "student"])
def test_random_points_are_the_ones_that_the_noise_says(who):
    """Spoiling the points that were not chosen changes nothing; spoiling a chosen one changes the action."""
    obs, policy, start = make_obs(SPEC, 2), players("random")[who], noise(2)
    reads = chosen(2, 32, 8)
    base = policy.act(obs, noise=start, **({"generator": torch.Generator().manual_seed(0)} if who == "student" else {}))
    for inside in (False, True):
        cloud = obs["point_cloud"].clone()
        for row in range(2):
            there = torch.zeros(32, dtype=torch.bool).index_fill(0, reads[row], True)
            cloud[row, :, there if inside else ~there] += 5.0
        other = policy.act(
            obs | {"point_cloud": cloud},
            noise=start,
            **({"generator": torch.Generator().manual_seed(0)} if who == "student" else {}),
        )
        assert torch.equal(base, other) is not inside


def test_all_points_are_read_where_there_are_no_more():
    few = {k: v[:, :, :8] if k == "point_cloud" else v for k, v in make_obs(SPEC, 2).items()}
    actions = [teacher(acting=points).act(few, noise=noise(2)) for points in ("prefix", "random")]
    assert torch.equal(*actions)


def test_checkpoint_keeps_the_choice_and_an_older_one_acts_on_the_prefix(tmp_path):
    policy = teacher()
    policy.transforms["points"].act_on("random")
    save_checkpoint(policy, tmp_path / "random", {})
    assert load_checkpoint(tmp_path / "random").transforms["points"].config.acting == "random"
    described = json.loads((tmp_path / "random" / "config.json").read_text())["config"]
    for name in ("acting", "training"):
        described["inputs"]["points"].pop(name)
    older = make_policy("simple_dp3", SPEC, CHUNK, described).transforms["points"].config
    assert (older.acting, older.training) == ("prefix", "random")


def test_unknown_choice_is_refused_with_the_known_ones():
    with pytest.raises(UnknownNameError, match="prefix"):
        teacher(acting="prefx")
    with pytest.raises(UnknownNameError):
        teacher().transforms["points"].act_on("all")
