"""The store against the zarr v2 format and DP3's reader, with kills at every file operation of an append."""

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numcodecs
import numpy as np
import pytest
import zarr
from store_samples import PROVENANCE, SPEC, episode, make_store, require_same

from manicm_ms.demos.layout import Episode
from manicm_ms.demos.store import DemoStore
from manicm_ms.demos.summary import summarize
from manicm_ms.errors import NoSpaceError, OutputExistsError, StoreError
from manicm_ms.paths import exclusive_lock

HERE = Path(__file__).parent
SEEDS = (3, 1, 4, 15, 9, 2)


def read_zarr_v2(folder):
    """Read an array as the zarr v2 specification defines it, with the codecs but without zarr."""
    header = json.loads((folder / ".zarray").read_text())
    assert header["zarr_format"] == 2
    assert (header["order"], header["filters"]) == ("C", None)
    assert header.get("dimension_separator", ".") == "."
    codec = header["compressor"] and numcodecs.get_codec(header["compressor"])
    shape, chunks, dtype = header["shape"], header["chunks"], np.dtype(header["dtype"])
    assert shape[1:] == chunks[1:]  # an episode's frames lie in whole rows
    rows = []
    for k in range(-(-shape[0] // chunks[0])):
        raw = (folder / ".".join([str(k)] + ["0"] * (len(shape) - 1))).read_bytes()
        rows.append(np.frombuffer(codec.decode(raw) if codec else raw, dtype).reshape(chunks))
    return np.concatenate(rows)[: shape[0]] if rows else np.zeros(shape, dtype)


class PublicReplayBuffer:
    """What diffusion_policy's ReplayBuffer asks of a store, which DP3 and ManiCM read their data through."""

    def __init__(self, path):
        self.root = zarr.open(str(path), mode="r")
        assert "data" in self.root
        assert "meta" in self.root
        assert "episode_ends" in self.root["meta"]
        for value in (self.root["data"][k] for k in self.root["data"]):
            assert value.shape[0] == self.root["meta"]["episode_ends"][-1]

    def copy(self, keys):
        return {k: self.root["data"][k][:] for k in keys}, self.root["meta"]["episode_ends"][:]


def test_round_trip(tmp_path):
    make_store(tmp_path / "a.zarr", SEEDS)
    with DemoStore.open(tmp_path / "a.zarr") as store:
        assert (store.spec, store.provenance) == (SPEC, PROVENANCE)
        assert store.seeds.tolist() == list(SEEDS)
        for k, seed in enumerate(SEEDS):
            require_same(store.episode(k), episode(seed))
        require_same(store.episode(-1), episode(SEEDS[-1]))
        lengths = [len(episode(s)) for s in SEEDS]
        assert store.lengths.tolist() == lengths
        assert store.episode_ends.tolist() == np.cumsum(lengths).tolist()
        for name, array in [("point_cloud", store.point_cloud), ("agent_pos", store.state), ("action", store.action)]:
            expected = np.concatenate([getattr(episode(s), name) for s in SEEDS])
            np.testing.assert_array_equal(array, expected, strict=True)
        with pytest.raises(IndexError):
            store.episode(len(SEEDS))


def test_layout_is_zarr_v2_as_public_code_reads_it(tmp_path):
    path = make_store(tmp_path / "a.zarr", SEEDS, extras=("image", "depth"))
    assert json.loads((path / ".zgroup").read_text()) == {"zarr_format": 2}
    data = {p.parent.name: read_zarr_v2(p.parent) for p in path.glob("data/*/.zarray")}
    meta = {p.parent.name: read_zarr_v2(p.parent) for p in path.glob("meta/*/.zarray")}
    episodes = [episode(s) for s in SEEDS]
    disk = {"point_cloud": "point_cloud", "agent_pos": "state", "action": "action", "image": "img", "depth": "depth"}
    assert set(data) == set(disk.values())
    for field, name in disk.items():
        expected = np.concatenate([getattr(e, field) for e in episodes])
        np.testing.assert_array_equal(data[name], expected, strict=True)
    ends = np.cumsum([len(e) for e in episodes])
    np.testing.assert_array_equal(meta["episode_ends"], ends, strict=True)
    assert meta["seed"].tolist() == list(SEEDS)
    assert meta["success"].tolist() == [True] * len(SEEDS)
    assert meta["length"].tolist() == [len(e) for e in episodes]
    copied, copied_ends = PublicReplayBuffer(path).copy(["state", "action", "point_cloud", "img"])
    np.testing.assert_array_equal(copied_ends, ends)
    np.testing.assert_array_equal(copied["img"], data["img"])


def test_episodes_cross_all_chunk_borders(tmp_path, monkeypatch):
    monkeypatch.setattr("manicm_ms.demos.layout._CHUNK_EPISODES", 4)
    path, seeds = tmp_path / "a.zarr", range(13)  # data chunks hold 30 frames
    make_store(path, seeds)
    ends = np.cumsum([len(episode(s)) for s in seeds])
    np.testing.assert_array_equal(read_zarr_v2(path / "meta/episode_ends"), ends, strict=True)
    with DemoStore.open(path) as store:
        for k in seeds:
            require_same(store.episode(k), episode(k))


KILLED_APPEND = """
import os, shutil, signal, sys
from pathlib import Path
from store_samples import episode, make_store, require_same
from manicm_ms.demos.store import DemoStore
base, work = Path(sys.argv[1]), Path(sys.argv[2])

def changes_files(event, args):  # between two such moments, a kill finds the same files
    if event == "open":
        return args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    return event in {"os.rename", "os.remove", "os.mkdir", "os.truncate"}

def append_until_killed(moment):
    count = 0
    def hook(event, args):
        nonlocal count
        if changes_files(event, args):
            if count == moment:
                os.kill(os.getpid(), signal.SIGKILL)
            count += 1
    store = DemoStore.open(work, "a")
    sys.addaudithook(hook)
    store.append(episode(100))

def in_child(call, *args):
    # zarr's threads start in the child, so that a fork never copies them half way.
    pid = os.fork()
    if pid == 0:
        try:
            call(*args)
            os._exit(0)
        except BaseException:
            import traceback
            traceback.print_exc()
            os._exit(1)
    return os.waitpid(pid, 0)[1]

def check(seeds):
    with DemoStore.open(work) as store:
        found = store.seeds.tolist()
        assert found in (seeds, [*seeds, 100]), found
    with DemoStore.open(work, "a") as store:
        assert store.seeds.tolist() == found
        if found == seeds:
            store.append(episode(100))
        store.append(episode(101))
        for k, seed in enumerate([*seeds, 100, 101]):
            require_same(store.episode(k), episode(seed))
    leftovers = [p for p in work.rglob("*") if p.name.endswith((".tmp", ".partial"))]
    assert not leftovers, leftovers

moment = 0
while True:
    shutil.rmtree(work, ignore_errors=True)
    shutil.copytree(base, work)
    status = in_child(append_until_killed, moment)
    assert in_child(check, [3, 1]) == 0, f"broken by a kill at file operation {moment}"
    if status == 0:
        break
    assert os.WTERMSIG(status) == 9
    moment += 1
print(moment)
"""


def test_a_kill_at_any_file_operation_leaves_what_was_committed(tmp_path):
    base = make_store(tmp_path / "base.zarr", SEEDS[:2])
    done = subprocess.run(
        [sys.executable, "-c", KILLED_APPEND, str(base), str(tmp_path / "work.zarr")],
        env=os.environ | {"PYTHONPATH": str(HERE)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(done.stdout) > 20  # each of so many moments was tried


@pytest.mark.parametrize("extras", [(), ("image", "voxel_grid")])
def test_an_interrupted_append_leaves_no_trace(tmp_path, extras):
    whole = make_store(tmp_path / "whole.zarr", (*SEEDS, 7), extras)
    broken = make_store(tmp_path / "broken.zarr", SEEDS, extras)
    with DemoStore.open(broken, "a") as store:
        store._arrays.write({f: getattr(episode(100), f) for f in store.fields}, episode(100), np.zeros(0))
    with DemoStore.open(broken) as store:
        assert len(store) == len(SEEDS)
        assert len(store.point_cloud) == store.num_frames
    with DemoStore.open(broken, "a") as store:
        PublicReplayBuffer(broken)
        store.append(episode(7))
    chunks = {p.relative_to(whole): p.read_bytes() for p in whole.glob("*/*/*") if p.is_file()}
    assert chunks == {p.relative_to(broken): p.read_bytes() for p in broken.glob("*/*/*") if p.is_file()}


def test_reader_sees_what_a_writer_commits(tmp_path):
    path = make_store(tmp_path / "a.zarr", SEEDS[:1])
    with DemoStore.open(path) as reader, DemoStore.open(path, "a") as writer:
        writer.append(episode(8))
        assert len(reader) == 2
        require_same(reader.episode(1), episode(8))
        with pytest.raises(StoreError, match="open for reading"):
            reader.append(episode(9))


def test_second_writer(tmp_path):
    path = make_store(tmp_path / "a.zarr", SEEDS[:1])
    with (
        DemoStore.open(path, "a"),
        pytest.raises(StoreError, match=f"being written by process {os.getpid()}"),
    ):
        DemoStore.open(path, "a")
    DemoStore.open(path, "a").close()


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"agent_pos": np.zeros((5, 3))}, r"agent_pos.*\(5, 3\).*\(5, 4\)"),
        ({"point_cloud": np.zeros((5, 16, 6))}, r"point_cloud.*\(5, 16, 3\)"),
        ({"point_cloud": np.full((5, 16, 3), np.nan)}, "point_cloud.*seed 5.*NaN"),
        ({"action": np.full((5, 2), np.inf)}, "action.*infinity"),
        ({"agent_pos": np.zeros((4, 4))}, "agent_pos"),
        ({"depth": None}, "no depth"),
    ],
)
def test_unfit_episode_is_refused(tmp_path, changes, named):
    path = make_store(tmp_path / "a.zarr", SEEDS, extras=("depth",))
    with DemoStore.open(path, "a") as store:
        with pytest.raises(StoreError, match=named):
            store.append(episode(5, length=5, **changes))
        with pytest.raises(StoreError, match="shape"):
            store.append(episode(5, length=0))
        assert store.seeds.tolist() == list(SEEDS)


def test_bad_paths(tmp_path):
    with pytest.raises(StoreError, match="no store"):
        DemoStore.open(tmp_path / "none.zarr")
    with pytest.raises(StoreError, match="not a store"):
        DemoStore.open(tmp_path)
    path = make_store(tmp_path / "a.zarr", SEEDS)
    with pytest.raises(OutputExistsError, match="exists"):
        DemoStore.create(path, SPEC, PROVENANCE)
    with DemoStore.open(path) as store:
        assert len(store) == len(SEEDS)
    zarr.create_group(str(tmp_path / "other.zarr"), zarr_format=2)
    with pytest.raises(StoreError, match="format None"):
        DemoStore.open(tmp_path / "other.zarr")
    assert {p.name for p in tmp_path.iterdir()} == {"a.zarr", "other.zarr"}


@pytest.mark.parametrize(
    "damage",
    [
        lambda p: (p / ".zattrs").write_text("{"),
        lambda p: (p / "meta/episode_ends/.zarray").write_text("{}"),
        lambda p: (p / "data/state/.zarray").unlink(),
        lambda p: zarr.open(str(p), mode="r+")["meta/episode_ends"].__setitem__(1, 0),
        lambda p: zarr.open(str(p), mode="r+")["data/action"].resize((3, 2)),
        lambda p: zarr.open(str(p), mode="r+")["meta/seed"].resize((3,)),
    ],
)
@pytest.mark.parametrize("mode", ["r", "a"])
def test_damaged_store_is_refused_and_left_alone(tmp_path, damage, mode):
    path = make_store(tmp_path / "a.zarr", SEEDS)
    damage(path)
    before = {p: p.read_bytes() for p in path.glob("*/*/*") if p.is_file()}
    with pytest.raises(StoreError, match=r"damaged|lacks|not a store"):
        DemoStore.open(path, mode)
    assert {p: p.read_bytes() for p in path.glob("*/*/*") if p.is_file()} == before


def test_damaged_chunk_is_named(tmp_path):
    path = make_store(tmp_path / "a.zarr", SEEDS)
    chunk = path / "data/point_cloud/0.0.0"
    chunk.write_bytes(chunk.read_bytes()[:100])
    with DemoStore.open(path) as store, pytest.raises(StoreError, match="data/point_cloud"):
        store.episode(0)


def idle(seed, length):
    """An episode of which zarr, left alone, would write nearly no file."""
    return episode(
        seed, length, agent_pos=np.zeros((length, 4), "f4"), action=np.zeros((length, 2), "f4"), success=False
    )


def test_every_chunk_has_a_file_and_one_that_is_lost_is_missed(tmp_path):
    path = make_store(tmp_path / "a.zarr")
    with DemoStore.open(path, "a") as store:  # chunks hold 30 frames
        for length in (20, 10, 30, 5):
            store.append(idle(0, length))
    assert {p.name for p in (path / "data/action").glob("[0-9]*")} == {"0.0", "1.0", "2.0"}
    with DemoStore.open(path, "a") as store:  # a cut leaves the files of what is committed
        store._arrays.write({f: getattr(idle(1, 60), f) for f in store.fields}, idle(1, 60), np.zeros(0))
    with DemoStore.open(path, "a") as store:
        assert store.missing_files == ()
        assert not store.action.any()
    for name in ("data/action/1.0", "data/point_cloud/0.0.0", "meta/success/0", "meta/seed/0"):
        content = (path / name).read_bytes()
        (path / name).unlink()
        for mode in ("r", "a"):
            with pytest.raises(StoreError, match=f"damaged: 1 chunk file is missing: {name}"):
                DemoStore.open(path, mode)
        (path / name).write_bytes(content)
    DemoStore.open(path).close()


def test_lost_pictures_can_be_given_up(tmp_path):
    path = make_store(tmp_path / "a.zarr", SEEDS[:2], extras=("image", "depth"))
    for name in ("data/img/0.0.0.0", "data/depth/0.0.0"):
        (path / name).unlink()
    with pytest.raises(
        StoreError, match=r"2 chunk files are missing: .*bring them back, or remove data/depth, data/img, w"
    ):
        DemoStore.open(path)
    for name in ("img", "depth"):
        shutil.rmtree(path / "data" / name)
    with DemoStore.open(path) as store:
        require_same(store.episode(1), episode(SEEDS[1]))
    assert summarize(path).problems == []


def test_a_store_of_earlier_versions_is_extended(tmp_path):
    path = make_store(tmp_path / "a.zarr")
    with DemoStore.open(path, "a") as store:
        store.append(idle(0, 30))  # one chunk
    attributes = json.loads((path / ".zattrs").read_text())
    (path / ".zattrs").write_text(json.dumps({k: v for k, v in attributes.items() if k != "chunks"}))
    left_out = ("data/action/0.0", "data/state/0.0", "meta/seed/0")
    for name in left_out:
        (path / name).unlink()
    with DemoStore.open(path, "a") as store:
        assert set(store.missing_files) == set(left_out)
        store.append(episode(7))
    with DemoStore.open(path) as store:
        require_same(store.episode(0), idle(0, 30))
        require_same(store.episode(1), episode(7))
        assert set(store.missing_files) == {"data/action/0.0", "data/state/0.0"}


@pytest.mark.filterwarnings("error")
def test_zarr_finds_nothing_strange_in_a_store(tmp_path):
    path = make_store(tmp_path / "a.zarr", SEEDS[:1])
    with DemoStore.open(path, "a"):
        assert {n for n, _ in zarr.open_group(str(path), mode="r").members(max_depth=None)} > {
            "data/state",
            "meta/seed",
        }


def test_the_lock_file_of_earlier_versions_is_heeded_and_removed(tmp_path):
    path = make_store(tmp_path / "a.zarr", SEEDS[:1])
    with exclusive_lock(path / ".lock", StoreError), pytest.raises(StoreError, match="being written by process"):
        DemoStore.open(path, "a")
    DemoStore.open(path, "a").close()
    assert not (path / ".lock").exists()


def big_episode(length):
    rng = np.random.default_rng(0)
    cloud, pos = rng.uniform(size=(length, 16, 3)), rng.uniform(size=(length, 4))
    return Episode(cloud, pos, rng.uniform(-1, 1, (length, 2)), 1, True)


def test_file_size_limit_is_no_space_and_harms_nothing(tmp_path):
    path = make_store(tmp_path / "a.zarr", SEEDS)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with DemoStore.open(path, "a") as store:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
        try:
            with pytest.raises(NoSpaceError, match="free some space"):
                store.append(big_episode(300))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert store.seeds.tolist() == list(SEEDS)
        store.append(episode(7))
    PublicReplayBuffer(path)
    with DemoStore.open(path) as store:
        for k, seed in enumerate((*SEEDS, 7)):
            require_same(store.episode(k), episode(seed))


@pytest.fixture
def small_disk():
    """A real file system of 48 MB."""
    folder = tempfile.mkdtemp()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=48m", "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        os.rmdir(folder)
        pytest.skip("mounting a small disk needs root")
    yield Path(folder)
    subprocess.run(["umount", folder], check=True)
    os.rmdir(folder)


def test_full_disk_is_refused_and_harms_nothing(small_disk, monkeypatch):
    path = make_store(small_disk / "a.zarr", SEEDS)
    with DemoStore.open(path, "a") as store:
        with pytest.raises(NoSpaceError, match="MB free"):  # seen before anything is written
            store.append(big_episode(50_000))
        (small_disk / "filler").write_bytes(b"x" * (44 << 20))
        # Other processes may fill the disk after the check: the writing itself must fail well too.
        monkeypatch.setattr("manicm_ms.demos.store.require_free_space", lambda folder, need: None)
        with pytest.raises(NoSpaceError, match="free some space"):
            store.append(big_episode(40_000))
        (small_disk / "filler").unlink()
        assert store.seeds.tolist() == list(SEEDS)
        store.append(episode(7))
    with DemoStore.open(path) as store:
        for k, seed in enumerate((*SEEDS, 7)):
            require_same(store.episode(k), episode(seed))
