"""A training of 30 steps and its distillation give what they gave before the policy was put together from parts."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from reach_demos import make_store
from safetensors.torch import load_file

from manicm_ms.policies.migration import present_tensor_name
from manicm_ms.training.distill import distill
from manicm_ms.training.presets import STUDENT_PRESETS, TEACHER_PRESETS
from manicm_ms.training.train import train

STORED = json.loads((Path(__file__).parent / "training_of_format_1.json").read_text())
"""Losses and sums of tensors. On the machine where they were written, the weights are equal to the bit."""
CHANGES = {
    "inputs": {"points": {"max_points": 32}},
    "normalizer": {"min_state_range": 0.0},
    "backbone": {"down_dims": (16, 32)},
}
SHORT = {"steps": 30, "batch_size": 16, "warmup_steps": 5, "log_every": 1}


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    folder = tmp_path_factory.mktemp("same")
    data = make_store(folder / "reach.zarr", episodes=6)
    teacher = replace(TEACHER_PRESETS.get("quick"), **SHORT, changes=CHANGES)
    made = train("simple_dp3", data, folder / "teacher", teacher, device="cpu", precision="32-true")
    student = replace(STUDENT_PRESETS.get("quick"), **SHORT)
    distill(made, data, folder / "student", student, device="cpu", precision="32-true")
    return folder


@pytest.mark.parametrize("kind", ["teacher", "student"])
def test_loss_and_weights_are_those_of_before(pair, kind):
    log = (pair / f"{kind}.train" / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["loss"] for line in log] == pytest.approx(STORED[kind]["loss"], rel=1e-3)
    weights = load_file(pair / kind / "model.safetensors")
    for name, total in STORED[kind]["sums"].items():
        assert float(weights[present_tensor_name(name)].double().sum()) == pytest.approx(total, rel=1e-3, abs=1e-3)
