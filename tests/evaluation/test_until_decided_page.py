"""The page of simulated comparisons: a case that is certain, and the levels at the boundary."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from manicm_ms.evaluation.decided import StoppingRule
from manicm_ms.evaluation.rollout import EpisodeResult

REPO = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("until_decided", REPO / "scripts" / "results" / "until_decided.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["until_decided"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["until_decided"]


def test_a_simulated_comparison_stops_where_the_rule_of_an_evaluation_does(script):
    case, margin, most = script.Case("", 0.02, 0.2), 0.2, 150
    stops = script.simulate(case, margin, most, 200, seed=1)
    rule, u = StoppingRule(margin), np.random.default_rng(1).random((200, most))
    for row in range(12):
        first, second = (
            [EpisodeResult(t, bool(won), 1, 1, 0.0) for t, won in enumerate(outcomes)]
            for outcomes in (u[row] >= 0.02, u[row] <= 0.8)
        )
        looks = (n for n in range(10, most + 1, 10) if rule.decided(first[:n], second[:n]))
        assert next(looks, most) == stops.pairs[row]


def test_policies_that_agree_are_certain_and_the_page_holds_it(script):
    stops = script.simulate(script.CASES[0], 0.05, 200, 200, seed=0)
    assert set(stops.pairs) == {110}
    assert stops.not_worse.all()
    row = script.stop_row(script.CASES[0], 0.05, 1000, 200, 0)
    assert row == ["always agree", "110", "110", "110", "100.0 %", "0.0 %", "0.0 %", "73"]
    assert f"| {' | '.join(row)} |" in script.PAGE.read_text()


def test_looking_at_a_planned_test_again_and_again_claims_too_much_and_the_bets_do_not(script):
    _, not_worse, worse, planned, peeked = script.boundary_row(0.1, 0.05, 400, 400, 0)
    assert max(float(share.split()[0]) for share in (not_worse, worse)) < 5
    assert float(planned.split()[0]) == pytest.approx(2.5, abs=0.5)
    assert float(peeked.split()[0]) > 8
