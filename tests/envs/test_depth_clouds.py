"""Depth and clouds of a realistic camera, from rendered pictures: against the clean camera and known geometry."""

from dataclasses import replace

import numpy as np
import point_mass_env
import pytest
import torch

from manicm_ms.envs.cameras import CLOUD_POSITION, COLOR, D435I
from manicm_ms.envs.depth_clouds import DepthClouds, sapien_pose
from manicm_ms.envs.maniskill import workspace_of
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.sensing.camera_files import default_camera
from manicm_ms.sensing.point_cloud import Box
from manicm_ms.sensing.stereo_depth import StereoDepth
from manicm_ms.spec import POINT_CLOUD

ENV_ID = "ur3e/slide-block"
CAMERA = default_camera()
WORKSPACE = workspace_of(ENV_ID)
ROW = torch.zeros(1, dtype=torch.int64)
NUM_POINTS = 512


def render(image_size, seed):
    """Return the pictures (position, colour) and the cloud of the clean camera."""
    config = SimulatorConfig(obs=(POINT_CLOUD,), num_points=NUM_POINTS, image_size=image_size)
    entry = ENVS.get(ENV_ID)
    simulator = entry.build(config.specialise(entry.spec), config)
    try:
        simulator.reset(ROW, [seed])
        cloud = simulator.observe()[POINT_CLOUD]
        pictures = simulator._pictures(color=True)
        return pictures[CLOUD_POSITION].clone(), pictures[COLOR].clone(), cloud
    finally:
        simulator.close()


@pytest.fixture(scope="module")
def native():
    """The crop at native resolution: today's camera has exactly its field of view."""
    return render((CAMERA.crop.height, CAMERA.crop.width), seed=3)


def clouds(noise, rows=1, **options):
    return DepthClouds(CAMERA, noise, WORKSPACE, NUM_POINTS, rows, **options)


def test_the_shipped_camera_stands_where_the_simulated_one_does():
    ours = sapien_pose(CAMERA).to_transformation_matrix()
    np.testing.assert_allclose(ours, D435I.pose.to_transformation_matrix(), atol=5e-7)
    K, clean = CAMERA.crop_intrinsic, D435I.intrinsic
    np.testing.assert_allclose(K[:2] / CAMERA.crop.width, clean[:2] / D435I.size[0], atol=1e-9)


def test_exact_depth_at_native_resolution_gives_the_clean_cameras_scene(native):
    position, _, _ = native
    cloud = clouds(None).observe(position, [0]).cloud[0].numpy()
    _, _, clean = render(D435I.size, seed=3)
    clean = clean[0].numpy()
    gap = np.linalg.norm(cloud[:, None] - clean[None], axis=-1)
    # Pixels of the two grids lie within half a pixel of the coarse one (3.2 mm at 0.62 m) of one another.
    assert np.median(gap.min(axis=1)) < 0.003
    assert np.percentile(gap.min(axis=0), 95) < 0.01


def test_every_point_of_an_exact_cloud_is_a_rendered_point(native):
    position, _, _ = native
    cloud = clouds(None).observe(position, [0]).cloud[0].numpy().astype(float)
    pixels = position[0, ..., :3].reshape(-1, 3).numpy() * 1e-6 * [1, -1, -1]  # OpenGL's axes to OpenCV's
    points = pixels @ CAMERA.pose[:3, :3].T + CAMERA.pose[:3, 3]
    points = points[position[0, ..., 3].reshape(-1).numpy() != 0]
    gap = np.array([np.linalg.norm(points - p, axis=1).min() for p in cloud[::8]])
    assert gap.max() < 2e-5


def test_noise_is_of_the_cameras_size_and_bodies_keep_their_points(native):
    position, color, _ = native
    exact = clouds(None).observe(position, [0])
    noisy = clouds(StereoDepth()).observe(position, [0], color)
    both = (exact.depth > 0) & (noisy.depth > 0)
    error = (noisy.depth - exact.depth)[both]
    # Most pixels lie on surfaces 0.4 to 0.9 m away: 0.7 to 3.4 mm.
    assert 0.5e-3 < error.abs().median() < 3e-3
    lost = ((exact.depth > 0) & (noisy.depth == 0)).float().mean()
    assert 0.02 < lost < 0.35
    high = noisy.cloud[0, :, 2] > 0.02
    assert 0.3 < high.float().mean() < 1.0
    assert noisy.cloud.isfinite().all()


def test_rows_follow_their_own_seed_step_scale_and_pose(native):
    position, color, _ = native
    three, colors = position.repeat(3, 1, 1, 1), color.repeat(3, 1, 1, 1)
    pose = torch.tensor(CAMERA.T_base_camera).repeat(3, 1, 1)
    pose[2, :3, 3] += torch.tensor([0.004, 0.0, -0.002])
    scale = torch.tensor([1.0, 1.01, 1.0])
    batch = clouds(StereoDepth(), rows=3)
    batch.start(torch.arange(3), [7, 8, 7], scale=scale, T_base_camera=pose)
    together = batch.observe(three, torch.tensor([4, 4, 4]), colors)
    assert torch.equal(together.depth[0], together.depth[2])
    assert not torch.equal(together.cloud[0], together.cloud[2])
    for k, seed in enumerate((7, 8, 7)):
        alone = clouds(StereoDepth())
        alone.start(ROW, [seed], scale=scale[k : k + 1], T_base_camera=pose[k : k + 1])
        frame = alone.observe(position, [4], color)
        assert torch.equal(frame.depth[0], together.depth[k])
        assert torch.equal(frame.cloud[0], together.cloud[k])


def test_starting_one_row_leaves_the_others(native):
    position, color, _ = native
    two, colors = position.repeat(2, 1, 1, 1), color.repeat(2, 1, 1, 1)
    batch = clouds(StereoDepth(), rows=2)
    batch.start(torch.arange(2), [1, 2], scale=torch.tensor([0.99, 1.01]))
    before = batch.observe(two, [0, 5], colors)
    batch.start(torch.tensor([0]), [9])
    after = batch.observe(two, [0, 5], colors)
    assert torch.equal(before.depth[1], after.depth[1])
    assert not torch.equal(before.depth[0], after.depth[0])
    batch.start(torch.tensor([0]), [1], scale=torch.tensor([0.99]))
    assert torch.equal(batch.observe(two, [0, 5], colors).depth, before.depth)


def test_a_scale_error_stands_without_noise_too(native):
    position, _, _ = native
    camera = clouds(None)
    exact = camera.observe(position, [0]).depth
    camera.start(ROW, [0], scale=torch.tensor([1.01]))
    torch.testing.assert_close(camera.observe(position, [0]).depth, 1.01 * exact)


def test_coloured_clouds_carry_rgb(native):
    position, color, _ = native
    cloud = clouds(StereoDepth(), colors=True).observe(position, [0], color).cloud
    assert cloud.shape == (1, NUM_POINTS, 6)
    assert 0 <= cloud[..., 3:].min() <= cloud[..., 3:].max() <= 1
    known = {tuple(rgb) for rgb in color[0, ..., :3].reshape(-1, 3).tolist()}
    assert {tuple(rgb) for rgb in (cloud[0, :, 3:] * 255).round().int().tolist()} <= known


def test_colour_pictures_are_asked_for_only_where_they_matter():
    assert clouds(StereoDepth()).needs_color
    assert not clouds(replace(StereoDepth(), dark_level=0.0)).needs_color
    assert not clouds(None).needs_color
    assert clouds(None, colors=True).needs_color


def test_the_workspace_is_that_of_the_task():
    assert Box((0.15, -0.25, 0.003), (0.50, 0.25, 0.15)) == WORKSPACE
    with pytest.raises(ConfigError, match="does not run on ManiSkill"):
        workspace_of(point_mass_env.SOUND)
    with pytest.raises(UnknownNameError):
        workspace_of("ur3e/slide-blokc")
