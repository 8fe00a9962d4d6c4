"""Camera files: every bit comes back, and what is no such file, or can hardly be one, is named by its field."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import yaml
from table_view import CAMERA

from manicm_ms.errors import CameraError, CameraWarning
from manicm_ms.paths import asset
from manicm_ms.sensing.camera import CameraModel, Crop
from manicm_ms.sensing.camera_doubts import doubts
from manicm_ms.sensing.camera_files import default_camera, read_camera, write_camera


def other_camera():
    angle = 0.3
    T = np.eye(4)
    T[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    T[:3, 3] = (1 / 3, -2 / 7, 0.1)
    rows = tuple(tuple(row) for row in T.tolist())
    return CameraModel(848, 480, 422.81, 423.1, 425.12, 235.45, rows, Crop(200, 20, 400, 300), 1e-4, "D435", "0123")


def test_files_keep_every_bit(tmp_path):
    path = tmp_path / "camera.yaml"
    write_camera(path, other_camera(), notes={"reprojection_error_px": 0.21, "made_by": "a test"})
    assert read_camera(path) == other_camera()
    assert yaml.safe_load(path.read_text())["notes"]["reprojection_error_px"] == 0.21


def content():
    return yaml.safe_load(asset("cameras", "d435i.yaml").read_text())


def without(name):
    return {key: value for key, value in content().items() if key != name}


def test_numbers_that_yaml_reads_as_text_are_read(tmp_path):
    written = asset("cameras", "d435i.yaml").read_text()
    for number, text in {"depth_unit: 0.001": "depth_unit: 1e-3", "width: 640": "width: '640'", "[0.0, 0.0, 0.0, 1.0]":
                         "['0', 0e0, 0e+0, 1e0]", "fx: 383.6123098266825": "fx: 3836.123098266825e-1",
                         "left: 169": 'left: "169"', "distortion: [0.0,": "distortion: [0e-5,"}.items():  # fmt: skip
        assert written.count(number) == 1, number
        written = written.replace(number, text)
    assert sum(isinstance(value, str) for value in yaml.safe_load(written).values()) >= 4, "texts to YAML"
    (tmp_path / "camera.yaml").write_text(written)
    assert read_camera(tmp_path / "camera.yaml") == default_camera()


RAW = {  # of a D435's depth streams: fx, cx, cy
    (1280, 720): (639.0, 638.2, 357.9), (848, 480): (423.3, 422.9, 238.6), (640, 480): (383.6, 318.6, 238.4),
    (640, 360): (319.5, 319.1, 178.9), (424, 240): (211.7, 211.5, 119.3),
}  # fmt: skip


def camera_of(size, intrinsics):
    """A camera with the intrinsics of one stream and the picture of another, and a crop of 43 degrees if it fits."""
    (width, height), (fx, cx, cy) = size, intrinsics
    side = min(2 * round(fx * math.tan(math.radians(21.5))), width, height)
    crop = Crop((width - side) // 2, (height - side) // 2, side, side)
    return replace(CAMERA, width=width, height=height, fx=fx, fy=fx, cx=cx, cy=cy, crop=crop)


@pytest.mark.parametrize("size", RAW)
def test_the_intrinsics_of_a_stream_are_not_doubted(size):
    assert doubts(camera_of(size, RAW[size])) == []


@pytest.mark.parametrize(("size", "other"), [(a, b) for a in RAW for b in RAW if a != b])
def test_the_intrinsics_of_any_other_stream_are(size, other):
    try:
        line = doubts(camera_of(size, RAW[other]))[0]
    except CameraError as error:  # the axis lies outside of the picture
        line = str(error)
    assert "of another size?" in line or f"are fx, fy, cx and cy those of the {other[0]}x{other[1]} stream?" in line


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fx": 3.836, "fy": 3.836}, "field of view of 179 x 178 degrees"),  # millimetres
        ({"fx": 1920.0, "fy": 1920.0}, "field of view of 19 x 14 degrees"),
        ({"fx": 767.2}, "differ by 100 %, pixels are square"),
        ({"crop": Crop(0, 0, 640, 480)}, "crop of 640x480 pixels spans 80 x 64 degrees, that of the policies'"),
        ({"T_base_camera": ((1, 0, 0, 710), (0, 1, 0, 280), (0, 0, 1, 432), (0, 0, 0, 1))}, "in millimetres?"),
    ],
)  # fmt: skip
def test_what_no_camera_has_is_doubted(changes, words):
    assert any(words in line for line in doubts(replace(CAMERA, **changes)))


def test_doubts_are_warnings_that_name_the_file(tmp_path):
    write_camera(tmp_path / "camera.yaml", camera_of((848, 480), RAW[640, 480]))
    with pytest.warns(
        CameraWarning, match=r"camera\.yaml: cx 318\.6 lies far from 423\.5, .* those of the 640x480 stream"
    ):
        read_camera(tmp_path / "camera.yaml")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        default_camera()


SKEWED = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (content() | {"model": "fisheye"}, ("model", "fisheye", "pinhole")),
        (without("model"), ("model", "pinhole")),
        (content() | {"distortion": [0.1, 0, 0, 0, 0]}, ("distortion", "zeros", "rectif")),
        (without("fx"), ("fx", "missing")),
        (without("crop"), ("crop", "missing")),
        (without("T_base_camera"), ("T_base_camera", "missing")),
        (content() | {"focal": 380.0}, ("unknown", "focal")),
        (content() | {"hieght": 480}, ("hieght", "height")),
        (content() | {"fx": "383 px"}, ("fx", "'383 px'", "number")),
        (content() | {"fx": "383,6"}, ("fx", "'383,6'", "number; write 383.6, with a point")),
        (content() | {"fx": "nan"}, ("fx", "'nan'", "number")),
        (content() | {"fx": -383.0}, ("fx", "above 0")),
        (content() | {"fy": float("nan")}, ("fy",)),
        (content() | {"width": 640.5}, ("width", "whole")),
        (content() | {"width": True}, ("width", "whole")),
        (content() | {"cx": 700.0}, ("cx", "639", "of another size?")),
        (content() | {"depth_unit": 1}, ("depth_unit", "0.01")),
        (content() | {"crop": {"left": 400, "top": 89, "width": 302, "height": 302}}, ("crop", "640x480")),
        (content() | {"crop": [169, 89, 302, 302]}, ("crop", "left, top, width and height")),
        (content() | {"T_base_camera": SKEWED}, ("T_base_camera", "rigid")),
        (content() | {"T_base_camera": MIRRORED}, ("T_base_camera", "rigid")),
        (content() | {"T_base_camera": SKEWED[:3]}, ("T_base_camera", "four rows")),
        (["pinhole"], ("mapping",)),
        (None, ("mapping",)),
    ],
)
def test_files_of_other_cameras_are_refused_by_field(tmp_path, changed, words):
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(changed))
    with pytest.raises(CameraError) as caught:
        read_camera(path)
    for word in ("camera.yaml", *words):
        assert word in str(caught.value)


@pytest.mark.parametrize("data", [b"model: [pinhole", b"\xff\xfe\x00", b"!!python/object/apply:os.getcwd []"])
def test_what_is_not_plain_yaml_is_refused(tmp_path, data):
    path = tmp_path / "camera.yaml"
    path.write_bytes(data)
    with pytest.raises(CameraError, match="not YAML"):
        read_camera(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(CameraError, match=r"nowhere\.yaml does not exist"):
        read_camera(tmp_path / "nowhere.yaml")
