"""Checkpoints of format 1, and the shipped ones, act as they did under the last code that wrote format 1."""

import json
from pathlib import Path

import pytest
import torch

from manicm_ms.errors import CheckpointError, ConfigError
from manicm_ms.machine.devices import torch_threads
from manicm_ms.policies import example_observations
from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest, save_checkpoint
from manicm_ms.policies.migration import present_config, present_tensor_name

DATA = Path(__file__).parent / "data"
FORMAT_1, SHIPPED = DATA / "format_1", Path(__file__).parents[2] / "checkpoints"
CONTROL = ", one step"


def stored(path):
    """Checkpoint -> actions of that code: observations of seed 7, two equal rows, noise of seed 3.

    On the machine that wrote them they are equal to the bit; elsewhere the last digits may differ.
    """
    return json.loads(path.read_text())


OLD, NEW = stored(FORMAT_1 / "actions.json"), stored(DATA / "shipped_actions.json")
CASES = [(FORMAT_1, name, OLD) for name in ("teacher", "student")]
CASES += [(SHIPPED, name, NEW) for name in NEW if not name.endswith(CONTROL)]


def acted(policy):
    obs = {key: torch.cat([value, value]) for key, value in example_observations(policy, seed=7).items()}
    shape = (policy.noise_draws, 2, policy.chunk.horizon, policy.spec.action.dim)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(3))
    with torch_threads(1):
        return policy.act(obs, noise=noise)


@pytest.mark.parametrize(("folder", "name", "actions"), CASES, ids=[f"{f.name}/{n}" for f, n, _ in CASES])
def test_a_checkpoint_and_its_control_act_as_they_did(folder, name, actions):
    policy = load_checkpoint(folder / name)
    torch.testing.assert_close(acted(policy), torch.tensor(actions[name]), rtol=0, atol=1e-5)
    control = policy.one_step()
    assert (control is not None) == (name + CONTROL in actions) == name.endswith("teacher")
    if control is not None:
        torch.testing.assert_close(acted(control), torch.tensor(actions[name + CONTROL]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["teacher", "student"])
def test_format_1_becomes_format_2_when_it_is_saved_again(name, tmp_path):
    assert read_manifest(FORMAT_1 / name)["version"] == 1
    policy = load_checkpoint(FORMAT_1 / name)
    assert policy.transforms["cloud_frame"].config.frame == "tcp"
    assert policy.transforms["points"].config.max_points == 16
    assert policy.nfe == {"teacher": 4, "student": 2}[name]
    save_checkpoint(policy, tmp_path / "again", {})
    assert read_manifest(tmp_path / "again")["version"] == 2
    assert torch.equal(acted(load_checkpoint(tmp_path / "again")), acted(policy))


def test_every_shipped_pair_and_its_control_are_stored():
    shipped = {f"{folder.parent.name}/{folder.name}" for folder in SHIPPED.glob("*/*") if folder.is_dir()}
    assert shipped == {name for name in NEW if not name.endswith(CONTROL)}
    assert {name + CONTROL for name in shipped if name.endswith("teacher")} <= set(NEW)


def test_sections_of_format_1_find_their_places():
    config = present_config(
        {
            "network": {"down_dims": [16, 32], "point_features": 8, "cloud_frame": "tcp", "max_points": 7},
            "diffusion": {"num_inference_steps": 4},
            "consistency": {"nfe": 2},
        }
    )
    assert config["backbone"] == {"name": "unet1d", "down_dims": [16, 32]}
    assert config["encoder"] == {"name": "dp3", "point_features": 8}
    assert config["inputs"] == {"points": {"max_points": 7}, "cloud_frame": {"frame": "tcp"}}
    assert config["head"] == {"name": "consistency", "num_inference_steps": 4, "nfe": 2}


@pytest.mark.parametrize("config", [{"net": {}}, {"network": {"depth": 3}}])
def test_what_format_1_never_held_is_refused(config):
    with pytest.raises(ConfigError, match="format 1"):
        present_config(config)


@pytest.mark.parametrize(
    ("former", "present"),
    [
        ("network.unet.down.0.0.skip.weight", "head.backbone.down.0.0.skip.weight"),
        ("network.unet.time_embedding.1.bias", "head.backbone.time_embeddings.0.1.bias"),
        ("average.module.network.encoder.state.0.weight", "average.module.encoder.state.0.weight"),
        ("network.normalizer.action_scale", "normalizer.action_scale"),
        ("head.backbone.subnetwork.unet.x", "head.backbone.subnetwork.unet.x"),
        ("encoder.points.projection.0.weight", "encoder.points.projection.0.weight"),
    ],
)
def test_a_tensor_finds_its_place(former, present):
    assert present_tensor_name(former) == present


def test_a_newer_format_is_refused(tmp_path):
    save_checkpoint(load_checkpoint(FORMAT_1 / "student"), tmp_path / "new", {})
    manifest = json.loads((tmp_path / "new" / "manifest.json").read_text())
    (tmp_path / "new" / "manifest.json").write_text(json.dumps(manifest | {"version": 3}))
    with pytest.raises(CheckpointError, match="format version 3 and this package reads 1 and 2"):
        load_checkpoint(tmp_path / "new")
