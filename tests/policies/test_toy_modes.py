"""The comparison of one-step methods on two modes runs from end to end, every head of it, in a few steps."""

import importlib.util
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "results" / "toy_modes.py"


@pytest.fixture(scope="module")
def toy():
    spec = importlib.util.spec_from_file_location("toy_modes", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["toy_modes"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["toy_modes"]


def test_every_method_is_trained_scored_and_printed(toy):
    rows = toy.measured(steps=2, seeds=(0,))
    evaluations = {label: scores[0][0] for label, scores in rows.items()}
    assert {label for label, count in evaluations.items() if count != 1} == {"diffusion, 10 steps"}
    assert len(evaluations) == len(toy.HEADS) + 2
    assert all(0 <= score.smaller_mode <= score.on_mode / 2 for [(_, score)] in rows.values())
    assert toy.table(rows, (0,)).count("\n") == len(rows) + 1


def test_the_same_seed_gives_the_same_samples(toy):
    one, other = (toy.samples_of(toy.policies_of("meanflow", 3, 1)["meanflow"], 1) for _ in range(2))
    assert one.equal(other)
    assert one.shape == (toy.EVAL_SAMPLES, 2)
