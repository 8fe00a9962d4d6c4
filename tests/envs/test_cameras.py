"""The rendered cloud against geometry that is known: the table's plane, a cube's faces, the pinhole model."""

import numpy as np
import pytest
import torch

from manicm_ms.envs.cameras import CLOUD_POSITION, D435I, MICROMETRE
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.sensing.point_cloud import Box
from manicm_ms.spec import DEPTH, IMAGE, POINT_CLOUD, STATE, VOXEL_GRID

ENV_ID = "ur3e/slide-block"
ACCURACY = 2e-5  # m: the renderer interpolates in single precision, some 0.7 m away
ROW = torch.zeros(1, dtype=torch.int64)


@pytest.fixture(scope="module")
def simulator():
    config = SimulatorConfig(obs=(POINT_CLOUD, DEPTH, IMAGE, STATE), num_points=512)
    entry = ENVS.get(ENV_ID)
    simulator = entry.build(config.specialise(entry.spec), config)
    simulator.reset(ROW, [3])
    yield simulator
    simulator.close()


@pytest.fixture
def frame(simulator):
    simulator.reset(ROW, [3])
    return simulator.observe()


def T_base_camera():  # noqa: N802 (the frames' own spelling)
    """Return the camera's pose in OpenGL axes (x right, y up, z backward), from its description alone."""
    eye, target = np.array(D435I.eye), np.array(D435I.target)
    backward = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = right, np.cross(backward, right), backward, eye
    return T


def unproject(depth):
    """Return points (H * W, 3) in the base frame, from depth (H, W) m and the intrinsics."""
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(D435I.intrinsic).T
    points = rays * depth[..., None] * [1, -1, -1]  # OpenCV's axes to OpenGL's
    T = T_base_camera()
    return points.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]


def uncropped(simulator):
    """Return every rendered point (M, 3) in the base frame, as the simulator computes it, with its body's id (M,)."""
    position = simulator._pictures(color=False)[CLOUD_POSITION][0].reshape(-1, 4)
    T = T_base_camera()
    points = position[:, :3].numpy() * MICROMETRE @ T[:3, :3].T + T[:3, 3]
    return points, position[:, 3].numpy()


def body_id(actor):
    return int(actor.per_scene_id[0])


def test_table_top_is_at_zero_to_ten_micrometres(simulator, frame):
    points, ids = uncropped(simulator)
    table = points[ids == body_id(simulator.env.table)]
    top = table[np.abs(table[:, 2]) < 5e-3]  # its rim is seen too
    assert len(top) > 1000
    assert abs(top[:, 2].mean()) < 1e-6
    assert np.abs(top[:, 2]).max() < 1e-5


def test_position_image_equals_depth_through_the_pinhole_model(simulator, frame):
    depth = frame[DEPTH][0].numpy()
    points, ids = uncropped(simulator)
    hit = ids != 0
    assert hit.mean() > 0.5
    np.testing.assert_allclose(points[hit], unproject(depth)[hit], atol=ACCURACY)


def test_depth_is_metres_along_the_axis_and_zero_where_nothing_was_hit(simulator, frame):
    depth = frame[DEPTH][0].numpy()
    _, ids = uncropped(simulator)
    assert depth.dtype == np.float32
    hit = ids.reshape(depth.shape) != 0
    assert (depth[~hit] == 0).all()
    assert depth[hit].min() > D435I.near
    assert depth[hit].max() < D435I.far


def surface_distance(points, pose, half):
    """Return how far points (M, 3) lie from the surface of a box with that pose (7,) and half sizes (3,)."""
    w, x, y, z = pose[3:]
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    beyond = np.abs((points - pose[:3]) @ R) - half
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
    return np.abs(outside + np.minimum(beyond.max(axis=1), 0))


@pytest.mark.parametrize("seed", [3, 4, 5])
def test_the_cloud_lies_on_the_faces_of_cube_and_block(simulator, seed):
    simulator.reset(ROW, [seed])
    frame = simulator.observe()
    cloud, state = frame[POINT_CLOUD][0].numpy().astype(float), frame[STATE][0].numpy().astype(float)
    layout = simulator.spec.state_layout
    gaps = [
        surface_distance(cloud, state[slice(*layout[name])], half)
        for name, half in (("cube_pose", [0.03] * 3), ("block_pose", [0.02, 0.02, 0.015]))
    ]
    # At the start the arm is above the crop and the table below it: nothing but the two bodies is left.
    assert np.minimum(*gaps).max() < ACCURACY
    assert (gaps[0] < ACCURACY).sum() > 100
    assert (gaps[1] < ACCURACY).sum() > 30


def test_cloud_is_cropped_to_the_workspace(simulator, frame):
    cloud = frame[POINT_CLOUD][0].numpy()
    box = simulator.env.workspace
    assert (cloud > box.low).all()
    assert (cloud < box.high).all()


def test_cloud_is_a_farthest_point_prefix_of_the_cropped_pixels(simulator, frame):
    points, ids = uncropped(simulator)
    box = simulator.env.workspace
    inside = (ids != 0) & (points > box.low).all(axis=1) & (points < box.high).all(axis=1)
    cloud = frame[POINT_CLOUD][0].numpy()
    count = min(512, int(inside.sum()))
    pixels = {tuple(np.round(p, 5)) for p in points[inside]}
    assert len({tuple(p) for p in cloud.tolist()}) == count
    found = sum(tuple(np.round(p.astype(float), 5)) in pixels for p in cloud[:count])
    assert found > 0.9 * count  # the rest differs in the rounding of the fifth digit
    gap = np.linalg.norm(cloud[1:40, None] - cloud[None, :40], axis=-1)
    nearest_earlier = [gap[k, : k + 1].min() for k in range(39)]
    assert (np.diff(nearest_earlier) < 1e-6).all(), "each next point is no farther out than the one before"


def test_empty_crop_gives_the_origin(simulator, monkeypatch):
    monkeypatch.setattr(simulator.env, "workspace", Box((5.0, 5.0, 5.0), (6.0, 6.0, 6.0)), raising=False)
    assert torch.equal(simulator.observe()[POINT_CLOUD], torch.zeros(1, 512, 3))


def test_image_shows_the_white_cube(simulator, frame):
    image = frame[IMAGE][0].numpy()
    _, ids = uncropped(simulator)
    cube = (ids == body_id(simulator.env.cube)).reshape(image.shape[:2])
    table = (ids == body_id(simulator.env.table)).reshape(image.shape[:2])
    assert cube.sum() > 50
    assert image.dtype == np.uint8
    assert image[cube].min(axis=1).mean() > image[table].mean(axis=0).max()


def test_colours_belong_to_their_points():
    config = SimulatorConfig(obs=(POINT_CLOUD, STATE), colors=True, num_points=256)
    entry = ENVS.get(ENV_ID)
    simulator = entry.build(config.specialise(entry.spec), config)
    try:
        simulator.reset(ROW, [3])
        frame = simulator.observe()
    finally:
        simulator.close()
    cloud = frame[POINT_CLOUD][0].numpy()
    assert cloud.shape == (256, 6)
    assert cloud[:, 3:].min() >= 0
    assert cloud[:, 3:].max() <= 1
    on_block = cloud[:, 2] > 0.062  # above the cube's top, in the start scene, is the block alone
    assert on_block.any()
    assert cloud[on_block, 3:].mean() < cloud[~on_block, 3:].mean(), "the block is grey, the cube white"


def test_a_voxel_grid_holds_the_cropped_pixels_and_every_sampled_point(simulator, frame):
    pictures = simulator._pictures(color=False)
    views = [simulator._view.frame((VOXEL_GRID,), pictures, simulator._steps)[VOXEL_GRID] for _ in range(2)]
    assert torch.equal(*views)
    grid, box = views[0][0, 0].numpy(), simulator.env.workspace
    low, side = np.array(box.low), (np.array(box.high) - box.low) / len(grid)
    points, ids = uncropped(simulator)
    inside = (ids != 0) & (points > box.low).all(axis=1) & (points < box.high).all(axis=1)
    for seen in (points[inside], frame[POINT_CLOUD][0].numpy()):
        middle = np.abs((seen - low) / side % 1 - 0.5).max(axis=1) < 0.49  # else rounding may decide
        cells = {tuple(cell) for cell in ((seen[middle] - low) // side).astype(int).tolist()}
        assert cells <= {tuple(cell) for cell in np.argwhere(grid == 255).tolist()}
    assert grid.astype(bool).sum() <= inside.sum()
