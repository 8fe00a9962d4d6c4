"""ActionChunk over a point mass whose motion is known in closed form."""

import point_mass_env
import pytest
import torch
from point_mass_env import CRASH_X, DIVERGE_Y, GOAL_X, MAX_STEPS, RAISE_Y

from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, ChunkSpec


def make(num_rows, n_obs_steps=2, n_action_steps=3):
    rows = ActionChunk(point_mass_env.build(num_rows), n_obs_steps, n_action_steps)
    history, info = rows.reset(torch.arange(num_rows), range(num_rows))
    return rows, history, info


def actions(rows, *xy):
    """Return a chunk (n, Ta, 2) that plays the displacements `xy` (one (x, y) an action) in every row."""
    chunk = torch.tensor(xy, dtype=torch.float32)
    return chunk.expand(rows.simulator.num_rows, -1, -1).clone()


def put(rows, row, x=0.0, y=0.0):
    rows.simulator.position[row] = torch.tensor([x, y])


def test_reset_repeats_the_first_frame():
    rows, history, info = make(2, n_obs_steps=3)
    assert history[AGENT_POS].shape == (2, 3, 2)
    assert history[POINT_CLOUD].shape == (2, 3, 16, 3)
    for k in range(3):
        assert torch.equal(history[AGENT_POS][:, k], rows.simulator.position)
    assert {name: values.tolist() for name, values in info.items()} == {
        "success": [False, False],
        "success_once": [False, False],
        "elapsed_steps": [0, 0],
        "clipped": [0, 0],
    }


def test_history_holds_the_last_frames_and_the_reward_is_summed():
    rows, history, _ = make(1)
    start = history[AGENT_POS][0, 0]
    moves = torch.tensor([[0.1, 0.0], [0.0, 0.2], [-0.05, 0.0]])
    history, reward, info = rows.step(moves[None])
    path = start + moves.cumsum(dim=0)
    torch.testing.assert_close(history[AGENT_POS][0], path[1:])
    torch.testing.assert_close(reward, path[:, 0].sum()[None])
    assert info["elapsed_steps"].tolist() == [3]


@pytest.mark.parametrize(
    ("n_obs_steps", "n_action_steps", "frames"), [(1, 1, 1), (1, 3, 1), (2, 3, 2), (2, 1, 1), (3, 2, 2)]
)
def test_only_frames_that_are_read_are_observed(n_obs_steps, n_action_steps, frames):
    rows, *_ = make(2, n_obs_steps, n_action_steps)
    before = rows.simulator.observed
    rows.step(torch.zeros(2, n_action_steps, 2))
    assert rows.simulator.observed - before == frames


def test_history_reaches_back_over_a_chunk_shorter_than_itself():
    rows, history, _ = make(1, n_obs_steps=3, n_action_steps=1)
    seen = [history[AGENT_POS][0, -1]]
    for k in range(4):
        history, *_ = rows.step(actions(rows, (0.01 * (k + 1), 0.0)))
        seen.append(history[AGENT_POS][0, -1])
    assert torch.equal(history[AGENT_POS][0], torch.stack(seen[-3:]))
    assert len({tuple(frame.tolist()) for frame in seen}) == 5


def test_success_in_mid_chunk_ends_the_row_there_while_others_go_on():
    rows, *_ = make(2)
    put(rows, 0, x=GOAL_X - 0.05)
    put(rows, 1, x=0.0)
    history, reward, info = rows.step(actions(rows, (0.1, 0), (0.1, 0), (0.1, 0)))
    assert rows.terminated.tolist() == [True, False]
    assert rows.truncated.tolist() == [False, False]
    assert info["success"].tolist() == info["success_once"].tolist() == [True, False]
    assert info["elapsed_steps"].tolist() == [1, 3]
    torch.testing.assert_close(history[AGENT_POS][:, -1, 0], torch.tensor([GOAL_X + 0.05, 0.3]))
    torch.testing.assert_close(reward, torch.tensor([GOAL_X + 0.05, 0.1 + 0.2 + 0.3]))


def test_success_stays_in_a_frozen_row_until_reset():
    rows, *_ = make(2)
    put(rows, 0, x=GOAL_X)
    history, *_ = rows.step(actions(rows, *[(0.1, 0.0)] * 3))
    kept = history[AGENT_POS][0].clone()
    put(rows, 0, x=-0.5)
    again, reward, info = rows.step(actions(rows, *[(0.1, 0.0)] * 3))
    assert torch.equal(again[AGENT_POS][0], kept)
    assert reward[0] == 0
    assert reward[1] > 0
    assert info["success"][0]
    assert info["elapsed_steps"].tolist() == [1, 6]
    _, info = rows.reset(torch.tensor([0]), [5])
    assert info["success"].tolist() == info["success_once"].tolist() == [False, False]
    assert info["elapsed_steps"].tolist() == [0, 6]
    assert rows.terminated.tolist() == [False, False]


def test_nothing_is_simulated_when_every_row_has_ended():
    rows, *_ = make(2)
    rows.terminated[:] = True
    before = rows.simulator.stepped, rows.simulator.observed
    _, reward, _ = rows.step(actions(rows, *[(0.1, 0.0)] * 3))
    assert (rows.simulator.stepped, rows.simulator.observed) == before
    assert reward.tolist() == [0, 0]


def test_time_limit_in_mid_chunk_truncates_at_that_step():
    rows, *_ = make(1, n_obs_steps=2, n_action_steps=5)
    for _ in range(3):
        history, _, info = rows.step(actions(rows, *[(0.01, 0.0)] * 5))
    assert rows.truncated.tolist() == [True]
    assert rows.terminated.tolist() == [False]
    assert info["elapsed_steps"].tolist() == [MAX_STEPS]
    torch.testing.assert_close(history[AGENT_POS][0, -1], rows.simulator.position[0])
    assert rows.simulator.stepped == MAX_STEPS


def test_partial_reset_keeps_the_other_rows_histories():
    rows, *_ = make(3)
    history, *_ = rows.step(actions(rows, *[(0.1, 0.05)] * 3))
    before = {key: values.clone() for key, values in history.items()}
    after, _ = rows.reset(torch.tensor([1]), [9])
    for key, values in after.items():
        assert torch.equal(values[[0, 2]], before[key][[0, 2]])
    assert torch.equal(after[AGENT_POS][1, 0], after[AGENT_POS][1, 1])
    assert torch.equal(history[AGENT_POS], before[AGENT_POS]), "what was handed out has changed"


def test_out_of_range_entries_are_clipped_and_counted_until_the_row_ends():
    rows, *_ = make(2)
    put(rows, 0, x=GOAL_X - 0.5)
    put(rows, 1, x=-2.5)
    _, _, info = rows.step(actions(rows, (4.0, 0.0), (4.0, -1.5), (0.5, 0.0)))
    assert info["clipped"].tolist() == [1, 3]  # row 0 ended with its first action
    torch.testing.assert_close(rows.simulator.position[1], torch.tensor([-2.5 + 1 + 1 + 0.5, -1.0]))


DIVERGED = "the simulation diverged: the observation holds NaN or infinity"
CRASHES = [
    ({"x": -9.0, "y": DIVERGE_Y}, 0.5, DIVERGED),
    ({"x": -9.0, "y": RAISE_Y}, -0.5, "ValueError: no picture"),
    ({"x": CRASH_X}, 0.0, "RuntimeError: left the world"),
]


@pytest.mark.parametrize(("where", "dy", "reason"), CRASHES)
def test_crash_ends_the_episode_without_success_and_with_its_reason(where, dy, reason):
    rows, *_ = make(1)
    put(rows, 0, **where)
    after, _, info = rows.step(actions(rows, *[(0.5, dy)] * 3))
    assert rows.terminated.tolist() == [True]
    assert info["success"].tolist() == info["success_once"].tolist() == [False]
    assert rows.errors == [reason]
    assert torch.isfinite(after[AGENT_POS]).all()
    _, _, again = rows.step(actions(rows, *[(0.0, 0.0)] * 3))
    assert again["elapsed_steps"].tolist() == info["elapsed_steps"].tolist()
    rows.reset(torch.tensor([0]), [0])
    assert rows.errors == [None]
    rows.step(actions(rows, *[(0.1, 0.0)] * 3))
    assert rows.terminated.tolist() == [False]


def test_crash_in_the_observation_of_a_success_does_not_count_as_success():
    rows, *_ = make(1)
    put(rows, 0, x=GOAL_X, y=DIVERGE_Y)
    _, _, info = rows.step(actions(rows, *[(0.5, 0.5)] * 3))
    assert info["success_once"].tolist() == info["success"].tolist() == [False]


def test_a_diverged_row_takes_no_other_with_it():
    rows, *_ = make(3)
    put(rows, 0, y=DIVERGE_Y + 1)
    for _ in range(2):  # in the second chunk the frozen row is still NaN underneath
        history, reward, info = rows.step(actions(rows, *[(0.01, 0.0)] * 3))
    assert rows.errors == [DIVERGED, None, None]
    assert rows.terminated.tolist() == [True, False, False]
    assert info["elapsed_steps"].tolist()[1:] == [6, 6]
    assert torch.isfinite(history[AGENT_POS]).all()
    assert torch.isfinite(reward).all()


def test_a_row_that_starts_diverged_is_ended_at_once():
    rows, *_ = make(2)
    rows.simulator.start = lambda seed: torch.tensor([0.0, DIVERGE_Y + 1])
    rows.reset(torch.tensor([1]), [3])
    assert rows.terminated.tolist() == [False, True]
    assert rows.errors == [None, DIVERGED]


def fail_at(bad):
    def start(seed):
        if seed == bad:
            raise ValueError("no such scene")
        return torch.zeros(2)

    return start


def test_a_seed_that_raises_at_its_reset_crashes_its_row_alone():
    """On a GPU all rows live in one process: an error that went on would end the episodes of the others too."""
    rows, *_ = make(3)
    before, *_ = rows.step(actions(rows, *[(0.1, 0.05)] * 3))
    rows.simulator.start = fail_at(7)
    history, info = rows.reset(torch.tensor([0, 2]), [7, 8])
    assert rows.errors == ["ValueError: no such scene", None, None]
    assert rows.terminated.tolist() == [True, False, False]
    assert info["elapsed_steps"].tolist() == [0, 3, 0]
    assert torch.equal(history[AGENT_POS][1], before[AGENT_POS][1])
    assert history[AGENT_POS][2].abs().max() == 0
    _, reward, info = rows.step(actions(rows, *[(0.1, 0.0)] * 3))
    assert info["elapsed_steps"].tolist() == [0, 6, 3]
    assert reward[0] == 0


def test_a_first_frame_that_raises_crashes_the_rows_that_were_reset():
    rows, *_ = make(2)
    rows.simulator.start = lambda seed: torch.tensor([0.0, RAISE_Y - 1])
    _, info = rows.reset(torch.tensor([1]), [3])
    assert rows.errors == [None, "ValueError: no picture"]
    assert info["success"].tolist() == [False, False]


def test_the_first_reset_has_no_frame_to_go_on_with():
    rows = ActionChunk(point_mass_env.build(1))
    rows.simulator.start = fail_at(0)
    with pytest.raises(ValueError, match="no such scene"):
        rows.reset(torch.tensor([0]), [0])


def test_rows_that_had_succeeded_keep_their_success_when_another_crashes():
    rows, *_ = make(2, n_action_steps=1)
    put(rows, 0, x=GOAL_X)
    rows.step(actions(rows, (0.1, 0.0)))
    assert rows.success_once.tolist() == [True, False]
    put(rows, 1, x=CRASH_X)
    _, _, info = rows.step(actions(rows, (0.1, 0.0)))
    assert info["success_once"].tolist() == [True, False]
    assert rows.errors[0] is None
    assert "left the world" in rows.errors[1]


def test_nothing_plays_before_the_first_reset():
    rows = ActionChunk(point_mass_env.build(1))
    rows.step(torch.zeros(1, 1, 2))
    assert rows.simulator.stepped == 0


def test_from_spec():
    simulator = point_mass_env.build(1)
    rows = ActionChunk.from_spec(simulator, ChunkSpec(n_obs_steps=2, horizon=8, n_action_steps=5))
    assert (rows.n_obs_steps, rows.n_action_steps) == (2, 5)
    rows = ActionChunk.from_spec(simulator, None)
    assert (rows.n_obs_steps, rows.n_action_steps) == (1, 1)
