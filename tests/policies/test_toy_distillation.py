"""Two equally good actions: what distillation keeps of them decides between the formulas."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).parents[2] / "scripts" / "results" / "toy_distillation.py"


@pytest.fixture(scope="module")
def toy():
    spec = importlib.util.spec_from_file_location("toy_distillation", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["toy_distillation"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["toy_distillation"]


@pytest.fixture(scope="module")
def scores(toy):
    budget = toy.Budget(teacher=1500, student=600, batch=128)
    names = ("public formula", "corrected epsilon, abar_prev[0] = 1")
    rows, _ = toy.run(toy.two_modes, budget, 0, {n: toy.SOLVERS[n] for n in names})
    return {name: toy.score_modes(s, torch.Generator().manual_seed(0)) for name, s in rows.items()}


def test_the_corrected_student_keeps_both_modes(scores):
    teacher, student = scores["teacher, DDIM 10 steps"], scores["student, corrected epsilon, abar_prev[0] = 1"]
    assert teacher.smaller_mode > 0.15
    assert student.smaller_mode > 0.5 * teacher.smaller_mode
    assert student.imbalance < 0.1
    assert student.energy < 0.1


def test_the_public_formula_loses_a_mode(scores):
    student = scores["student, public formula"]
    assert student.imbalance > 0.4
    assert student.smaller_mode < 0.02
    assert student.energy > 0.4


def test_the_undistilled_teacher_in_one_step_meets_neither_mode(scores):
    assert scores["teacher, 1 step"].on_mode < 0.05


def test_energy_distance_is_zero_for_one_distribution_and_twice_the_gap_for_points(toy):
    g = torch.Generator().manual_seed(0)
    a, b = torch.randn(2, 3000, 2, generator=g)
    assert abs(toy.energy_distance(a, b)) < 0.01
    points = torch.zeros(5, 2), torch.tensor([3.0, 4.0]).expand(5, 2)
    assert toy.energy_distance(*points) == pytest.approx(10.0, abs=1e-5)
