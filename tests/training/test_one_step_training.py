"""Methods without a teacher go through the real loop, with products in 16 bits and without."""

import io
from dataclasses import replace

import pytest
import torch
from reach_demos import make_store
from rich.console import Console

from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.policies.policy import example_observations
from manicm_ms.training.presets import TEACHER_PRESETS
from manicm_ms.training.train import train


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return make_store(tmp_path_factory.mktemp("data") / "reach.zarr", episodes=2)


@pytest.mark.parametrize("precision", ["bf16-mixed", "32-true"])
@pytest.mark.parametrize(
    ("method", "changes"),
    [
        ("meanflow", {"head": {"dispersive_weight": 0.5, "velocity_target": "improved"}}),
        ("uca_flow", {}),
        ("drift", {"backbone": "tokens"}),
    ],
)
def test_it_trains_and_acts(data, tmp_path, method, changes, precision):
    preset = replace(TEACHER_PRESETS.get("smoke"), steps=3, warmup_steps=1, batch_size=8).with_changes(changes)
    quiet = Console(file=io.StringIO())
    out = train(method, data, tmp_path / "made", preset, device="cpu", precision=precision, console=quiet)
    policy = load_checkpoint(out)
    actions = policy.act(example_observations(policy, 2), generator=torch.Generator().manual_seed(0))
    assert actions.shape == (2, 3, 3)
    assert (policy.name, policy.nfe) == (method, 1)
