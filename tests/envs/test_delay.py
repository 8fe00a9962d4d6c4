"""Delayed actions against a list that is indexed by hand."""

import torch

from manicm_ms.envs.delay import ActionDelay


def test_each_component_of_each_row_comes_as_late_as_it_should():
    n, dim, longest, steps = 5, 3, 4, 12
    generator = torch.Generator().manual_seed(0)
    delay = torch.randint(0, longest + 1, (n, dim), generator=generator)
    resting = torch.randn(n, dim, generator=generator)
    actions = torch.randn(steps, n, dim, generator=generator)
    queue = ActionDelay(n, dim, longest)
    queue.start(torch.arange(n), delay, resting)
    for k in range(steps):
        played = queue.push(actions[k])
        for row in range(n):
            for j in range(dim):
                given = k - int(delay[row, j])
                under_way = actions[max(given + 1, 0) : k + 1, row, j].sum() + resting[row, j] * max(-given - 1, 0)
                torch.testing.assert_close(queue.pending()[row, j], under_way)
                assert played[row, j] == (actions[given, row, j] if given >= 0 else resting[row, j])


def test_no_delay_changes_nothing():
    queue = ActionDelay(2, 2, 3)
    action = torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    assert torch.equal(queue.push(action), action)


def test_a_row_that_starts_anew_leaves_the_others_alone():
    queue = ActionDelay(2, 1, 2)
    every = torch.arange(2)
    queue.start(every, torch.full((2, 1), 2), torch.zeros(2, 1))
    for value in (1.0, 2.0):
        queue.push(torch.full((2, 1), value))
    queue.start(torch.tensor([1]), torch.tensor([[1]]), torch.tensor([[-5.0]]))
    assert queue.push(torch.full((2, 1), 3.0)).flatten().tolist() == [1.0, -5.0]
    assert queue.push(torch.full((2, 1), 4.0)).flatten().tolist() == [2.0, 3.0]
