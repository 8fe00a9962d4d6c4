"""Inspecting: the summary tells what is stored, and each kind of damage is named and gives status 1."""

import base64
import json
import re
import shutil
import struct
from dataclasses import replace

import numpy as np
import pytest
import zarr
from store_samples import PROVENANCE, SPEC, episode, make_store

from manicm_ms.demos.inspect import inspect, pack_clouds
from manicm_ms.demos.store import DemoStore
from manicm_ms.demos.summary import summarize
from manicm_ms.errors import StoreError

SEEDS = (3, 1, 4, 15, 9, 2)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = make_store(tmp_path_factory.mktemp("sound") / "a.zarr", SEEDS)
    with DemoStore.open(path, "a") as store:
        store.note(attempts=8)
    return path


def test_json_summary(sound, capsys):
    assert inspect(sound, as_json=True) == 0
    found = json.loads(capsys.readouterr().out)
    episodes = [episode(s) for s in SEEDS]
    assert found["env_id"] == SPEC.env_id
    assert (found["episodes"], found["attempts"], found["problems"]) == (6, 8, [])
    assert found["seeds"] == list(SEEDS)
    assert found["lengths"] == [len(e) for e in episodes]
    assert found["frames"] == sum(found["lengths"])
    assert found["success"] == [True] * 6
    assert (found["expert"], found["style"]) == ("sampler", "plain")
    assert found["provenance"] == PROVENANCE
    action = np.concatenate([e.action for e in episodes])
    assert found["ranges"]["action"]["b"] == pytest.approx([action[:, 1].min(), action[:, 1].max()])
    cloud = np.concatenate([e.point_cloud for e in episodes])
    assert found["ranges"]["point_cloud"]["z (m)"] == pytest.approx([cloud[..., 2].min(), cloud[..., 2].max()])


def test_printed_summary(sound, capsys):
    assert inspect(sound) == 0
    printed = capsys.readouterr().out
    for text in ("toy/sample", "6 kept of 8 tried", "sampler", "no problem found", "gripper (m)"):
        assert text in printed


def set_value(array, where, value):
    return lambda path: zarr.open(str(path), mode="r+")[array].__setitem__(where, value)


def resize(array, length):
    def damage(path):
        values = zarr.open(str(path), mode="r+")[array]
        values.resize((length, *values.shape[1:]))

    return damage


def resize_entries(path):
    zarr.open_group(str(path), mode="r+").create_array("data/state", data=np.zeros((9, 0), "f4"), overwrite=True)


def write(name, content):
    return lambda path: (path / name).write_bytes(content)


START_OF_2 = len(episode(SEEDS[0])) + len(episode(SEEDS[1]))
DAMAGES = {
    "nan": (
        set_value("data/point_cloud", (START_OF_2 + 3, 5, 1), np.nan),
        "NaN.*point_cloud.*episode 2 .seed 4.*frame 3",
    ),
    "infinity": (set_value("data/state", (0, 0), np.inf), "infinity in data/state: episode 0 .seed 3"),
    "empty cloud": (set_value("data/point_cloud", START_OF_2 + 1, 0.0), "empty cloud.*episode 2 .seed 4.*frame 1"),
    "ends shrink": (set_value("meta/episode_ends", 2, 1), "episode_ends does not grow: episode 2 ends at frame 1"),
    "ends equal": (set_value("meta/episode_ends", 1, len(episode(3))), "episode_ends does not grow: episode 1"),
    "few actions": (resize("data/action", 9), "data/action has 9 frames where meta/episode_ends gives"),
    "many clouds": (resize("data/point_cloud", 500), "data/point_cloud has 500 frames.*cut short"),
    "few seeds": (resize("meta/seed", 2), "meta/seed has 2 episodes where meta/episode_ends gives 6"),
    "double seed": (set_value("meta/seed", 1, 3), "seed 3 occurs 2 times"),
    "wrong length": (set_value("meta/length", 1, 400), "meta/length differs"),
    "action range": (set_value("data/action", (2, 0), -1.5), "data/action leaves .-1, 1.: it reaches 1.5"),
    "no array": (lambda path: shutil.rmtree(path / "data/state"), "data/state is missing"),
    "no ends": (lambda path: shutil.rmtree(path / "meta/episode_ends"), "meta/episode_ends is missing"),
    "torn header": (write("data/action/.zarray", b'{"shape": ['), "data/action cannot be read"),
    "torn chunk": (write("data/point_cloud/0.0.0", b"\x02\x01rubbish"), "data/point_cloud cannot be read"),
    "scalar ends": (write("meta/episode_ends/.zarray", b"{}"), "meta/episode_ends cannot be read"),
    "no attributes": (lambda path: (path / ".zattrs").unlink(), "attributes .* cannot be read"),
    "torn attributes": (write(".zattrs", b'{"format": "manicm'), "attributes .* cannot be read"),
    "list attributes": (write(".zattrs", b"[1, 2]"), "not written by"),
    "foreign attributes": (write(".zattrs", b"{}"), "not written by"),
    "float ends": (
        lambda path: zarr.open_group(str(path), mode="r+").create_array(
            "meta/episode_ends", data=np.array([1.0, np.inf]), overwrite=True
        ),
        "meta/episode_ends is float64 where whole numbers belong",
    ),
    "no entries": (resize_entries, r"data/state has frames of \(0,\) float32"),
    "lost file": (lambda path: (path / "data/action/1.0").unlink(), "1 chunk file is missing: data/action/1.0: lost"),
    "old attributes": (write(".zattrs", b'{"format": "manicm_ms demos 1", "env_spec": {}}'), "attributes .* damaged"),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_damage_is_named(sound, tmp_path, capsys, monkeypatch, kind):
    monkeypatch.setattr("manicm_ms.demos.inspect._MOST_EPISODES", 1)  # pictures are most of a page's work
    monkeypatch.setattr("manicm_ms.demos.inspect._STRIP_FRAMES", 2)
    damage, named = DAMAGES[kind]
    path = tmp_path / "a.zarr"
    shutil.copytree(sound, path)
    damage(path)
    assert inspect(path, as_json=True) == 1
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert any(re.search(named, p) for p in problems), problems
    assert inspect(path, html=tmp_path / "page.html") == 1
    assert "problem: " in capsys.readouterr().out
    page = (tmp_path / "page.html").read_text()
    assert '<ul class="problem">' in page


def test_many_damaged_episodes_are_counted(sound, tmp_path):
    path = tmp_path / "a.zarr"
    shutil.copytree(sound, path)
    set_value("data/point_cloud", slice(None), 0.0)(path)
    named = [p for p in summarize(path).problems if "empty cloud" in p]
    assert len(named) == 6  # five episodes by name and the number of the rest
    assert "1 further" in named[-1]


def test_empty_store_is_a_problem(tmp_path):
    assert summarize(make_store(tmp_path / "a.zarr")).problems == ["it holds no episode"]


def remarks(path, capsys):
    assert inspect(path, as_json=True) == 0
    return json.loads(capsys.readouterr().out)["remarks"]


def test_a_missing_file_of_a_store_that_may_have_left_it_out_is_a_remark(sound, tmp_path, capsys):
    path = tmp_path / "a.zarr"
    shutil.copytree(sound, path)
    attributes = json.loads((path / ".zattrs").read_text())
    assert attributes.pop("chunks") == "all written"
    (path / ".zattrs").write_text(json.dumps(attributes))
    assert remarks(path, capsys) == []
    (path / "data/action/1.0").unlink()
    (path / "data/state/0.0").unlink()
    [said] = remarks(path, capsys)
    assert said.startswith("2 chunk files are missing: data/state/0.0, data/action/1.0; zarr fills in zeros")
    with DemoStore.open(path) as store:
        assert store.missing_files == ("data/state/0.0", "data/action/1.0")


def test_values_far_outside_and_foreign_arrays_are_remarks(tmp_path, capsys):
    path = tmp_path / "a.zarr"
    with DemoStore.create(path, SPEC, PROVENANCE) as store:
        given = episode(0, length=25)
        given.agent_pos[:, 1] *= 1000
        given.point_cloud[0, 0, 0] = 65.5
        store.append(given)
        store.append(episode(1, length=40))
    zarr.open_group(str(path), mode="r+").create_array("data/extra", data=np.ones(3))
    said = remarks(path, capsys)
    for expected in (
        r"point_cloud reaches 65.5 m, 0.0962 % of it beyond 10 m: likely stray readings of a camera",
        r"y \(m\) of agent_pos reaches 9\d\d.*, over 10 m: likely millimetres",
        r"not read: data/extra",
        r"1 episode of 2 last up to 40 steps, toy/sample ends at 30: likely another control rate than its 20 Hz",
    ):
        assert any(re.search(expected, s) for s in said), (expected, said)
    assert inspect(path, html=tmp_path / "page.html") == 0
    assert "remark: not read: data/extra" in capsys.readouterr().out
    assert "<li>not read: data/extra</li>" in (tmp_path / "page.html").read_text()


@pytest.mark.filterwarnings("error")
def test_the_page_of_a_coloured_store_warns_of_nothing(tmp_path):
    spec = replace(SPEC, obs=replace(SPEC.obs, point_channels=6))
    with DemoStore.create(tmp_path / "a.zarr", spec, PROVENANCE) as store:
        clouds = np.random.default_rng(0).uniform(0, 1, (5, 16, 6)).astype("f4")
        store.append(episode(0, length=5, point_cloud=clouds))
    assert inspect(tmp_path / "a.zarr", html=tmp_path / "page.html") == 0


def test_no_store(tmp_path):
    with pytest.raises(StoreError, match="no store"):
        inspect(tmp_path / "none.zarr")
    with pytest.raises(StoreError, match="not a store"):
        inspect(tmp_path)


@pytest.mark.parametrize("channels", [3, 6])
def test_packed_clouds_unpack_to_a_tenth_of_a_millimetre(channels):
    clouds = np.random.default_rng(0).uniform(0, 1, (4, 20, channels)).astype("f4") * 0.8 + 0.1
    packed = pack_clouds(clouds)
    codes = np.frombuffer(base64.b64decode(packed["xyz"]), "<u2").reshape(4, 20, 3)
    np.testing.assert_allclose(
        np.array(packed["low"]) + np.array(packed["span"]) * codes / 65535, clouds[..., :3], atol=1e-4
    )
    assert (packed["rgb"] is None) == (channels == 3)
    if channels == 6:
        colors = np.frombuffer(base64.b64decode(packed["rgb"]), "u1").reshape(4, 20, 3)
        np.testing.assert_allclose(colors / 255, clouds[..., 3:], atol=0.5 / 255 + 1e-6)


def embedded(page):
    """The episodes that a page carries for its viewer."""
    return json.loads(re.search(r"const EPISODES = (\[.*\]);", page)[1])


@pytest.mark.parametrize("extras", [(), ("image",)])
def test_page_stands_alone_and_carries_the_clouds(tmp_path, extras):
    path = make_store(tmp_path / "a.zarr", range(8), extras=extras)
    assert inspect(path, html=tmp_path / "page.html") == 0
    page = (tmp_path / "page.html").read_text()
    assert not re.search(r"""(src|href)=["'](?!data:)|@import|https?://""", page)  # nothing is fetched
    episodes = embedded(page)
    assert len(episodes) == 6
    assert [e["label"].split(",")[0] for e in episodes][::5] == ["episode 0", "episode 7"]
    first = np.frombuffer(base64.b64decode(episodes[0]["xyz"]), "<u2").reshape(-1, 16, 3)
    decoded = np.array(episodes[0]["low"]) + np.array(episodes[0]["span"]) * first / 65535
    np.testing.assert_allclose(decoded, episode(0).point_cloud[episodes[0]["steps"]], atol=1e-4)
    pictures = [base64.b64decode(p) for p in re.findall(r"data:image/png;base64,([^\"]+)", page)]
    assert len(pictures) == 6
    for picture in pictures:
        assert picture[:8] == b"\x89PNG\r\n\x1a\n"
        width, height = struct.unpack(">II", picture[16:24])
        assert width > 4 * height  # a strip


def test_text_from_the_store_is_escaped(tmp_path):
    path = tmp_path / "a.zarr"
    with DemoStore.create(path, SPEC, PROVENANCE | {"expert": "<script>alert(1)</script>"}) as store:
        store.append(episode(0))
    inspect(path, html=tmp_path / "page.html")
    assert "<script>alert" not in (tmp_path / "page.html").read_text()
