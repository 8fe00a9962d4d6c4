"""The file of robot poses: both formats, both rotations, and its errors."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from manicm_ms.calibration import read_poses
from manicm_ms.errors import CalibrationError

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
        ("poses.csv", "\ufeffz, file, rx, ry, rz, x, y\r\n0.3, a.png, 0, 0, 1.57079633, 0.1, 0.2\r\n"),
    ],
)
def test_all_forms_give_the_same_pose(tmp_path, name, content):
    poses = read_poses(written(tmp_path, content, name))
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
