"""Sampling against the definition, by brute force."""

import numpy as np
import pytest
import torch

from manicm_ms.sensing import point_cloud
from manicm_ms.sensing.point_cloud import (
    Box,
    crop_transformed,
    farthest_point_order,
    inside,
    sample_cloud,
    sample_cloud_batch,
    transform,
)


def brute_force_order(xyz: np.ndarray, count: int, first: int) -> list[int]:
    """Farthest point sampling straight from its definition, in double precision."""
    chosen = [first]
    while len(chosen) < count:
        gap = np.linalg.norm(xyz[:, None] - xyz[None, chosen], axis=-1).min(axis=1)
        gap[chosen] = -1
        chosen.append(int(gap.argmax()))
    return chosen


@pytest.fixture
def points():
    return np.random.default_rng(3).normal(size=(400, 3)).astype(np.float32)


@pytest.fixture
def without_fpsample(monkeypatch):
    monkeypatch.setattr(point_cloud, "bucket_fps_kdline_sampling", None)


@pytest.mark.parametrize("size", [40, 400])
def test_order_follows_the_definition(points, size):
    order = farthest_point_order(points[:size], 30).tolist()
    assert order == brute_force_order(points[:size].astype(float), 30, order[0])
    assert order == farthest_point_order(points[:size], 30).tolist()


@pytest.mark.usefixtures("without_fpsample")
def test_fallback_follows_the_definition(points):
    assert farthest_point_order(points, 60).tolist() == brute_force_order(points.astype(float), 60, 0)


def test_prefix_of_a_cloud_is_a_cloud(points):
    np.testing.assert_array_equal(sample_cloud(points, 300)[:64], sample_cloud(points, 64))


def test_few_points_are_repeated_behind_themselves(points):
    cloud = sample_cloud(points[:10], 25)
    assert cloud.shape == (25, 3)
    np.testing.assert_array_equal(cloud[10:20], cloud[:10])
    np.testing.assert_array_equal(cloud[20:], cloud[:5])
    assert {tuple(p) for p in cloud} == {tuple(p) for p in points[:10]}


def test_empty_cloud_is_the_origin():
    np.testing.assert_array_equal(sample_cloud(np.empty((0, 6), np.float32), 4), np.zeros((4, 6)))


@pytest.mark.usefixtures("without_fpsample")
def test_batch_equals_single_rows(points):
    rng = np.random.default_rng(0)
    rows = np.stack([points, points[::-1], points * 2, points])
    valid = rng.random(rows.shape[:2]) < np.array([0.9, 0.5, 0.05, 0.0])[:, None]
    batch = sample_cloud_batch(torch.from_numpy(rows), torch.from_numpy(valid), 64).numpy()
    for row in range(4):
        np.testing.assert_array_equal(batch[row], sample_cloud(rows[row][valid[row]], 64))


def test_colours_travel_with_their_points(points):
    colored = np.concatenate([points, points * 0.1], axis=1)
    cloud = sample_cloud(colored, 100)
    np.testing.assert_allclose(cloud[:, 3:], cloud[:, :3] * 0.1, rtol=1e-6)


def test_transform_and_its_inverse():
    angle = torch.tensor(0.7)
    T = torch.eye(4)
    T[:2, :2] = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    T[:3, 3] = torch.tensor([0.3, -0.2, 0.5])
    points = torch.randn(2, 50, 3, generator=torch.Generator().manual_seed(1))
    there = transform(points, T.expand(2, 4, 4))
    torch.testing.assert_close(there[0, 0], T[:3, :3] @ points[0, 0] + T[:3, 3])
    torch.testing.assert_close(transform(there, torch.linalg.inv(T).expand(2, 4, 4)), points)


def test_inside_excludes_the_faces():
    box = Box((0, 0, 0), (1, 1, 1))
    probes = torch.tensor([[0.5, 0.5, 0.5], [0.0, 0.5, 0.5], [0.5, 1.0, 0.5], [0.5, 0.5, 1.1]])
    assert inside(probes, box).tolist() == [True, False, False, False]


def test_crop_equals_transform_and_inside(points):
    rotation, _ = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))
    T = np.eye(4, dtype=np.float32)
    T[:3, :3], T[:3, 3] = rotation, (0.2, -0.1, 0.3)
    box = Box((-0.5, -0.8, -0.2), (0.9, 0.7, 0.6))
    everywhere = transform(torch.from_numpy(points), torch.from_numpy(T))
    expected = inside(everywhere, box).numpy()
    index, kept = crop_transformed(points, T, box)
    assert 10 < len(index) < len(points)
    np.testing.assert_array_equal(index, np.flatnonzero(expected))
    np.testing.assert_allclose(kept, everywhere.numpy()[expected], atol=1e-6)
