"""Converting: whatever is wrong with the input ends in one clear error, and nothing is written."""

import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from store_samples import PROVENANCE, SPEC, episode, make_store

from manicm_ms.cli import USER_ERROR, main
from manicm_ms.demos.convert import EXPORTERS, IMPORTERS, convert, import_store
from manicm_ms.demos.convert.base import MissingDependencyError, Tally
from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import (
    ConfigError,
    ManicmError,
    NoSpaceError,
    OutputExistsError,
    StoreError,
    UnknownNameError,
)


@pytest.fixture
def store(tmp_path):
    return make_store(tmp_path / "in" / "demos.zarr", seeds=(3, 4))


def files(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


def assert_refused(store, to, out, error, match):
    """The conversion ends in `error`, and neither the output nor a folder on its way is left."""
    around = out.parent
    before = files(around) if around.exists() else None
    with pytest.raises(error, match=match) as raised:
        convert(store, to, out)
    assert isinstance(raised.value, ManicmError)
    assert (files(around) if around.exists() else None) == before


def test_known_formats():
    assert set(EXPORTERS.names()) == {"maniskill", "lerobot", "minari"}
    assert set(IMPORTERS.names()) == {"dp3"}


def test_unknown_formats_are_answered_with_the_nearest(store, tmp_path):
    assert_refused(store, "minary", tmp_path / "new" / "a-v0", UnknownNameError, "did you mean 'minari'")
    with pytest.raises(UnknownNameError, match="did you mean 'dp3'"):
        import_store(store, "dp4", tmp_path / "a.zarr")


@pytest.mark.parametrize("to", ["maniskill", "lerobot", "minari"])
def test_an_empty_store_and_what_is_none_are_refused(tmp_path, to):
    empty = make_store(tmp_path / "in" / "empty.zarr")
    out = tmp_path / "out" / "a-v0"
    assert_refused(empty, to, out, StoreError, "holds no episodes: collect some with 'manicm-ms collect toy/sample")
    assert_refused(tmp_path / "nowhere.zarr", to, out, StoreError, "no store at")
    assert_refused(tmp_path / "in", to, out, StoreError, "not a store of demonstrations")


def cut_in_half(store):
    chunk = store / "data" / "point_cloud" / "0.0.0"
    chunk.write_bytes(chunk.read_bytes()[: chunk.stat().st_size // 2])


def lose_a_chunk(store):
    (store / "data" / "point_cloud" / "0.0.0").unlink()


def spoil_a_header(store):
    (store / "data" / "action" / ".zarray").write_text("{")


def lose_an_array(store):
    shutil.rmtree(store / "data" / "action")


@pytest.mark.parametrize("damage", [cut_in_half, lose_a_chunk, spoil_a_header, lose_an_array])
def test_a_damaged_store_is_refused(store, tmp_path, damage):
    damage(store)
    assert_refused(store, "minari", tmp_path / "out" / "a-v0", StoreError, "damaged")


def test_what_stands_at_the_output_is_left_alone(store, tmp_path):
    out = tmp_path / "out" / "a-v0"
    out.mkdir(parents=True)
    (out / "notes.txt").write_text("mine")
    assert_refused(store, "minari", out, OutputExistsError, "choose another --out")
    (out.parent / "file-v0").write_text("mine")
    assert_refused(store, "minari", out.parent / "file-v0", OutputExistsError, "choose another --out")


def test_what_appears_at_the_output_meanwhile_is_left_alone(store, tmp_path):
    out = tmp_path / "a-v0"

    def slowly(job):
        job.folder.mkdir()
        out.write_text("another's")
        return Tally(episodes=1, frames=1)

    EXPORTERS.add("slow", slowly)
    try:
        assert_refused_late = pytest.raises(OutputExistsError, match="choose another --out")
        with assert_refused_late:
            convert(store, "slow", out)
    finally:
        del EXPORTERS._entries["slow"]
    assert out.read_text() == "another's"


def test_a_missing_library_is_named_with_its_remedy(store, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)  # how Python marks a module that cannot be imported
    out = tmp_path / "new" / "a-v0"
    assert_refused(store, "minari", out, MissingDependencyError, r"pip install 'manicm_ms\[minari\]'")
    monkeypatch.setenv("MANICM_MS_LEROBOT_PYTHON", str(tmp_path / "no-python"))
    assert_refused(store, "lerobot", out, MissingDependencyError, r"-m venv .*pip install lerobot")


def test_names_that_the_formats_cannot_hold(store, tmp_path):
    assert_refused(store, "minari", tmp_path / "out" / "demos", ConfigError, "slide-block-v0")
    assert_refused(store, "maniskill", tmp_path / "out", UnknownNameError, "toy/sample")


def test_the_command_line_takes_one_direction(store, tmp_path, capsys):
    def told(*words):
        with pytest.raises(SystemExit) as end:
            main(["convert", str(store), "--out", str(tmp_path / "out"), *words])
        assert end.value.code == USER_ERROR
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        return said

    assert "say one of --to {lerobot,maniskill,minari} and --from {dp3}" in told()
    assert "say one of" in told("--to", "minari", "--from", "dp3")
    assert "--num-points goes with --from" in told("--to", "minari", "--num-points", "3")
    assert "--cloud-scale goes with --from" in told("--to", "minari", "--cloud-scale", "1")
    assert "--action-scale goes with --from" in told("--to", "minari", "--action-scale", "1")
    assert "--task goes with --to" in told("--from", "dp3", "--task", "push")
    assert not (tmp_path / "out").exists()


@pytest.fixture
def small_disk():
    """A real file system of 1 MB."""
    folder = tempfile.mkdtemp()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        os.rmdir(folder)
        pytest.skip("mounting a small disk needs root")
    yield Path(folder)
    subprocess.run(["umount", folder], check=True)
    os.rmdir(folder)


def test_a_full_disk_leaves_nothing(tmp_path, small_disk, monkeypatch):
    with DemoStore.create(tmp_path / "big.zarr", SPEC, PROVENANCE, extras=("image", "depth")) as store:
        for seed in range(2):
            store.append(episode(seed, length=1500))
    out = small_disk / "a-v0"
    assert_refused(tmp_path / "big.zarr", "minari", out, NoSpaceError, "MB free")  # seen before anything is written
    # Other processes may fill the disk after the check.
    monkeypatch.setattr("manicm_ms.demos.convert.base.require_free_space", lambda folder, need: None)
    assert_refused(tmp_path / "big.zarr", "minari", out, NoSpaceError, "free some")


def test_the_seeds_of_an_import_do_not_pass_for_the_simulators(tmp_path):
    with DemoStore.create(tmp_path / "a.zarr", SPEC, PROVENANCE) as store:
        store.append(replace(episode(0), seed=-1))
    assert_refused(tmp_path / "a.zarr", "maniskill", tmp_path / "ms", StoreError, "does not know its episodes' seeds")


def test_import_says_that_a_store_is_ours(store, tmp_path):
    with pytest.raises(StoreError, match="is one of our own stores already"):
        import_store(store, "dp3", tmp_path / "a.zarr", env="ur3e/slide-block")
    assert not (tmp_path / "a.zarr").exists()
    assert np.all([p.name == "in" for p in tmp_path.iterdir()])


def test_what_is_far_outside_is_said_of_what_is_written(tmp_path):
    with DemoStore.create(tmp_path / "a.zarr", SPEC, PROVENANCE) as store:
        store.append(episode(0, agent_pos=1000 * episode(0).agent_pos))

    def keep(job):
        job.folder.mkdir()
        tally = Tally(notes=["mine"])
        for one in job.episodes():
            tally.add(one)
        return tally

    def drop(job):
        job.folder.mkdir()
        return Tally()

    for name, writer in (("keep", keep), ("drop", drop)):
        EXPORTERS.add(name, writer)
    try:
        notes = convert(tmp_path / "a.zarr", "keep", tmp_path / "out").notes
        with pytest.raises(ManicmError, match=r"no episode came out of the conversion: .*none was not written"):
            convert(tmp_path / "a.zarr", "drop", tmp_path / "none")
    finally:
        for name in ("keep", "drop"):
            del EXPORTERS._entries[name]
    assert notes[0] == "mine"
    assert "likely millimetres" in notes[1]
    assert not (tmp_path / "none").exists()
