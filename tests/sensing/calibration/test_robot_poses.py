"""The file of robot poses: both formats, both rotations, and its errors."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manicm_ms.errors import CalibrationError
from manicm_ms.sensing.calibration import read_poses

QUARTER = {"position": [0.1, 0.2, 0.3], "quat_wxyz": [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]}  # 90 degrees about z
EXPECTED = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]


def written(tmp_path, content, name="poses.json"):
    path = tmp_path / name
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("poses.json", {"a.png": QUARTER}),
        ("poses.json", {"a.png": {"position": [0.1, 0.2, 0.3], "rotation_vector": [0, 0, np.pi / 2]}}),
        ("poses.csv", "file,x,y,z,qw,qx,qy,qz\na.png,0.1,0.2,0.3,0.70710678,0,0,0.70710678\n"),
        ("poses.csv", "FILE;X;Y;Z;RX;RY;RZ;\r\na.png;0,1;0,2;0,3;0;0;1,57079633;\r\n;;;;;;;\r\n"),
        ("poses.csv", "file\tx\ty\tz\trx\try\trz\na.png\t0.1\t0,2\t.3\t0\t0\t157079633e-8\n"),
        ("poses.csv", 'file,x,y,z,rx,ry,rz\na.png,"0,1","0,2","0,3",0,0,"1,57079633"\n'),
        ("poses.json", {"a.png": {"position": ["0,1", "0.2", 0.3], "rotation_vector": [0, 0, "1,57079633"]}}),
        ("poses.csv", "\ufeffz, file, rx, ry, rz, x, y\r\n0.3, a.png, 0, 0, 1.57079633, 0.1, 0.2\r\n"),
    ],
)
def test_all_forms_give_the_same_pose(tmp_path, name, content):
    poses = read_poses(written(tmp_path, content, name))
    np.testing.assert_allclose(poses["a.png"].as_matrix(), EXPECTED, atol=1e-7)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig"])
def test_spreadsheets_encodings_are_read(tmp_path, encoding):
    path = tmp_path / "poses.csv"
    path.write_text("file,x,y,z,rx,ry,rz\na.png,0.1,0.2,0.3,0,0,1.57079633\n", encoding=encoding)
    np.testing.assert_allclose(read_poses(path)["a.png"].as_matrix(), EXPECTED, atol=1e-7)


HEADER = "file,x,y,z,rx,ry,rz\n"


@pytest.mark.parametrize(
    ("table", "match"),
    [
        (HEADER + "a.png,0,31,-0,02,0,25,3,01,0,12,-0,2\n", r"line 2 has 13 values and the header 7; .*decimal commas"),
        (HEADER + "a.png,0,3,-0.02,0.25,3.01,0.12,-0.2\n", r"line 2 has 8 values and the header 7; .*semicolons"),
        (HEADER + "a.png,0,0,0,0,0,0\nb.png,0,0,0,0,0\n", r"line 3 has 6 values and the header 7\)"),
        (HEADER.replace(",", ";") + "a.png;0;0;0;0;0;0;0\n", r"line 2 has 8 values and the header 7\)"),
        (HEADER + "a.png,0.3,0,0.2,0,0,179.9\n", r"a\.png: rotation_vector .* turns by 179\.9 rad, .*degrees\?"),
        (HEADER + "a.png,310,-20,250,0,0,1\n", "millimetres or centimetres"),
        (HEADER + "a.png,31,-2,25,0,0,1\n", "millimetres or centimetres"),
        ('file,pose\na.png,"p[0.3, 0, 0.2, 0, 0, 1]"\n', "its header is file,pose"),
        ("file,x,y,z,roll,pitch,yaw\na.png,0,0,0,0,0,0\n", "its header is file,x,y,z,roll,pitch,yaw"),
        ("", "its header is missing"),
    ],
)
def test_a_table_of_another_habit_is_refused_with_its_cause(tmp_path, table, match):
    with pytest.raises(CalibrationError, match=match) as caught:
        read_poses(written(tmp_path, table, "poses.csv"))
    assert "\n" not in str(caught.value)
    assert "poses.csv" in str(caught.value)


def test_a_ur_controllers_whole_turn_is_no_degrees(tmp_path):
    table = HEADER + "a.png,0.1,0.2,0.3,0,0,-4.71238898\n"  # -270 degrees are 90
    poses = read_poses(written(tmp_path, table, "poses.csv"))
    np.testing.assert_allclose(poses["a.png"].as_matrix(), EXPECTED, atol=1e-7)


def test_a_random_quaternion_against_its_matrix(tmp_path):
    rotation = Rotation.random(rng=np.random.default_rng(0))
    w, x, y, z = rotation.as_quat(scalar_first=True)
    fields = {"position": [0, 0, 0], "quat_wxyz": [w, x, y, z]}
    by_hand = [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]  # first row
    read = read_poses(written(tmp_path, {"a.png": fields}))["a.png"].as_matrix()
    np.testing.assert_allclose(read[0, :3], by_hand, atol=1e-9)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ({"a.png": {**QUARTER, "quat_wxyz": [1, 0, 0, 1]}}, r"a.png: quat_wxyz .* has norm 1\.4142"),
        ({"a.png": {**QUARTER, "quat_wxyz": [1, 0, 0]}}, "is not 4 finite numbers"),
        ({"a.png": {**QUARTER, "position": [100, 200, 300]}}, "millimetres"),
        ({"a.png": {**QUARTER, "position": [0, 0, "x"]}}, "is not 3 numbers"),
        ({"a.png": {**QUARTER, "position": "123"}}, "is not 3 numbers"),
        ('{"a.png": {"position": [0, 0, NaN], "quat_wxyz": [1, 0, 0, 0]}}', "finite"),
        ({"a.png": {"position": [0, 0, 0]}}, "needs position and either quat_wxyz or rotation_vector"),
        ({"a.png": {**QUARTER, "rotation_vector": [0, 0, 0]}}, "either"),
        ({"a.png": [0, 0, 0]}, "not a pose"),
        ([QUARTER], "cannot be read"),
        ("{", "cannot be read"),
        ('{"a.png": 1, "a.png": 2}', "a.png"),
    ],
)
def test_errors_name_file_image_and_field(tmp_path, content, match):
    with pytest.raises(CalibrationError, match=match) as caught:
        read_poses(written(tmp_path, content))
    assert "poses.json" in str(caught.value)


def test_two_poses_for_one_image_and_a_csv_without_names(tmp_path):
    twice = "file,x,y,z,rx,ry,rz\na.png,0,0,0,0,0,0\na.png,0,0,0,0,0,0\n"
    with pytest.raises(CalibrationError, match=r"two poses for a\.png"):
        read_poses(written(tmp_path, twice, "poses.csv"))
    with pytest.raises(CalibrationError, match="its header is x,y,z"):
        read_poses(written(tmp_path, "x,y,z\n0,0,0\n", "poses.csv"))
    with pytest.raises(CalibrationError, match="does not exist"):
        read_poses(tmp_path / "none.json")
    short = "file,x,y,z,qw,qx,qy,qz\na.png,0,0,0,1\n"
    with pytest.raises(CalibrationError, match="quat_wxyz"):
        read_poses(written(tmp_path, short, "poses.csv"))
