"""Voxel grids against a plain loop over points, whatever their order, their number and the rows beside them."""

import numpy as np
import pytest
import torch

from manicm_ms.envs.simulator import SimulatorConfig
from manicm_ms.errors import ConfigError
from manicm_ms.sensing.cropped import CroppedPoints, observe_cropped, voxel_grid
from manicm_ms.sensing.point_cloud import Box, sample_cloud
from manicm_ms.spec import POINT_CLOUD, VOXEL_GRID, ObsSpec

BOX = Box((-0.4, 0.1, 0.0), (0.6, 0.9, 0.3))
SIZE = 7


def points(count, channels, seed=0):
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(BOX.low, BOX.high, (count, 3))
    return np.concatenate([xyz, rng.integers(0, 256, (count, channels - 3)) / 255], axis=1).astype(np.float32)


def looped(cloud):
    """(C, V, V, V) of points (K, C), one after another."""
    cells = {}
    for point in cloud:
        spans = zip(point[:3].tolist(), BOX.low, BOX.high, strict=True)
        cell = tuple(min(max(int((p - low) / (high - low) * SIZE), 0), SIZE - 1) for p, low, high in spans)
        cells.setdefault(cell, []).append(point[3:] * 255)
    grid = np.zeros((1 + cloud.shape[1] - 3, SIZE, SIZE, SIZE), np.uint8)
    for cell, colors in cells.items():
        grid[(0, *cell)] = 255
        grid[(slice(1, None), *cell)] = np.floor(np.mean(colors, axis=0) + 0.5 + 1e-6) if cloud.shape[1] == 6 else 0
    return grid


@pytest.mark.parametrize("channels", [3, 6])
def test_a_grid_equals_a_loop_over_points(channels):
    rows = [points(700, channels, 1), points(0, channels), points(40, channels, 2)]
    grids = voxel_grid(*CroppedPoints.of_rows(rows), BOX, SIZE)
    assert (grids.dtype, grids.shape) == (torch.uint8, (3, 1 + channels - 3, SIZE, SIZE, SIZE))
    for grid, row in zip(grids, rows, strict=True):
        np.testing.assert_array_equal(grid.numpy(), looped(row))
    assert 0 < (grids[0, 0] == 0).sum() < SIZE**3


@pytest.mark.parametrize("channels", [3, 6])
def test_neither_order_nor_the_rows_beside_it_change_a_bit(channels):
    rows = [points(500, channels, 3), points(90, channels, 4)]
    together = voxel_grid(*CroppedPoints.of_rows(rows), BOX, SIZE)
    shuffled = np.random.default_rng(0).permutation(rows[1])
    assert torch.equal(together[1:], voxel_grid(*CroppedPoints.of_rows([shuffled]), BOX, SIZE))


def test_a_point_on_the_border_counts_to_the_outermost_cell():
    corners = torch.tensor([[[*BOX.low], [*BOX.high]]])
    grid = voxel_grid(corners, torch.ones(1, 2, dtype=torch.bool), BOX, SIZE)[0, 0]
    assert grid.nonzero().tolist() == [[0, 0, 0], [SIZE - 1] * 3]


def test_only_what_is_asked_for_is_made_and_a_cloud_is_that_of_the_row_alone():
    rows, obs = [points(300, 3, 5), points(20, 3, 6)], ObsSpec(64, 3, 1, "world", voxel_size=SIZE)
    cropped = CroppedPoints.of_rows(rows)
    frame = observe_cropped((POINT_CLOUD, VOXEL_GRID, "agent_pos"), cropped, BOX, obs)
    assert sorted(frame) == [POINT_CLOUD, VOXEL_GRID]
    np.testing.assert_array_equal(frame[POINT_CLOUD], np.stack([sample_cloud(row, 64) for row in rows]))
    assert list(observe_cropped((VOXEL_GRID,), cropped, BOX, obs)) == [VOXEL_GRID]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_device_gives_the_same_bits():
    cropped = CroppedPoints.of_rows([points(700, 6, 1), points(40, 6, 2)])
    there = voxel_grid(cropped.points.cuda(), cropped.valid.cuda(), BOX, SIZE).cpu()
    assert torch.equal(there, voxel_grid(*cropped, BOX, SIZE))


def test_a_grid_that_no_memory_holds_is_refused_before_anything_is_made():
    with pytest.raises(ConfigError, match="voxel_size must be at most 256 cells along a side, got 100000"):
        SimulatorConfig(voxel_size=100_000)
