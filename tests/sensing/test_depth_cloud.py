"""The way from a depth image to a cloud, against pinhole geometry written out in `table_view`."""

import cv2
import numpy as np
import pytest
import torch
from table_view import CAMERA, EVERYWHERE, WORKSPACE, H, W, in_base, table_depth, tensor

from manicm_ms.errors import CameraError
from manicm_ms.sensing import depth_cloud, point_cloud
from manicm_ms.sensing.depth_cloud import depth_to_cloud, depth_to_points, nearest_pixels
from manicm_ms.sensing.point_cloud import sample_cloud_batch


def test_nearest_neighbours_of_a_resize():
    assert nearest_pixels(4, 2).tolist() == [1, 3]
    assert nearest_pixels(5, 5).tolist() == [0, 1, 2, 3, 4]
    expected = cv2.resize(np.arange(302, dtype=np.float32)[None], (84, 1), interpolation=cv2.INTER_NEAREST_EXACT)[0]
    np.testing.assert_array_equal(nearest_pixels(302, 84), expected)


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
    monkeypatch.setattr(depth_cloud, "_points_by_row", depth_cloud._points_together)  # as on a device
    together = sample_cloud_batch(*depth_to_points(depth, CAMERA, WORKSPACE, rgb=rgb), 64)
    torch.testing.assert_close(together, by_row, atol=1e-6, rtol=0)
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
