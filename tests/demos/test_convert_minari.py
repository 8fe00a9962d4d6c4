"""A converted store is read by Minari itself, by the id that its place gives it."""

import numpy as np
import pytest
from store_samples import episode, make_store

from manicm_ms.cli import main
from manicm_ms.demos.convert import convert
from manicm_ms.demos.store import DemoStore

minari = pytest.importorskip("minari", reason="needs Minari: pip install 'manicm_ms[minari]'")

SEEDS = (3, 4, 5)
EXTRAS = ("image", "depth", "privileged_state")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = make_store(tmp_path_factory.mktemp("in") / "demos.zarr", SEEDS[:2], EXTRAS)
    with DemoStore.open(path, "a") as store:
        store.append(episode(SEEDS[2], success=False))
    return path


@pytest.mark.parametrize("dataset_id", ["reach-v0", "toy/reach-v3"])
def test_minari_reads_what_the_store_holds(store, tmp_path, monkeypatch, dataset_id):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    done = convert(store, "minari", tmp_path / dataset_id)
    assert done.episodes == len(SEEDS)
    data = minari.load_dataset(dataset_id)
    assert data.spec.dataset_id == dataset_id
    assert data.total_episodes == len(SEEDS)
    with DemoStore.open(store) as reader:
        assert data.total_steps == done.frames == reader.num_frames
        for number, theirs in enumerate(data.iterate_episodes()):
            ours = reader.episode(number)
            assert theirs.id == number
            np.testing.assert_array_equal(theirs.actions, ours.action, strict=True)
            assert set(theirs.observations) == set(reader.fields) - {"action"}
            for name, values in theirs.observations.items():
                expected = getattr(ours, name)
                np.testing.assert_array_equal(values[:-1], expected, strict=True)
                np.testing.assert_array_equal(values[-1], expected[-1], strict=True)
            first = {name: values[0] for name, values in theirs.observations.items()}
            assert data.observation_space.contains(first)
            assert data.action_space.contains(theirs.actions[0])
            last = np.zeros(len(ours), bool)
            last[-1] = True
            np.testing.assert_array_equal(theirs.rewards, (last & ours.success).astype(np.float32))
            np.testing.assert_array_equal(theirs.terminations, last & ours.success)
            np.testing.assert_array_equal(theirs.truncations, last & (not ours.success))
    about = list(data.storage.get_episode_metadata(range(len(SEEDS))))
    assert [m["seed"] for m in about] == list(SEEDS)
    assert [bool(m["success"]) for m in about] == [True, True, False]


def test_minari_lists_what_the_command_line_wrote(store, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["convert", str(store), "--to", "minari", "--out", "sets/reach-v0"])  # a path from here
    assert "reach-v0: 3 episodes" in "".join(capsys.readouterr().out.split("\n"))
    assert list(minari.list_local_datasets()) == ["reach-v0"]


def test_elsewhere_the_name_is_the_id(store, tmp_path, monkeypatch):
    convert(store, "minari", tmp_path / "elsewhere" / "reach-v1")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "elsewhere"))
    assert minari.load_dataset("reach-v1").total_episodes == len(SEEDS)
