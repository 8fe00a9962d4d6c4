"""DP3's stores become ours: hand-written ones, as DP3's collectors write them, and what they must not be."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
import zarr
from rich.console import Console
from store_samples import SPEC

from manicm_ms.cli import main
from manicm_ms.demos.convert import import_store
from manicm_ms.demos.store import DemoStore
from manicm_ms.demos.summary import summarize
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import ConfigError, OutputExistsError, SpecMismatchError, StoreError, UnknownNameError
from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.sensing.point_cloud import farthest_point_order
from manicm_ms.spec import EnvSpec
from manicm_ms.training.presets import TEACHER_PRESETS
from manicm_ms.training.train import train

ENV_ID = "ur3e/slide-block"
LENGTHS = (30, 41)
DIM, ACTION_DIM = 10, 7


def arrays(points=600, channels=3, dim=DIM, action_dim=ACTION_DIM, seed=0):
    """What DP3 collects: float32 frames one after another, clouds padded with zeros, and where each episode ends."""
    rng, frames = np.random.default_rng(seed), sum(LENGTHS)
    clouds = rng.uniform(0.1, 0.4, (frames, points, channels)).astype("f4")
    clouds[:, 550:] = 0
    return {
        "data/point_cloud": clouds,
        "data/state": rng.uniform(-0.5, 0.5, (frames, dim)).astype("f4"),
        "data/action": rng.uniform(-1, 1, (frames, action_dim)).astype("f4"),
        "meta/episode_ends": np.cumsum(LENGTHS),
    }


def write(path, changes=None, **shapes):
    """Write a store as DP3's scripts do: zarr format 2, no attributes. A change to None leaves an array out."""
    group = zarr.open_group(str(path), mode="w", zarr_format=2)
    for name, values in {**arrays(**shapes), **(changes or {})}.items():
        if values is not None:
            array = group.create_array(name, shape=values.shape, chunks=(100, *values.shape[1:]), dtype=values.dtype)
            array[:] = values
    return path


@pytest.fixture
def theirs(tmp_path):
    return write(tmp_path / "theirs.zarr")


def test_a_store_of_a_registered_env(theirs, tmp_path):
    out = tmp_path / "ours.zarr"
    done = import_store(theirs, "dp3", out, env=ENV_ID, command="the command")
    given = arrays()
    assert (done.episodes, done.frames) == (len(LENGTHS), sum(LENGTHS))
    with DemoStore.open(out) as store:
        assert store.spec == ENVS.get(ENV_ID).spec
        assert store.lengths.tolist() == list(LENGTHS)
        assert store.seeds.tolist() == [-1, -2]
        assert store.successes.all()
        np.testing.assert_array_equal(store.state, given["data/state"])
        np.testing.assert_array_equal(store.action, given["data/action"])
        assert store.provenance["source"] == str(theirs)
        assert store.provenance["command"] == "the command"
        assert "600 points" in store.provenance["points"]
        for k in (0, 50, sum(LENGTHS) - 1):
            real, kept = given["data/point_cloud"][k, :550], store.point_cloud[k]
            np.testing.assert_array_equal(kept, real[farthest_point_order(real, 512)])
            assert_farthest_first(kept[:60])
    assert summarize(out).problems == []


def test_the_command_line_reads_it(theirs, tmp_path, capsys):
    out = tmp_path / "ours.zarr"
    words = ["convert", str(theirs), "--from", "dp3", "--env", ENV_ID, "--num-points", "64", "--out", str(out)]
    with pytest.raises(SystemExit, match=r"^0$"):
        main(words)
    assert f"{len(LENGTHS)} episodes, {sum(LENGTHS)} frames" in " ".join(capsys.readouterr().out.split())
    with DemoStore.open(out) as store:
        assert store.point_cloud.shape == (sum(LENGTHS), 64, 3)


def assert_farthest_first(points):
    """Each point is farther from those before it than any later one is: the definition, checked by brute force."""
    gaps = np.linalg.norm(points[:, None] - points[None], axis=2)
    for k in range(1, len(points) - 1):
        nearest_before = gaps[k:, :k].min(axis=1)
        assert nearest_before[0] >= nearest_before.max() - 1e-6


def test_a_store_of_no_known_env(tmp_path):
    source = write(tmp_path / "adroit_hammer.zarr", channels=6, dim=24, action_dim=26, points=512)
    out = tmp_path / "ours.zarr"
    import_store(source, "dp3", out, num_points=128, colors=True, control_hz=25.0)
    with DemoStore.open(out) as store:
        spec = store.spec
        assert (spec.env_id, spec.obs.frame, spec.action.control_hz) == ("dp3/adroit_hammer", "world", 25.0)
        assert store.point_cloud.shape == (sum(LENGTHS), 128, 6)
        assert (store.state.shape[1], store.action.shape[1], spec.max_episode_steps) == (24, 26, 41)
        assert set(map(tuple, store.point_cloud[0])) <= set(
            map(tuple, arrays(channels=6, points=512)["data/point_cloud"][0])
        )


def test_colours_of_bytes_become_fractions_and_few_points_are_repeated(tmp_path):
    clouds = np.zeros((sum(LENGTHS), 40, 6), "f4")
    clouds[:, :9] = np.random.default_rng(0).uniform(0.1, 0.3, (9, 6))
    clouds[:, :9, 3:] = 255 * clouds[:, :9, 3:]
    source = write(tmp_path / "theirs.zarr", {"data/point_cloud": clouds})
    import_store(source, "dp3", tmp_path / "ours.zarr", env=ENV_ID, colors=True)
    with DemoStore.open(tmp_path / "ours.zarr") as store:
        kept = store.point_cloud[0]
    np.testing.assert_array_equal(kept[9:18], kept[:9])
    expected = clouds[0, :9] / np.array([1, 1, 1, 255, 255, 255], "f4")
    order = np.lexsort(kept[:9].T)
    np.testing.assert_allclose(kept[:9][order], expected[np.lexsort(expected.T)], rtol=1e-6)


def test_pictures_come_along(tmp_path):
    rng, frames = np.random.default_rng(1), sum(LENGTHS)
    img = rng.integers(0, 256, (frames, 24, 32, 3), dtype="u1")
    depth = rng.uniform(0, 2, (frames, 24, 32)).astype("f4")
    source = write(tmp_path / "theirs.zarr", {"data/img": img, "data/depth": depth})
    import_store(source, "dp3", tmp_path / "ours.zarr", env=ENV_ID)
    with DemoStore.open(tmp_path / "ours.zarr") as store:
        assert store.spec.obs.image_size == (24, 32)
        np.testing.assert_array_equal(store.frames("image"), img)
        np.testing.assert_array_equal(store.frames("depth"), depth)
    channels_first = write(tmp_path / "first.zarr", {"data/img": np.moveaxis(img, 3, 1).copy()})
    done = import_store(channels_first, "dp3", tmp_path / "without.zarr", env=ENV_ID)
    assert any("data/img" in note and "left out" in note for note in done.notes)


FRAMES = sum(LENGTHS)


@pytest.mark.parametrize(
    ("changes", "options", "error", "match"),
    [
        ({"data/state": np.ones((FRAMES, 24), "f4")}, {}, SpecMismatchError, "agent_pos has 24 entries .* has 10"),
        ({"data/action": np.ones((FRAMES, 4), "f4")}, {}, SpecMismatchError, "action has 4 entries .* has 7"),
        ({"data/action": np.full((FRAMES, 7), 1.5, "f4")}, {}, SpecMismatchError, r"reaches 1.5 .* \[-1, 1\]"),
        ({"data/action": np.full((FRAMES, 7), np.nan, "f4")}, {}, StoreError, "NaN"),
        ({"data/action": np.zeros((FRAMES - 1, 7), "f4")}, {}, StoreError, "damaged: data/action has 70 frames"),
        ({"data/action": None}, {}, StoreError, "lacks data/action; it holds"),
        ({"meta/episode_ends": None}, {}, StoreError, "lacks meta/episode_ends; it holds"),
        ({"meta/episode_ends": np.zeros(0, "i8")}, {}, StoreError, "holds no episodes"),
        ({"meta/episode_ends": np.array([40, 30])}, {}, StoreError, "does not grow"),
        ({"data/point_cloud": np.zeros((FRAMES, 5, 4), "f4")}, {}, StoreError, "4 channels"),
        ({"data/point_cloud": np.zeros((FRAMES, 5), "f4")}, {}, StoreError, "3 axes"),
        ({}, {"env": "ur3e/slide-blok"}, UnknownNameError, "ur3e/slide-block"),
        ({}, {"colors": True}, ConfigError, "no colours"),
        ({}, {"num_points": 0}, ConfigError, "num_points"),
        ({}, {"num_points": 99_999_999}, ConfigError, "--num-points 99999999 exceeds 7056: the clouds of .* have"),
        ({}, {"env": None, "frame": "camera"}, ConfigError, "camera"),
        ({}, {"env": None, "control_hz": 0.0}, ConfigError, "control_hz must be positive"),
        ({}, {"frame": "world"}, ConfigError, "leave them out"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, changes, options, error, match):
    source = write(tmp_path / "theirs.zarr", changes)
    out = tmp_path / "new" / "ours.zarr"
    with pytest.raises(error, match=match):
        import_store(source, "dp3", out, **{"env": ENV_ID, **options})
    assert not out.parent.exists()


def test_what_is_no_store_or_damaged_is_refused(theirs, tmp_path):
    out = tmp_path / "ours.zarr"
    with pytest.raises(StoreError, match="no store at"):
        import_store(tmp_path / "nowhere", "dp3", out, env=ENV_ID)
    (tmp_path / "empty").mkdir()
    with pytest.raises(StoreError, match="not a store of DP3's layout"):
        import_store(tmp_path / "empty", "dp3", out, env=ENV_ID)
    chunk = theirs / "data" / "point_cloud" / "0.0.0"
    chunk.write_bytes(chunk.read_bytes()[:100])
    with pytest.raises(StoreError, match="point_cloud cannot be read"):
        import_store(theirs, "dp3", out, env=ENV_ID)
    assert not out.exists()
    out.write_text("mine")
    with pytest.raises(OutputExistsError, match="choose another --out"):
        import_store(theirs, "dp3", out, env=ENV_ID)
    assert out.read_text() == "mine"


def test_a_spec_that_another_tool_kept_is_compared(theirs, tmp_path):
    ours = EnvSpec.to_dict(SPEC)
    (theirs / ".zattrs").write_text(json.dumps({"env_spec": ours}))
    with pytest.raises(SpecMismatchError, match="do not fit"):
        import_store(theirs, "dp3", tmp_path / "a.zarr", env=ENV_ID)
    (theirs / ".zattrs").write_text(json.dumps({"env_spec": "of something else"}))
    assert import_store(theirs, "dp3", tmp_path / "a.zarr", env=ENV_ID).episodes == len(LENGTHS)


def test_clouds_outside_of_the_workspace_are_said(tmp_path):
    rng = np.random.default_rng(0)
    inside = rng.uniform((0.2, -0.2, 0.01), (0.45, 0.2, 0.1), (FRAMES, 20, 3)).astype("f4")
    for name, clouds, said in (("in", inside, False), ("out", inside - np.float32(0.5), True)):
        source = write(tmp_path / f"{name}.zarr", {"data/point_cloud": clouds})
        notes = import_store(source, "dp3", tmp_path / f"ours-{name}.zarr", env=ENV_ID).notes
        assert said == any("0 % of the points lie in the workspace" in n and "another frame" in n for n in notes)


def test_a_policy_trains_on_it(theirs, tmp_path):
    import_store(theirs, "dp3", tmp_path / "ours.zarr", env=ENV_ID)
    with DemoStore.open(tmp_path / "ours.zarr", "a") as store:
        store.append(replace(store.episode(0), success=False))
    small = {"inputs": {"points": {"max_points": 16}}, "backbone": {"down_dims": (8, 16)}}
    preset = replace(TEACHER_PRESETS.get("quick"), steps=4, batch_size=8, warmup_steps=1, changes=small)
    console = Console(file=io.StringIO(), width=200)
    ours = tmp_path / "ours.zarr"
    checkpoint = train("simple_dp3", ours, tmp_path / "run", preset, device="cpu", console=console)
    assert f"{ours}: 1 episode of 3 not solved, and learnt from all the same\n" in console.file.getvalue()
    assert load_checkpoint(checkpoint).spec.agent_pos_names == ENVS.get(ENV_ID).spec.agent_pos_names
