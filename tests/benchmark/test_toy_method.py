"""A method whose encoder, backbone and head lie in a folder of their own goes from training to the benchmark."""

import importlib
import json
from pathlib import Path

import pytest
import torch

from manicm_ms import tasks
from manicm_ms.cli import main
from manicm_ms.policies import example_observations
from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.policies.methods import METHODS
from manicm_ms.training.presets import preset_for

TOY_METHODS = Path(__file__).parent / "toy_methods"


@pytest.fixture(scope="module")
def grid(tmp_path_factory, benchmark_environment):
    """The benchmark of the toy method on a toy task: what it wrote and the method's checkpoint."""
    out = tmp_path_factory.mktemp("toy") / "grid"
    folders = f"{benchmark_environment['MANICM_MS_TASKS']}:{TOY_METHODS}"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MANICM_MS_TASKS", folders)
        for folder in folders.split(":"):
            if folder not in tasks.__path__:
                tasks.__path__.append(folder)
        for module in ("bench_points", "toy_parts"):
            importlib.import_module(f"manicm_ms.tasks.{module}")
        words = "--preset smoke --demos 3 --episodes 4 --num-envs 1 --envs toy/near --methods toy_once --seeds 0"
        with pytest.raises(SystemExit) as end:
            main(["benchmark", *words.split(), "--out", str(out)])
    assert end.value.code == 0
    return out


def test_it_is_trained_and_evaluated(grid):
    (cell,) = json.loads((grid / "results.json").read_text())["cells"]
    assert (cell["method"], cell["n"], cell["nfe"]) == ("toy_once", 4, 1)
    assert cell["latency_ms"]["n"] > 0


def test_its_checkpoint_acts_as_it_says(grid):
    folder = grid / "toy/near" / "seed0" / "toy_once" / "checkpoint"
    policy = load_checkpoint(folder)
    config = json.loads((folder / "config.json").read_text())["config"]
    assert config["backbone"] == {"name": "toy_linear", "width": 8}, "the size smoke"
    assert config["encoder"] == {"name": "toy_mean", "width": 24}
    obs = example_observations(policy, batch=2, seed=1)
    generator = torch.Generator().manual_seed(0)
    actions = policy.act(obs, generator=generator)
    assert actions.shape == (2, 3, policy.spec.action.dim)
    assert not torch.equal(actions, policy.act(obs, generator=generator)), "it maps noise"


def test_a_row_that_names_a_missing_head_is_refused_in_one_line(grid, tmp_path, capsys):
    store = next((grid / "toy/near").rglob("*.zarr"), None) or next(grid.rglob("*.zarr"))
    with pytest.raises(SystemExit) as end:
        main(["train", "toy_nowhere", "--data", str(store), "--out", str(tmp_path / "x")])
    assert end.value.code == 2
    assert "unknown head 'toy_twice': did you mean 'toy_once'?" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_another_row_can_take_its_backbone(grid):
    config = METHODS.get("simple_dp3").configuration("smoke", {"backbone": "toy_linear"})
    assert config["backbone"] == {"name": "toy_linear", "width": 8}
    assert preset_for("toy_once", "smoke").size == "smoke"
