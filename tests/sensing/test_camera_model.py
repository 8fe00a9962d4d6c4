"""Camera files, depth images and the way to a cloud, against pinhole geometry written out here."""

import math
import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import yaml

from manicm_ms.errors import CameraError, CameraWarning
from manicm_ms.paths import asset
from manicm_ms.sensing import camera_model, point_cloud
from manicm_ms.sensing.camera_doubts import doubts
from manicm_ms.sensing.camera_model import (
    CameraModel,
    Crop,
    default_camera,
    depth_to_cloud,
    nearest_pixels,
    read_camera,
    read_depth,
    require_view,
    write_camera,
    write_depth,
)
from manicm_ms.sensing.point_cloud import Box

CAMERA = default_camera()
H, W = CAMERA.crop.height, CAMERA.crop.width
WORKSPACE = Box((0.15, -0.25, -0.01), (0.50, 0.25, 0.15))
EVERYWHERE = Box((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0))


def rays(camera=CAMERA):
    """Rays (h, w, 3) with z = 1 of every pixel of the crop, in double precision."""
    left, top, width, height = camera.crop
    u, v = np.meshgrid(np.arange(left, left + width), np.arange(top, top + height))
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)


def table_depth(height=0.0):
    """Depth (H, W) of the horizontal plane at `height` m in the base frame."""
    T = CAMERA.pose
    return (height - T[2, 3]) / (rays() @ T[2, :3])


def in_base(depth):
    """Points (H, W, 3) in the base frame, in double precision."""
    return (rays() * depth[..., None]) @ CAMERA.pose[:3, :3].T + CAMERA.pose[:3, 3]


def tensor(depth, rows=1):
    return torch.from_numpy(np.broadcast_to(depth, (rows, H, W)).astype(np.float32))


# ---- the camera itself


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


def test_nearest_neighbours_of_a_resize():
    assert nearest_pixels(4, 2).tolist() == [1, 3]
    assert nearest_pixels(5, 5).tolist() == [0, 1, 2, 3, 4]
    expected = cv2.resize(np.arange(302, dtype=np.float32)[None], (84, 1), interpolation=cv2.INTER_NEAREST_EXACT)[0]
    np.testing.assert_array_equal(nearest_pixels(302, 84), expected)


# ---- depth to cloud


def test_a_cloud_of_the_table_lies_on_the_table_at_the_pixels_own_rays():
    cloud = depth_to_cloud(tensor(table_depth(0.02)), CAMERA, WORKSPACE, 512)[0].numpy()
    assert cloud.dtype == np.float32
    np.testing.assert_allclose(cloud[:, 2], 0.02, atol=1e-6)
    rows, columns = np.meshgrid(nearest_pixels(H, 84), nearest_pixels(W, 84), indexing="ij")
    points = in_base(table_depth(0.02))[rows, columns].reshape(-1, 3)
    gap = np.linalg.norm(cloud[:, None] - points[None], axis=-1).min(axis=1)
    assert gap.max() < 1e-6
    assert (cloud > np.array(WORKSPACE.low)).all()
    assert (cloud < np.array(WORKSPACE.high)).all()
    assert len(np.unique(cloud, axis=0)) == 512


def test_no_point_is_invented_between_two_surfaces():
    depth = np.where(np.arange(W) < 120, table_depth(0.0), table_depth(0.06))
    heights = depth_to_cloud(tensor(depth), CAMERA, WORKSPACE, 512)[0, :, 2]
    on_one = (heights.abs() < 1e-5) | ((heights - 0.06).abs() < 1e-5)
    assert on_one.all()
    assert 50 < int((heights > 0.03).sum()) < 462


def test_pixels_without_a_reading_give_no_point():
    depth = tensor(table_depth()).clone()
    depth[:, :, 100:] = 0.0
    cloud = depth_to_cloud(depth, CAMERA, EVERYWHERE, 4000)[0].numpy()
    distinct = np.unique(cloud, axis=0)
    assert len(distinct) == 84 * int((nearest_pixels(W, 84) < 100).sum())
    assert not (depth_to_cloud(torch.zeros(2, H, W), CAMERA, EVERYWHERE, 7)).any()


def test_rows_are_those_of_single_calls():
    generator = torch.Generator().manual_seed(0)
    depth = tensor(table_depth(), rows=3) + 0.05 * torch.rand(3, H, W, generator=generator) - 0.05
    poses = torch.tensor(CAMERA.T_base_camera).repeat(3, 1, 1)
    poses[1, :3, 3] += torch.tensor([0.003, -0.004, 0.002])
    together = depth_to_cloud(depth, CAMERA, WORKSPACE, 128, T_base_camera=poses)
    for k in range(3):
        alone = depth_to_cloud(depth[k : k + 1], CAMERA, WORKSPACE, 128, T_base_camera=poses[k : k + 1])
        assert torch.equal(alone[0], together[k])
    assert torch.equal(together[0], depth_to_cloud(depth[:1], CAMERA, WORKSPACE, 128)[0])


def test_a_pose_of_its_own_moves_a_rows_points():
    shift = torch.tensor([0.003, -0.004, 0.002])
    poses = torch.tensor(CAMERA.T_base_camera).repeat(1, 1, 1)
    poses[:, :3, 3] += shift
    depth = tensor(table_depth())
    moved = depth_to_cloud(depth, CAMERA, EVERYWHERE, 84 * 84, T_base_camera=poses)
    there = depth_to_cloud(depth, CAMERA, EVERYWHERE, 84 * 84)
    torch.testing.assert_close(moved[0].mean(dim=0), there[0].mean(dim=0) + shift, atol=1e-5, rtol=0)


def test_colours_stay_with_their_pixels():
    points = in_base(table_depth())
    rgb = torch.from_numpy(((points - points.min()) / 3).clip(0, 1).astype(np.float32))[None]
    cloud = depth_to_cloud(tensor(table_depth()), CAMERA, WORKSPACE, 200, rgb=rgb)[0].numpy()
    assert cloud.shape == (200, 6)
    np.testing.assert_allclose(cloud[:, 3:], ((cloud[:, :3] - points.min()) / 3).clip(0, 1), atol=1e-6)


@pytest.mark.parametrize("colored", [False, True])
def test_all_rows_together_give_what_one_after_the_other_does(monkeypatch, colored):
    monkeypatch.setattr(point_cloud, "bucket_fps_kdline_sampling", None)  # it starts from another point
    generator = torch.Generator().manual_seed(4)
    depth = tensor(table_depth(0.03), rows=3) - 0.05 * torch.rand(3, H, W, generator=generator)
    depth[torch.rand(3, H, W, generator=generator) < 0.2] = 0.0
    depth[2] = 0.0
    rgb = torch.rand(3, H, W, 3, generator=generator) if colored else None
    by_row = depth_to_cloud(depth, CAMERA, WORKSPACE, 64, rgb=rgb)
    monkeypatch.setattr(camera_model, "_clouds_by_row", camera_model._clouds_together)  # as on a device
    torch.testing.assert_close(depth_to_cloud(depth, CAMERA, WORKSPACE, 64, rgb=rgb), by_row, atol=1e-6, rtol=0)
    assert by_row[:2].any(dim=-1).all()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_device_gives_the_same_points(monkeypatch):
    monkeypatch.setattr(point_cloud, "bucket_fps_kdline_sampling", None)
    depth = tensor(table_depth(0.03), rows=2)
    there = depth_to_cloud(depth.cuda(), CAMERA, WORKSPACE, 64).cpu()
    torch.testing.assert_close(there, depth_to_cloud(depth, CAMERA, WORKSPACE, 64), atol=1e-6, rtol=0)


def test_a_depth_image_of_another_crop_is_refused():
    with pytest.raises(CameraError, match=r"\(N, 302, 302\), got \(1, 84, 84\)"):
        depth_to_cloud(torch.ones(1, 84, 84), CAMERA, WORKSPACE, 512)


# ---- camera files


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


# ---- depth images


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
