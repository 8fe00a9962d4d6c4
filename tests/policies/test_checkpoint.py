import json
import multiprocessing
import os
import shutil
import time
from pathlib import Path

import pytest
import torch
from policy_specs import CHUNK, TINY, make_obs, make_spec, wobble
from safetensors.torch import load_file, save_file

from manicm_ms.demos.stats import FieldStats
from manicm_ms.errors import CheckpointError, ConfigError, OutputExistsError
from manicm_ms.paths import set_aside, sha256
from manicm_ms.policies.backbones.unet1d import UNet1D
from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest, save_checkpoint
from manicm_ms.policies.configuration import merged
from manicm_ms.policies.methods import make_policy, student_of
from manicm_ms.policies.normalizer import Normalizer

FILES = ("config.json", "model.safetensors", "MODEL_CARD.md")
PROVENANCE = {"data": "data/slide_block.zarr", "preset": {"steps": 1500}, "seed": 3}


TCP = {"cloud_frame": {"frame": "tcp"}}


def teacher(name="simple_dp3", seed=0, **sections):
    spec = make_spec()
    sizes = {"point_cloud": 3, "agent_pos": 5, "action": 3}
    stats = {k: FieldStats(*(torch.full((n,), v).numpy() for v in (-0.7, 0.3, 0.0, 1.0))) for k, n in sizes.items()}
    policy = make_policy(name, spec, CHUNK, merged(TINY, sections), stats=stats, seed=seed)
    wobble(policy.head.backbone)
    return policy


@pytest.fixture
def folder(tmp_path):
    save_checkpoint(teacher(), tmp_path / "teacher", PROVENANCE)
    return tmp_path / "teacher"


def act(policy):
    return policy.act(make_obs(policy.spec, 4), generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    "make",
    [
        teacher,
        lambda: teacher("dp3"),
        lambda: teacher(inputs=TCP | {"points": {"max_points": 16}}),
        lambda: student_of(teacher()),
        lambda: student_of(teacher("dp3", inputs=TCP), nfe=4),
    ],
)
def test_what_is_loaded_acts_as_what_was_saved(tmp_path, make):
    policy = make()
    save_checkpoint(policy, tmp_path / "x", PROVENANCE)
    again = load_checkpoint(tmp_path / "x")
    for part in ("encoder", "head", "normalizer"):
        assert type(getattr(again, part)) is type(getattr(policy, part))
    assert type(again.head.backbone) is type(policy.head.backbone)
    assert (again.name, again.spec, again.chunk, again.nfe) == (policy.name, policy.spec, policy.chunk, policy.nfe)
    assert again.config_dict() == policy.config_dict()
    assert torch.equal(act(again), act(policy))
    assert not again.training


@pytest.mark.parametrize(("dtype", "error"), [("float16", 2e-2), ("bfloat16", 2e-1)])
def test_half_precision_halves_the_file_and_keeps_the_normaliser(tmp_path, dtype, error):
    policy = teacher()
    save_checkpoint(policy, tmp_path / "full", {})
    save_checkpoint(policy, tmp_path / "half", {}, dtype=dtype)
    sizes = [(tmp_path / n / "model.safetensors").stat().st_size for n in ("full", "half")]
    assert sizes[1] < 0.6 * sizes[0]
    again = load_checkpoint(tmp_path / "half")
    assert {v.dtype for v in again.state_dict().values()} == {torch.float32}
    for key, value in policy.normalizer.state_dict().items():
        assert torch.equal(value, again.normalizer.state_dict()[key])
    assert 0 < (act(again) - act(policy)).abs().max() < error
    assert read_manifest(tmp_path / "half")["weights_dtype"] == dtype


class Extras(torch.nn.Module):
    """Tensors of every kind under a name that means nothing."""

    def __init__(self):
        super().__init__()
        self.register_buffer("count", torch.tensor([2**24 + 1, -3]))
        self.register_buffer("mask", torch.tensor([True, False]))
        self.register_buffer("mean", torch.tensor([1.0 + 2**-20]))
        self.register_buffer("exact", torch.tensor([1.0 + 2**-40], dtype=torch.float64))
        self.weight = torch.nn.Parameter(torch.tensor([1.0 + 2**-20]))
        self.places = torch.nn.Parameter(torch.tensor([2**24 + 1]), requires_grad=False)


def test_half_precision_casts_floating_parameters_only(tmp_path, monkeypatch):
    """What a tensor is decides, not its name: a parameter of a normaliser is cast, a buffer elsewhere is not."""

    def with_extras(init):
        def longer(module, *arguments):
            init(module, *arguments)
            module.extras = Extras()

        return longer

    for kind in (Normalizer, UNet1D):
        monkeypatch.setattr(kind, "__init__", with_extras(kind.__init__))
    policy = make_policy("simple_dp3", make_spec(), CHUNK, TINY, seed=0)
    save_checkpoint(policy, tmp_path / "x", {}, dtype="float16")
    again = load_checkpoint(tmp_path / "x")
    for extras in (again.normalizer.extras, again.head.backbone.extras):
        assert extras.count.tolist() == [2**24 + 1, -3]
        assert extras.places.tolist() == [2**24 + 1]
        assert extras.mask.tolist() == [True, False]
        assert extras.mean.item() == 1.0 + 2**-20
        assert extras.exact.item() == 1.0 + 2**-40
        assert extras.weight.item() == 1.0


@pytest.mark.parametrize("part", ["policy", "head", "head.backbone", "encoder.points"])
def test_a_compiled_policy_is_saved_as_what_it_wraps(tmp_path, part):
    policy = student_of(teacher())
    expected = act(policy)
    save_checkpoint(policy, tmp_path / "plain", {}, dtype="float16")
    if part == "policy":
        compiled = torch.compile(policy, backend="eager")
    else:
        compiled = policy
        parent, name = policy.get_submodule(part.rpartition(".")[0]), part.rpartition(".")[2]
        setattr(parent, name, torch.compile(getattr(parent, name), backend="eager"))
    save_checkpoint(compiled, tmp_path / "full", {})
    assert torch.equal(act(load_checkpoint(tmp_path / "full")), expected)
    save_checkpoint(compiled, tmp_path / "half", {}, dtype="float16")
    hashes = [sha256(tmp_path / name / "model.safetensors") for name in ("plain", "half")]
    assert hashes[0] == hashes[1]


def test_what_is_no_policy_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"a Sequential is no policy.*save the policy that it wraps"):
        save_checkpoint(torch.nn.Sequential(teacher()), tmp_path / "x", {})
    assert not (tmp_path / "x").exists()


def test_the_manifest_tells_what_and_from_where(folder):
    manifest = read_manifest(folder)
    assert manifest["policy"] == "simple_dp3"
    assert manifest["provenance"] == PROVENANCE
    assert manifest["packages"]["torch"] == torch.__version__
    assert sorted(p.name for p in folder.iterdir()) == sorted([*FILES, "manifest.json"])
    for name in FILES:
        assert manifest["files"][name] == {"sha256": sha256(folder / name), "bytes": (folder / name).stat().st_size}


def test_the_model_card_names_task_policy_data_and_licence(folder):
    card = (folder / "MODEL_CARD.md").read_text()
    count = sum(p.numel() for p in teacher().parameters())
    for words in ("simple_dp3", "test/imaginary", "data/slide_block.zarr", "steps: 1500", "MIT", f"{count:,}", "20 Hz"):
        assert words in card


@pytest.mark.parametrize("name", FILES)
def test_a_truncated_file_is_refused_by_name(folder, name):
    path = folder / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(CheckpointError, match=rf"{name} has \d+ bytes.*again"):
        load_checkpoint(folder)


@pytest.mark.parametrize("name", FILES)
def test_one_altered_bit_is_refused_by_name(folder, name):
    data = bytearray((folder / name).read_bytes())
    data[-2] ^= 1
    (folder / name).write_bytes(bytes(data))
    with pytest.raises(CheckpointError, match=f"{name} was altered.*again"):
        load_checkpoint(folder)


@pytest.mark.parametrize("name", [*FILES, "manifest.json"])
def test_a_missing_file_is_refused_by_name(folder, name):
    (folder / name).unlink()
    with pytest.raises(CheckpointError, match=name):
        load_checkpoint(folder)


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(CheckpointError, match=r"no checkpoint folder .*nowhere"):
        load_checkpoint(tmp_path / "nowhere")


def change_manifest(folder, **changes):
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "lerobot"}, "foreign"),
        ({"version": 3}, "format version 3 and this package reads 1 and 2"),
        ({"files": {}}, "does not list"),
        ({"files": {"../../etc/passwd": {}}}, "does not list"),
    ],
)
def test_a_foreign_manifest_is_refused(folder, changes, message):
    change_manifest(folder, **changes)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(folder)


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00\xff"])
def test_a_broken_manifest_is_refused(folder, text):
    (folder / "manifest.json").write_text(text, encoding="latin-1")
    with pytest.raises(CheckpointError, match=r"manifest\.json"):
        load_checkpoint(folder)


def sign(folder):
    """Make the manifest agree with the files, as one who forges a checkpoint would."""
    change_manifest(
        folder, files={n: {"sha256": sha256(folder / n), "bytes": (folder / n).stat().st_size} for n in FILES}
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"config": {"encoder": {"name": "octo"}}}, "unknown encoder 'octo'"),
        ({"config": {"encoder": {"name": "dp3", "colour": 1}}}, "unknown configuration key 'encoder.colour'"),
        ({"config": {"network": {}}}, "unknown configuration key 'network'"),
        ({"chunk": {"n_obs_steps": 2, "horizon": 4, "n_action_steps": 4}}, "exceeds"),
        ({"chunk": {"n_obs_steps": 2, "horizon": "four", "n_action_steps": 3}}, "train it anew"),
        ({"env_spec": {}}, "train it anew"),
        ({"config": 3}, "train it anew"),
        ({"policy": 3}, "train it anew"),
    ],
)
def test_a_configuration_that_this_version_cannot_build_is_refused(folder, change, message):
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    sign(folder)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_checkpoint(folder)
    assert "config.json" in str(caught.value)


def test_weights_of_another_network_are_refused(folder, tmp_path):
    save_checkpoint(teacher(backbone={"down_dims": (16, 48)}), tmp_path / "other", {})
    shutil.copy(tmp_path / "other" / "model.safetensors", folder / "model.safetensors")
    sign(folder)
    with pytest.raises(CheckpointError, match=r"model\.safetensors does not fit"):
        load_checkpoint(folder)


def test_a_pickle_in_place_of_the_weights_is_refused_and_not_run(folder, tmp_path):
    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "bomb"),)

    torch.save({"x": Bomb()}, folder / "model.safetensors")
    sign(folder)
    with pytest.raises(CheckpointError, match=r"model\.safetensors cannot be read"):
        load_checkpoint(folder)
    assert not (tmp_path / "bomb").exists()


def test_a_lost_tensor_is_refused(folder):
    tensors = load_file(folder / "model.safetensors")
    tensors.pop("normalizer.action_scale")
    save_file(tensors, folder / "model.safetensors")
    sign(folder)
    with pytest.raises(CheckpointError, match=r"normalizer\.action_scale"):
        load_checkpoint(folder)


def test_saving_again_replaces_a_checkpoint_but_nothing_else(folder, tmp_path):
    save_checkpoint(teacher(seed=1), folder, {})
    assert torch.equal(act(load_checkpoint(folder)), act(teacher(seed=1)))
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputExistsError, match="home holds something other"):
        save_checkpoint(teacher(), home, {})
    with pytest.raises(OutputExistsError, match=r"thesis\.tex holds something other"):
        save_checkpoint(teacher(), home / "thesis.tex", {})
    assert (home / "thesis.tex").read_text() == "years of work"


def test_what_cannot_be_saved_is_refused_and_the_old_checkpoint_stays(folder):
    diverged, large = teacher(), teacher()
    with torch.no_grad():
        diverged.head.backbone.head[1].weight[0, 0] = torch.nan
        large.head.backbone.head[1].weight[0, 0] = 1e6
    for policy, dtype, error, message in (
        (diverged, "float32", CheckpointError, "diverged"),
        (large, "float16", CheckpointError, "overflows"),
        (teacher().one_step(), "float32", CheckpointError, "shares the weights of another policy"),
        (teacher(), "float8", ConfigError, "float16"),
    ):
        with pytest.raises(error, match=message):
            save_checkpoint(policy, folder, {}, dtype=dtype)
    with pytest.raises(ConfigError, match="JSON"):
        save_checkpoint(teacher(), folder, {"path": Path("x")})
    assert torch.equal(act(load_checkpoint(folder)), act(teacher()))


def save_for_ever(folder, policies):
    while True:
        for policy in policies:
            save_checkpoint(policy, folder, {})


def test_a_kill_while_saving_leaves_a_whole_checkpoint(folder):
    """Killed at some moments of an endless loop of saves, one of the two policies is always there."""
    policies = [teacher(seed=s) for s in (0, 1)]
    wanted = [act(p) for p in policies]
    for moment in range(8):
        process = multiprocessing.get_context("fork").Process(target=save_for_ever, args=(folder, policies))
        process.start()
        time.sleep(0.05 + 0.037 * moment)
        process.kill()
        process.join()
        where = folder if folder.exists() else set_aside(folder)
        assert any(torch.equal(act(load_checkpoint(where)), action) for action in wanted)


def test_a_save_that_was_cut_off_between_its_renames_is_explained(folder):
    folder.rename(set_aside(folder))
    with pytest.raises(CheckpointError, match=r"rename .*teacher\.old to .*teacher"):
        load_checkpoint(folder)
