"""Index and noise streams: every sample once an epoch, a function of seed and step alone."""

import pytest
import torch

from manicm_ms.training.stream import IndexStream, step_generator, subset_generator


@pytest.mark.parametrize(("size", "batch"), [(10, 4), (7, 7), (3, 8), (100, 1)])
def test_every_sample_once_an_epoch(size, batch):
    stream = IndexStream(size, batch, seed=3)
    epochs = 5
    drawn = torch.cat([stream.batch(step) for step in range(-(-size * epochs // batch))])[: size * epochs]
    orders = drawn.reshape(epochs, size)
    assert torch.equal(orders.sort(dim=1).values, torch.arange(size).expand(epochs, size))
    if size > 5:
        assert len({tuple(order.tolist()) for order in orders}) == epochs


def test_a_step_can_be_asked_for_in_any_order():
    stream = IndexStream(13, 5, seed=0)
    forward = [stream.batch(step) for step in range(20)]
    fresh = IndexStream(13, 5, seed=0)
    for step in (17, 3, 4, 0, 19):
        assert torch.equal(fresh.batch(step), forward[step])


def test_seed_matters():
    assert not torch.equal(IndexStream(50, 20, 0).batch(0), IndexStream(50, 20, 1).batch(0))


def test_ranks_share_the_batch():
    stream = IndexStream(30, 8, seed=1)
    parts = [stream.batch(2, rank, 4) for rank in range(4)]
    assert [len(part) for part in parts] == [2, 2, 2, 2]
    assert sorted(torch.cat(parts).tolist()) == sorted(stream.batch(2).tolist())


def test_noise_is_a_function_of_seed_step_and_rank():
    def draw(*key):
        return torch.randn(4, generator=step_generator(*key, "cpu"))

    assert torch.equal(draw(0, 5, 0), draw(0, 5, 0))
    others = [draw(0, 5, 0), draw(1, 5, 0), draw(0, 6, 0), draw(0, 5, 1)]
    assert len({tuple(o.tolist()) for o in others}) == 4


def test_encoding_shares_no_draw_with_training():
    """It once drew the subsets of block k from the generator of step k, whose first draw picks among the subsets."""
    steps = {step_generator(3, step, 0, "cpu").initial_seed() for step in range(200)}
    blocks = [subset_generator(3, block, "cpu").initial_seed() for block in range(200)]
    assert len(set(blocks)) == 200
    assert not steps & set(blocks)
    assert subset_generator(3, 7, "cpu").initial_seed() == blocks[7] != subset_generator(4, 7, "cpu").initial_seed()
