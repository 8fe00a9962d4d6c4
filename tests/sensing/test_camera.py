"""The camera of a cell against pinhole geometry: what it is, what it sees, and what can hardly be one."""

import math
from dataclasses import replace

import numpy as np
import pytest
from table_view import CAMERA, WORKSPACE, rays

from manicm_ms.errors import CameraError
from manicm_ms.sensing.camera import Crop, require_view
from manicm_ms.sensing.point_cloud import Box


def test_the_shipped_camera_spans_the_simulated_one():
    assert (CAMERA.width, CAMERA.height, CAMERA.crop) == (640, 480, Crop(169, 89, 302, 302))
    assert CAMERA.fx == CAMERA.fy == pytest.approx(151 / math.tan(0.375), abs=1e-9)
    assert 382.9 < CAMERA.fx < 384.3  # between two units that were read (librealsense 3474, realsense-ros 2788)
    assert (CAMERA.cx, CAMERA.cy) == (319.5, 239.5)  # the middle: the crop is about the optical axis
    assert CAMERA.depth_unit == 0.001


def test_renderers_intrinsics_put_the_axis_where_ours_do():
    other = replace(CAMERA, cx=330.25, cy=201.0, crop=Crop(100, 50, 302, 302))
    K = other.crop_intrinsic
    pixel_centres = np.array([[0.5, 0.5], [301.5, 10.5]])  # first pixel of the crop, and another
    ours = rays(other)[[0, 10], [0, 301], :2]
    np.testing.assert_allclose((pixel_centres - K[:2, 2]) / K[[0, 1], [0, 1]], ours, atol=1e-12)


def moved(shift):
    pose = CAMERA.pose
    pose[:3, 3] += shift
    return replace(CAMERA, T_base_camera=tuple(map(tuple, pose.tolist())))


def test_the_share_of_the_workspace_that_is_seen():
    assert 0.8 < CAMERA.share_seen(WORKSPACE) < 0.9, "two upper corners are cut off"
    assert CAMERA.share_seen(Box((1.0, -0.2, 0.0), (1.2, 0.2, 0.1))) == 0, "behind the camera"
    point = (CAMERA.pose @ [*(rays()[150, 0] * 0.6), 1])[:3]  # on the left edge of the crop
    assert CAMERA.share_seen(Box(tuple(point), tuple(point))) == 1
    outside = (CAMERA.pose @ [*((rays()[150, 0] - [0.01, 0, 0]) * 0.6), 1])[:3]
    assert CAMERA.share_seen(Box(tuple(outside), tuple(outside))) == 0
    assert 0.1 < moved([0, 0.25, 0]).share_seen(WORKSPACE) < 0.7


def test_a_camera_that_sees_nothing_is_refused():
    require_view(CAMERA, WORKSPACE, "ur3e/slide-block")
    with pytest.raises(
        CameraError, match=r"camera at \(3\.71, 0\.28, 0\.43\) m sees nothing of the workspace of ur3e/x"
    ):
        require_view(moved([3.0, 0, 0]), WORKSPACE, "ur3e/x")
