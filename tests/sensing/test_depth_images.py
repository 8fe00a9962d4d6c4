"""Depth images: read in the camera's unit, written to the bit, and refused where they are none of this camera."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from table_view import CAMERA

from manicm_ms.errors import CameraError
from manicm_ms.sensing.depth_images import read_depth, write_depth


def raw_image(value=600):
    return np.full((480, 640), value, np.uint16)


def write_png(path, image):
    assert cv2.imwrite(str(path), image)
    return path


def test_depth_images_are_read_in_their_unit(tmp_path):
    image = raw_image()
    image[100:110, 200:300] = 0
    image[0, 0] = 65535
    depth = read_depth(write_png(tmp_path / "d.png", image), CAMERA)
    assert depth.shape == (480, 640)
    np.testing.assert_array_equal(depth.numpy(), image.astype(np.float32) * np.float32(0.001))
    fine = read_depth(tmp_path / "d.png", replace(CAMERA, depth_unit=2.5e-4))
    np.testing.assert_array_equal(fine.numpy(), image.astype(np.float32) * np.float32(2.5e-4))


def test_written_depth_comes_back_to_the_bit(tmp_path):
    raw = torch.randint(0, 65536, (480, 640), generator=torch.Generator().manual_seed(0))
    raw[100, 200] = 700
    depth = CAMERA.metres(raw)
    write_depth(tmp_path / "d.png", depth, CAMERA)
    assert torch.equal(read_depth(tmp_path / "d.png", CAMERA), depth)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (raw_image()[:, :600], ("600x480", "640x480")),
        (raw_image().T.copy(), ("480x640", "640x480")),
        (raw_image().astype(np.uint8), ("uint8", "uint16")),
        (np.stack([raw_image()] * 3, axis=-1), ("3 channel", "uint16")),
        (raw_image(0), ("no reading",)),
        (raw_image(60), ("0.06 m", "depth_unit")),
        (raw_image(30000), ("30 m", "depth_unit")),
    ],
)
def test_images_that_are_no_depth_of_this_camera_are_refused(tmp_path, image, words):
    path = write_png(tmp_path / "bad.png", image)
    with pytest.raises(CameraError) as caught:
        read_depth(path, CAMERA)
    for word in ("bad.png", *words):
        assert word in str(caught.value)


def test_floating_point_images_are_refused(tmp_path):
    path = write_png(tmp_path / "bad.tiff", raw_image().astype(np.float32) / 1000)
    with pytest.raises(CameraError, match="float32"):
        read_depth(path, CAMERA)


@pytest.mark.parametrize("data", [b"", b"no picture"])
def test_files_that_are_no_images_are_refused(tmp_path, data):
    path = tmp_path / "bad.png"
    path.write_bytes(data)
    with pytest.raises(CameraError, match=r"bad\.png is no image"):
        read_depth(path, CAMERA)


def test_a_missing_image_is_named(tmp_path):
    with pytest.raises(CameraError, match="does not exist"):
        read_depth(tmp_path / "gone.png", CAMERA)
