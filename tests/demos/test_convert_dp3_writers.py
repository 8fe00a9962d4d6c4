"""Stores of DP3's layout in every coding of zarr 2 and 3 are read to the bit, and what does not fit is named."""

import json
import pickle
import re
import shutil
import warnings
from pathlib import Path

import numcodecs
import numpy as np
import pytest
import zarr
import zarr.codecs
from dp3_stores import ACTION_DIM, DIM, FRAMES, LENGTHS, POINTS, contents, rows, write_dp3

from manicm_ms.cli import USER_ERROR, main
from manicm_ms.demos.convert import import_store
from manicm_ms.demos.convert.dp3 import Dp3Options, Reading
from manicm_ms.demos.convert.raw_store import RawStore
from manicm_ms.demos.store import DemoStore
from manicm_ms.demos.summary import summarize
from manicm_ms.errors import ConfigError, SpecMismatchError, StoreError

CODINGS = {
    "2 blosc zstd": {"zarr_format": 2, "compressors": numcodecs.Blosc("zstd", clevel=3, shuffle=1)},
    "2 blosc lz4": {"zarr_format": 2, "compressors": numcodecs.Blosc("lz4")},
    "2 zstd": {"zarr_format": 2, "compressors": numcodecs.Zstd()},
    "2 gzip": {"zarr_format": 2, "compressors": numcodecs.GZip()},
    "2 none": {"zarr_format": 2, "compressors": None},
    "2 nested": {"zarr_format": 2, "chunk_key_encoding": {"name": "v2", "separator": "/"}},
    "2 columns first": {"zarr_format": 2, "order": "F"},
    "2 consolidated": {"zarr_format": 2, "consolidated": True},
    "2 one chunk": {"zarr_format": 2, "chunk_frames": 1000},
    "3 blosc": {"zarr_format": 3, "compressors": zarr.codecs.BloscCodec(cname="zstd")},
    "3 zstd": {"zarr_format": 3, "compressors": zarr.codecs.ZstdCodec()},
    "3 gzip": {"zarr_format": 3, "compressors": zarr.codecs.GzipCodec()},
    "3 none": {"zarr_format": 3, "compressors": None},
    "3 keys of 2": {"zarr_format": 3, "chunk_key_encoding": {"name": "v2", "separator": "."}},
    "3 consolidated": {"zarr_format": 3, "consolidated": True},
}


def read(source, **options):
    """Read a store without writing ours; return (notes, arrays of all episodes, spec)."""
    reading = Reading.of(source, Dp3Options(**options))
    episodes = list(reading.episodes())
    assert [len(e) for e in episodes] == list(LENGTHS)
    names = ("point_cloud", "agent_pos", "action", *reading.pictures)
    arrays = {name: np.concatenate([getattr(e, name) for e in episodes]) for name in names}
    return " | ".join(reading.raw.notes), arrays, reading.spec


def refuse(source, error, match, **options):
    with pytest.raises(error, match=match):
        Reading.of(source, Dp3Options(**options))


@pytest.mark.filterwarnings("ignore:Consolidated metadata")
@pytest.mark.parametrize("coding", CODINGS)
def test_every_coding_is_read_to_the_bit(tmp_path, coding):
    given = contents(channels=6)
    source = write_dp3(tmp_path / "a.zarr", given=given, **CODINGS[coding])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        notes, arrays, _ = read(source, colors=True)
    np.testing.assert_array_equal(arrays["agent_pos"], given["data/state"], strict=True)
    np.testing.assert_array_equal(arrays["action"], given["data/action"], strict=True)
    for k in range(FRAMES):
        np.testing.assert_array_equal(rows(arrays["point_cloud"][k]), rows(given["data/point_cloud"][k]), strict=True)
    assert "missing" not in notes
    assert "left out" not in notes


def test_shards_are_read(tmp_path):
    source = write_dp3(tmp_path / "a.zarr", zarr_format=3)
    state = contents()["data/state"]
    group = zarr.open_group(str(source), mode="r+")
    array = group.create_array(
        "data/state", shape=state.shape, chunks=(1, DIM), shards=(4, DIM), dtype="f4", overwrite=True
    )
    array[:] = state
    _, arrays, _ = read(source)
    np.testing.assert_array_equal(arrays["agent_pos"], state)
    (source / "data/state/c/1/0").unlink()
    notes, arrays, _ = read(source)
    assert "1 chunk file is missing: data/state/c/1/0" in notes
    assert not arrays["agent_pos"][4:8].any()


@pytest.mark.parametrize("dtype", ["f8", ">f4", "f2"])
def test_other_floats_become_float32(tmp_path, dtype):
    given = contents(dtype=dtype)
    _, arrays, _ = read(write_dp3(tmp_path / "a.zarr", given=given))
    np.testing.assert_array_equal(arrays["agent_pos"], given["data/state"].astype("f4"))
    np.testing.assert_array_equal(arrays["action"], given["data/action"].astype("f4"))


@pytest.mark.parametrize("ends", [np.cumsum(LENGTHS).astype(t) for t in ("f8", "u4", "i4", "f4")])
def test_ends_of_any_number_type(tmp_path, ends):
    read(write_dp3(tmp_path / "a.zarr", {"meta/episode_ends": ends}))


@pytest.mark.parametrize("zarr_format", [2, 3])
def test_idle_and_constant_channels_that_zarr_writes_no_file_for(tmp_path, zarr_format):
    given = contents() | {"data/action": np.zeros((FRAMES, ACTION_DIM), "f4")}
    given["data/state"][:, 1] = 0.25
    given["data/state"][:, 2] = 0.25 + 1e-7 * np.arange(FRAMES)
    source = write_dp3(tmp_path / "a.zarr", given=given, zarr_format=zarr_format)
    notes, arrays, _ = read(source)
    np.testing.assert_array_equal(arrays["action"], given["data/action"])
    np.testing.assert_array_equal(arrays["agent_pos"], given["data/state"])
    first = "data/action/0.0" if zarr_format == 2 else "data/action/c/0/0"
    assert f"3 chunk files are missing: {first}, " in notes


def pictures(dtype, low=0, high=256):
    return np.random.default_rng(0).integers(low, high, (FRAMES, 4, 5, 3)).astype(dtype)


def test_lost_pictures_are_counted_and_named(tmp_path):
    source = write_dp3(tmp_path / "a.zarr", {"data/img": pictures("u1")})
    (source / "data/img/1.0.0.0").unlink()
    notes, arrays, _ = read(source)
    assert "1 chunk file is missing: data/img/1.0.0.0" in notes
    assert not arrays["image"][5:10].any()
    (source / "data/point_cloud/0.0.0").unlink()
    with pytest.raises(StoreError, match=r"empty cloud.* in 5 of 12 .*frame 0 of episode 0; 2 chunk files are miss"):
        import_store(source, "dp3", tmp_path / "no.zarr")


@pytest.mark.parametrize("dtype", ["u2", "i8", "f4", "f8"])
def test_pictures_of_whole_bytes_are_kept_whatever_their_type(tmp_path, dtype):
    given = pictures(dtype)
    notes, arrays, _ = read(write_dp3(tmp_path / "a.zarr", {"data/img": given}))
    np.testing.assert_array_equal(arrays["image"], given)
    assert f"data/img is {np.dtype(dtype).name} of whole numbers" in notes


@pytest.mark.parametrize("given", [pictures("u2", 0, 301), pictures("f4") / np.float32(255), pictures("i4", -1, 3)])
def test_other_pictures_are_left_out_and_not_wrapped(tmp_path, given):
    notes, arrays, _ = read(write_dp3(tmp_path / "a.zarr", {"data/img": given}))
    assert "image" not in arrays
    assert f"left out: data/img, {given.dtype} of {given.min():g} to {given.max():g}" in notes


def colored(rgb):
    clouds = contents(channels=6)["data/point_cloud"].astype("f8")
    clouds[..., 3:] = rgb
    return clouds


UNIT = np.random.default_rng(3).uniform(0.2, 0.8, (FRAMES, POINTS, 3))
BYTES = np.random.default_rng(4).integers(0, 256, (FRAMES, POINTS, 3)).astype("f8")
ONE_OVER, DARK_EPISODE, BLENDED = UNIT.copy(), BYTES.copy(), BYTES.copy()
ONE_OVER[4, 3, 0] = 1.000001
DARK_EPISODE[:3] = 1.0  # whose own greatest value would be taken for that of fractions
BLENDED[:] += 0.25
BLENDED[BLENDED > 255] = 255


@pytest.mark.parametrize(
    ("rgb", "divisor", "said"),
    [
        (UNIT, 1, "are read as 0 to 1"),
        (ONE_OVER, 1, "are read as 0 to 1, what is above 1, up to 1.000001, cut to 1"),
        (BYTES, 255, r"of [01] to 255 are read as 0 to 255: divided by 255"),
        (DARK_EPISODE, 255, "divided by 255"),
        (BLENDED, 255, "divided by 255"),
        (np.zeros_like(UNIT), 1, "of 0 to 0 are read as 0 to 1"),
    ],
)
def test_colours_are_decided_once_a_store(tmp_path, rgb, divisor, said):
    clouds = colored(rgb)
    source = write_dp3(tmp_path / "a.zarr", {"data/point_cloud": clouds})
    notes, arrays, _ = read(source, colors=True)
    expected = np.concatenate([clouds[..., :3], (rgb / divisor).clip(0, 1)], axis=-1).astype("f4")
    for k in range(FRAMES):
        np.testing.assert_array_equal(rows(arrays["point_cloud"][k]), rows(expected[k]))
    assert re.search(said, notes), notes


@pytest.mark.parametrize("rgb", [UNIT - 0.5, BYTES * 257])
def test_colours_of_another_range_are_refused(tmp_path, rgb):
    source = write_dp3(tmp_path / "a.zarr", {"data/point_cloud": colored(rgb)})
    with pytest.raises(SpecMismatchError, match="where 0 to 1 and 0 to 255 can be read: leave out --colors"):
        import_store(source, "dp3", tmp_path / "ours.zarr", colors=True)
    notes, arrays, _ = read(source)
    assert arrays["point_cloud"].shape[-1] == 3
    assert "left out: rgb of the points; --colors keeps it" in notes


def test_clouds_in_millimetres(tmp_path):
    given = contents()["data/point_cloud"]
    source = write_dp3(tmp_path / "a.zarr", {"data/point_cloud": given * np.float32(1000)})
    with pytest.raises(SpecMismatchError, match=r"reaches [\d.]+ m, 100 % .* likely millimetres.*--cloud-scale 0.001"):
        import_store(source, "dp3", tmp_path / "no.zarr")
    _, arrays, _ = read(source, cloud_scale=0.001)
    np.testing.assert_allclose(rows(arrays["point_cloud"][0]), rows(given[0]), rtol=1e-6)
    _, arrays, _ = read(source, cloud_scale=1.0)
    np.testing.assert_array_equal(rows(arrays["point_cloud"][0]), rows(given[0] * np.float32(1000)))


def test_depth_in_a_cameras_units(tmp_path):
    raw = np.random.default_rng(0).integers(2000, 4000, (FRAMES, 4, 5))
    for dtype, said in (("f8", r"reaches 3\d\d\d m, 100 % of it beyond 20 m"), ("u2", "uint16, a camera's units")):
        source = write_dp3(tmp_path / f"{dtype}.zarr", {"data/depth": raw.astype(dtype)})
        notes, arrays, _ = read(source)
        assert "depth" not in arrays
        assert re.search(f"left out: data/depth, .*{said}.*--depth-scale", notes), notes
        notes, arrays, spec = read(source, depth_scale=0.00025)
        np.testing.assert_array_equal(arrays["depth"], (raw * 0.00025).astype("f4"))
        assert spec.obs.image_size == (4, 5)
    refuse(write_dp3(tmp_path / "none.zarr"), ConfigError, "holds no depth that can be kept", depth_scale=0.001)


def test_actions_in_radians(tmp_path):
    joints = contents()["data/action"] * np.float32(2.8)
    joints[0] = 2.8
    source = write_dp3(tmp_path / "a.zarr", {"data/action": joints})
    with pytest.raises(
        SpecMismatchError, match=r"reaches 2.8 where .*\[-1, 1\]: give --action-scale 2.81, or 3 numbers"
    ):
        import_store(source, "dp3", tmp_path / "no.zarr")
    with pytest.raises(SpecMismatchError, match=r"divided by --action-scale, an action still reaches 1.4 "):
        import_store(source, "dp3", tmp_path / "no.zarr", action_scale=(2.0,))
    for wrong, match in (((2.81, 3.0), "has 2 numbers where actions have 3"), ((-1.0,), "must be positive")):
        with pytest.raises(ConfigError, match=match):
            import_store(source, "dp3", tmp_path / "no.zarr", action_scale=wrong)
    notes, arrays, _ = read(source, action_scale=(2.81,))
    np.testing.assert_array_equal(arrays["action"], (joints.astype("f8") / 2.81).astype("f4"))
    assert "actions are divided by 2.81" in notes
    _, arrays, _ = read(source, action_scale=(2.81, 3.0, 4.0))
    np.testing.assert_array_equal(arrays["action"], (joints / np.array([2.81, 3, 4])).astype("f4"))


def test_all_that_is_left_out_is_named(tmp_path):
    clouds = np.pad(contents()["data/point_cloud"], ((0, 2), (0, 3), (0, 0)))
    changes = {
        "data/point_cloud": clouds, "data/full_state": np.zeros((FRAMES, 33)), "data/stage": np.zeros(FRAMES, "i8"),
        "meta/task": np.zeros(3, "u1"), "data/img": np.zeros((FRAMES, 3, 4, 5), "u1"),
    }  # fmt: skip
    notes, _, _ = read(write_dp3(tmp_path / "a.zarr", changes))
    for said in (
        "data/full_state (12, 33) <f8, data/stage (12,) <i8, meta/task (3,) |u1",
        "left out: data/img, which is (12, 3, 4, 5) uint8 where (F, H, W, 3) numbers are read",
        "left out: 2 frames behind the last episode",
        "36 of 132 points are at exactly (0, 0, 0), as padding is: dropped",
    ):
        assert said in notes


def test_a_single_episode_of_one_frame(tmp_path):
    given = {name: values[:1] for name, values in contents().items()} | {"meta/episode_ends": np.array([1])}
    done = import_store(write_dp3(tmp_path / "a.zarr", given=given), "dp3", tmp_path / "ours.zarr")
    assert (done.episodes, done.frames) == (1, 1)


def test_what_is_read_is_what_our_store_holds(tmp_path, capsys):
    clouds = np.random.default_rng(0).uniform(0.1, 0.4, (FRAMES, 40, 3)).astype("f4")
    clouds[2, 3, 2] = 65.535
    changes = {
        "data/point_cloud": clouds, "data/action": np.full((FRAMES, ACTION_DIM), 1.5, "f8"),
        "data/img": pictures("f4"), "data/depth": np.full((FRAMES, 4, 5), 700, "u2"),
    }  # fmt: skip
    source, out = write_dp3(tmp_path / "a.zarr", changes), tmp_path / "ours.zarr"
    options = ["--action-scale", "2", "3", "4", "--depth-scale", "0.001", "--control-hz", "20"]
    with pytest.raises(SystemExit, match=r"^0$"):
        main(["convert", str(source), "--from", "dp3", "--out", str(out), *options])
    said = " ".join(capsys.readouterr().out.split())
    assert "3 episodes, 12 frames" in said
    assert "action never changes in 12 frames: an idle robot, or lost data" in said
    assert "point_cloud reaches 65.54 m, 0.208 % of it beyond 10 m: likely stray readings of a camera" in said
    notes, arrays, spec = read(source, action_scale=(2.0, 3.0, 4.0), depth_scale=0.001, control_hz=20.0)
    with DemoStore.open(out) as store:
        assert store.spec == spec
        assert store.provenance["scales"] == {"cloud": None, "depth": 0.001, "action": [2.0, 3.0, 4.0]}
        assert " | ".join(store.provenance["notes"]) == notes
        assert set(store.fields) == set(arrays)
        for name, values in arrays.items():
            np.testing.assert_array_equal(store.frames(name), values, strict=True)


@pytest.mark.parametrize("ends", [[3.5, 12], [[3], [12]], [3, 3, 12], [np.nan, 12], [3, np.inf]])
def test_ends_that_are_none_are_blamed_themselves(tmp_path, ends):
    source = write_dp3(tmp_path / "a.zarr", {"meta/episode_ends": np.array(ends)})
    refuse(source, StoreError, "meta/episode_ends (is .* where whole numbers on one axis belong|does not grow)")


def test_a_store_as_zarr_2_itself_writes_it(tmp_path):
    """By the specification of format 2, without zarr: a null fill value, no attributes, a padded last chunk."""
    given = contents()
    codec = numcodecs.Blosc("zstd", clevel=3, shuffle=1)
    for name, values in given.items():
        folder = tmp_path / "a.zarr" / name
        folder.mkdir(parents=True)
        header = {
            "zarr_format": 2, "shape": list(values.shape), "chunks": [7, *values.shape[1:]], "order": "C",
            "dtype": values.dtype.str, "compressor": codec.get_config(), "fill_value": None, "filters": None,
        }  # fmt: skip
        (folder / ".zarray").write_text(json.dumps(header))
        for start in range(0, len(values), 7):
            chunk = np.zeros((7, *values.shape[1:]), values.dtype)
            chunk[: len(values[start : start + 7])] = values[start : start + 7]
            key = ".".join([str(start // 7)] + ["0"] * (values.ndim - 1))
            (folder / key).write_bytes(codec.encode(chunk))
    (tmp_path / "a.zarr/.zgroup").write_text('{"zarr_format": 2}')
    notes, arrays, _ = read(tmp_path / "a.zarr")
    np.testing.assert_array_equal(arrays["agent_pos"], given["data/state"], strict=True)
    np.testing.assert_array_equal(arrays["action"], given["data/action"], strict=True)
    assert notes == ""


def test_values_that_are_not_finite_are_placed(tmp_path):
    for name in ("data/state", "data/action", "data/point_cloud"):
        values = contents()[name]
        values[4, 0] = np.nan
        with pytest.raises(StoreError, match=f"{name} holds NaN or infinity, first in frame 1 of episode 1"):
            import_store(write_dp3(tmp_path / "a.zarr", {name: values}), "dp3", tmp_path / "ours.zarr")
    huge = contents(dtype="f8")["data/state"]
    huge[0, 0] = 1e300
    with pytest.raises(StoreError, match="infinity"):
        import_store(write_dp3(tmp_path / "a.zarr", {"data/state": huge}), "dp3", tmp_path / "ours.zarr")


def test_a_store_of_ours_is_said_to_be_one(tmp_path, capsys):
    import_store(write_dp3(tmp_path / "a.zarr"), "dp3", tmp_path / "ours.zarr")
    with pytest.raises(SystemExit) as end:
        main(["convert", str(tmp_path / "ours.zarr"), "--from", "dp3", "--out", str(tmp_path / "again.zarr")])
    said = capsys.readouterr().err
    assert end.value.code == USER_ERROR
    assert "is one of our own stores already: 'manicm-ms train'" in said
    assert said.count("\n") == 1


def test_one_of_theirs_is_said_to_be_one_where_ours_is_wanted(tmp_path):
    source = write_dp3(tmp_path / "a.zarr")
    before = sorted(source.rglob("*"))
    for mode in ("r", "a"):
        with pytest.raises(StoreError, match=f"DP3's layout: 'manicm-ms convert {source} --from dp3"):
            DemoStore.open(source, mode)
    assert sorted(source.rglob("*")) == before


def test_a_codec_that_is_not_installed_is_named(tmp_path):
    source = write_dp3(tmp_path / "a.zarr", {"data/img": pictures("u1")})
    for name in ("data/img", "data/state"):
        header = source / name / ".zarray"
        header.write_text(json.dumps(json.loads(header.read_text()) | {"compressor": {"id": "jpegxl"}}))
    with pytest.raises(StoreError, match=r"data/state is damaged, or coded by what is not installed .*jpegxl"):
        import_store(source, "dp3", tmp_path / "ours.zarr")


def test_nothing_is_unpickled(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (open, (str(tmp_path / "exploded"), "w"))

    numcodecs.register_codec(numcodecs.Pickle)
    source = write_dp3(tmp_path / "a.zarr")
    for name in ("data/state", "meta/episode_ends"):
        write_dp3(tmp_path / "a.zarr")
        header = source / name / ".zarray"
        content = json.loads(header.read_text()) | {"filters": [{"id": "pickle"}], "compressor": None}
        header.write_text(json.dumps(content))
        for chunk in (source / name).glob("[0-9]*"):
            chunk.write_bytes(pickle.dumps(Bomb()))
        with pytest.raises(StoreError, match=f"{name} is coded by 'pickle', and nothing is unpickled"):
            import_store(source, "dp3", tmp_path / "ours.zarr")
    assert not (tmp_path / "exploded").exists()


def test_zipped_stores_and_files(tmp_path):
    source = write_dp3(tmp_path / "a.zarr")
    zipped = shutil.make_archive(str(source), "zip", source)
    for open_it in (lambda p: import_store(p, "dp3", tmp_path / "o.zarr"), DemoStore.open, summarize):
        with pytest.raises(StoreError, match=r"is a zip file: unzip it \('python -m zipfile -e .*a.zarr'\)"):
            open_it(Path(zipped))
        (tmp_path / "file").write_text("mine")
        with pytest.raises(StoreError, match="file is a file where a store, which is a folder, is wanted"):
            open_it(tmp_path / "file")
    with pytest.raises(StoreError, match=r"lacks data/point_cloud, .*; try .*a\.zarr$"):
        import_store(tmp_path, "dp3", tmp_path / "o.zarr")
    only_pictures = write_dp3(tmp_path / "b.zarr", {"data/point_cloud": None, "data/img": pictures("u1")})
    with pytest.raises(StoreError, match=r"lacks data/point_cloud; it holds data/action, data/img, data/state, meta"):
        import_store(only_pictures, "dp3", tmp_path / "o.zarr")


UNFIT = {
    "no points": (
        {"data/point_cloud": np.zeros((FRAMES, 0, 3), "f4")},
        r"data/point_cloud is \(12, 0, 3\) float32 where",
    ),
    "no entries": ({"data/state": np.zeros((FRAMES, 0), "f4")}, r"data/state is \(12, 0\) float32 where 2 axes"),
    "complex": ({"data/state": np.zeros((FRAMES, DIM), "c8")}, "complex64 where 2 axes of numbers belong"),
    "bool": ({"data/action": np.ones((FRAMES, ACTION_DIM), bool)}, "bool where 2 axes of numbers belong"),
    "equal points": (
        {"data/point_cloud": np.full((FRAMES, POINTS, 3), 0.3)},
        "empty cloud, all points equal, in 12 of 12",
    ),
    "chunks of actions": ({"data/action": np.ones((FRAMES, 8, 3))}, "where 2 axes of numbers belong, one row a frame"),
    "bool ends": ({"meta/episode_ends": np.array([False, True])}, "episode_ends is bool where numbers belong"),
}


@pytest.mark.parametrize("kind", UNFIT)
def test_what_no_policy_can_read_is_refused(tmp_path, kind):
    changes, match = UNFIT[kind]
    source = write_dp3(tmp_path / "a.zarr", changes)
    refuse(source, StoreError, match)


@pytest.mark.parametrize(
    ("header", "match"),
    [
        ({"shape": [-3, DIM]}, "damaged, or coded by"),
        ({"chunks": [0, DIM]}, "data/state cannot be read"),
        ({"dtype": "|O"}, "damaged, or coded by"),
        ({"dtype": "<U4", "fill_value": ""}, "where 2 axes of numbers belong"),
        ({"compressor": 3}, "damaged, or coded by"),
        (None, "damaged, or coded by"),
    ],
)
def test_torn_headers_are_refused_in_a_line(tmp_path, header, match):
    source = write_dp3(tmp_path / "a.zarr")
    file = source / "data/state/.zarray"
    file.write_text("null" if header is None else json.dumps(json.loads(file.read_text()) | header))
    with pytest.raises(StoreError, match=match) as raised:
        RawStore.open(source).read("agent_pos", 0, 1)
    assert "\n" not in str(raised.value)


OPTIONAL_UNFIT = {
    "nan": ({"data/img": np.full((FRAMES, 4, 5, 3), np.nan)}, "data/img, which holds NaN or infinity"),
    "four channels": ({"data/img": np.zeros((FRAMES, 4, 5, 4), "u1")}, r"where \(F, H, W, 3\) numbers are read"),
    "few": ({"data/img": np.zeros((FRAMES - 1, 4, 5, 3), "u1")}, r"data/img, which is \(11, 4, 5, 3\) uint8 where"),
    "negative": ({"data/depth": np.full((FRAMES, 4, 5), -1.0)}, "data/depth, which holds NaN, infinity or negative"),
    "sizes": ({"data/img": pictures("u1"), "data/depth": np.ones((FRAMES, 2, 2))}, "data/depth, of another size"),
}


@pytest.mark.parametrize("kind", OPTIONAL_UNFIT)
def test_optional_arrays_that_do_not_fit_are_left_out(tmp_path, kind):
    changes, said = OPTIONAL_UNFIT[kind]
    notes, _, _ = read(write_dp3(tmp_path / "a.zarr", changes))
    assert re.search(f"left out: {said}", notes) or re.search(said, notes), notes


def test_an_optional_array_of_another_codec_is_left_out(tmp_path):
    source = write_dp3(tmp_path / "a.zarr", {"data/img": pictures("u1"), "data/depth": np.ones((FRAMES, 4, 5))})
    for name, coding in (
        ("data/img", {"compressor": {"id": "jpegxl"}}),
        ("data/depth", {"filters": [{"id": "pickle"}]}),
    ):
        header = source / name / ".zarray"
        header.write_text(json.dumps(json.loads(header.read_text()) | coding))
    notes, arrays, _ = read(source)
    assert set(arrays) == {"point_cloud", "agent_pos", "action"}
    assert re.search(r"left out: data/img, which cannot be opened \(.*jpegxl", notes)
    assert "left out: data/depth, which is pickled" in notes


def test_colours_that_are_not_wanted_may_be_anything(tmp_path):
    source = write_dp3(tmp_path / "a.zarr", {"data/point_cloud": colored(np.full_like(UNIT, np.nan))})
    read(source)
    refuse(source, StoreError, "data/point_cloud holds NaN", colors=True)
