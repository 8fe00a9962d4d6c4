"""Pages of results show what the kept results give with the present intervals."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

from manicm_ms.evaluation.results import renewed

REPO = Path(__file__).parents[2]
RESULTS = REPO / "docs" / "results"


def script(path):
    name = Path(path).stem
    spec = importlib.util.spec_from_file_location(name, REPO / "scripts" / path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def kept(name):
    return json.loads((RESULTS / "data" / f"{name}.json").read_text())


def test_the_tables_of_learning_are_those_of_the_kept_results():
    page, table = (RESULTS / "learning.md").read_text(), script("results/results_table.py")
    for label, name in (("10 one-sided", "one"), ("10 two-sided", "two"), ("40 two-sided", "two40")):
        results = renewed(kept(name))
        assert all(line in page for line in table.rows(label, results))
        assert f"- {table.paired(label, results)}\n" in page


def test_the_real_world_page_is_that_of_the_kept_results():
    assert (RESULTS / "real_world.md").read_text() == script("reproduce_real_world_table.py").page(kept("real_world"))


def rounded(value):
    """The same with numbers as another processor may round them."""
    if isinstance(value, dict):
        return {key: rounded(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [rounded(entry) for entry in value]
    return round(value, 9) if isinstance(value, float) else value


def test_kept_results_hold_the_present_intervals():
    renew = script("results/renew_results.py").renew
    for path in (RESULTS / "data").glob("*.json"):
        if path.stem.startswith("benchmark_"):  # tests/benchmark/test_table.py compares these with their page
            continue
        results = kept(path.stem)
        assert rounded(renew(results)) == rounded(results), (
            "python scripts/results/renew_results.py docs/results/data/*.json"
        )


def test_results_of_the_first_version_get_the_present_intervals_from_their_counts():
    entry = {"n": 50, "successes": 49, "success_rate": 0.98, "ci95": [0.895, 0.9965], "crashed": 0}
    pair = {"both": 48, "only_first": 2, "only_second": 0, "neither": 0, "difference_ci95": [-0.13, 0.03]}
    found = renewed({"schema_version": 1, "policies": [entry], "paired": pair})
    assert found["policies"][0]["ci95"] == pytest.approx([0.8935, 0.9995], abs=1e-4)
    assert found["policies"][0]["success_at_end"] is None
    assert found["paired"]["difference_ci95"][0] == pytest.approx(-0.1346, abs=1e-3)
    assert found["paired"]["mcnemar_p"] == 0.5
