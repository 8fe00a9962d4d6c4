"""The depth camera's errors against what is known of them: the facts of the D435i, closed forms and geometry."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from manicm_ms.errors import ConfigError
from manicm_ms.sensing.camera import Crop
from manicm_ms.sensing.camera_files import default_camera
from manicm_ms.sensing.stereo_depth import StereoDepth, hidden_from_right, incidence_cosine, window_noise

CAMERA = default_camera()
FOCAL_BASELINE = CAMERA.fx * 0.050  # px m
H, W = CAMERA.crop.height, CAMERA.crop.width
EXACT = StereoDepth(
    subpixel_sigma=0, subpixel_steps=0, fattening=(0, 0), flying=0, dropout=0, blobs=0, grazing=(90, 90), dark_level=0
)
"""Nothing but what geometry asks for: shadows, the left band and the range of distances."""
MICRO = replace(CAMERA, depth_unit=2e-5)
"""The camera with units so fine that rounding does not show; it reads up to 1.31 m."""
# mm at z metres for s = 0.08 px, 640x480, B = 50 mm: z^2 s / (f B) with Intel's s (librealsense issue 3904).
TABLE = {0.3: 0.37, 0.4: 0.67, 0.5: 1.04, 0.6: 1.50, 0.7: 2.04, 0.8: 2.67, 1.0: 4.17}


def plane(z, rows=1):
    return torch.full((rows, H, W), float(z))


def run(model, depth, camera=CAMERA, seed=0, frame=0, **options):
    """Apply the model with seeds that count up from `seed`."""
    n = len(depth)
    return model.apply(depth, camera, range(seed, seed + n), [frame] * n, **options)


def step_scene(near, far, first, last=W, rows=1):
    """A near wall in columns first..last-1 before a far one."""
    depth = plane(far, rows)
    depth[:, :, first:last] = near
    return depth


# ---- noise


@pytest.mark.parametrize(("z", "sigma_mm"), TABLE.items())
def test_sigma_of_a_plane_is_that_of_the_table(z, sigma_mm):
    noisy = run(replace(EXACT, subpixel_sigma=0.08), plane(z, rows=8), MICRO)
    measured = 1e3 * (noisy - z).std().item()
    assert measured == pytest.approx(sigma_mm, rel=0.02, abs=0.005)  # the table's own rounding
    assert 1e3 * float(StereoDepth().sigma(torch.tensor(z), CAMERA)) == pytest.approx(sigma_mm, abs=0.006)
    assert abs((noisy - z).mean().item()) < 0.1e-3 * sigma_mm + 1e-5


@pytest.mark.parametrize("z", [0.3, 0.6, 1.0])
def test_steps_of_disparity_and_of_millimetres_add_their_variance(z):
    ramp = torch.linspace(-0.01, 0.01, W)  # m: over many steps of either kind, so that their phase averages out
    clean = plane(z, rows=8) + ramp
    noisy = run(replace(EXACT, subpixel_sigma=0.08, subpixel_steps=32), clean)
    slope = z * z / FOCAL_BASELINE  # m per px
    expected = np.sqrt((slope * 0.08) ** 2 + (slope / 32) ** 2 / 12 + 0.001**2 / 12)
    assert (noisy - clean).std().item() == pytest.approx(expected, rel=0.02)


def test_errors_are_alike_within_the_window_and_of_unit_variance():
    noise = window_noise(torch.randn(40, 206, 206, generator=torch.Generator().manual_seed(1)), 7)
    assert noise.shape == (40, 200, 200)
    for i, j in ((0, 0), (0, 1), (0, 3), (2, 2), (5, 0), (0, 7), (9, 9)):
        product = (noise[:, i:, j:] * noise[:, : 200 - i, : 200 - j]).mean().item()
        expected = max(0, 1 - i / 7) * max(0, 1 - j / 7)
        assert product == pytest.approx(expected, abs=0.02)


def test_disparity_comes_in_steps_of_a_thirty_second_pixel():
    noisy = run(replace(EXACT, subpixel_sigma=0.08, subpixel_steps=32), plane(0.9), MICRO)
    disparity = FOCAL_BASELINE / noisy * 32
    # Rounding to 20 micrometres blurs a step by 1e-5 m * 32 f B / z^2, 0.8 % of it.
    assert (disparity - disparity.round()).abs().max() < 0.01
    assert len(disparity.round().unique()) > 5


def test_readings_are_whole_units():
    raw = run(StereoDepth(), plane(0.6)).double() / CAMERA.depth_unit
    assert (raw - raw.round()).abs().max() < 1e-4
    assert len(raw.round().unique()) > 5


def test_scale_error_multiplies_a_rows_readings():
    scale = torch.tensor([0.995, 1.0, 1.008])
    read = run(EXACT, plane(0.7, rows=3), MICRO, scale=scale)
    torch.testing.assert_close(read.mean(dim=(1, 2)), 0.7 * scale, atol=1e-5, rtol=0)


# ---- geometry


@pytest.mark.parametrize(("near", "far"), [(0.4, 0.6), (0.5, 0.55), (0.55, 0.6), (0.3, 0.9)])
def test_shadow_left_of_a_near_surface_has_the_width_of_the_formula(near, far):
    first = 150
    read = run(EXACT, step_scene(near, far, first))[0]
    width = FOCAL_BASELINE * (1 / near - 1 / far)
    hidden = (read == 0).sum(dim=1)
    assert (hidden - width).abs().max() <= 1
    assert (read[:, first - int(width) : first] == 0).all()
    assert (read[:, first:] > 0).all()
    assert (read[:, : first - int(width) - 1] > 0).all()


def test_shadow_equals_lines_of_sight_of_the_right_imager():
    """A pixel is hidden where the line from its point to the right imager passes through the near wall."""
    near, far, first, last = 0.45, 0.62, 90, 230
    depth = step_scene(near, far, first, last)[0]
    x = (torch.arange(W, dtype=torch.float64) + CAMERA.crop.left - CAMERA.cx) / CAMERA.fx
    crossing = 0.050 + (x * far - 0.050) * near / far  # where the line meets the near wall's plane, m
    blocked = (crossing > x[first] * near) & (crossing < x[last - 1] * near)
    expected = (blocked & (depth[0] == far)).expand(H, W)
    assert 5 < expected[0].sum() < 30
    assert torch.equal(hidden_from_right(FOCAL_BASELINE / depth), expected)


@pytest.mark.parametrize("slope", [-2.4, -1.0, 0.0, 1.0, 2.4])
def test_a_plane_does_not_hide_itself(slope):
    x = (torch.arange(W) + CAMERA.crop.left - CAMERA.cx) / CAMERA.fx
    depth = (0.6 / (1 - slope * x)).expand(1, H, W)
    assert depth.min() > 0.2
    assert not hidden_from_right(FOCAL_BASELINE / depth).any()


def test_left_border_of_the_image_gives_no_reading():
    whole = replace(CAMERA, crop=Crop(0, 0, CAMERA.width, CAMERA.height))
    for z in (0.3, 0.7):
        read = run(EXACT, torch.full((1, CAMERA.height, CAMERA.width), z), whole)[0]
        band = (read == 0).all(dim=0)
        assert int(band.sum()) == int(np.ceil(FOCAL_BASELINE / z))
        assert band[: int(band.sum())].all()
        assert (read[:, ~band] > 0).all()


def test_nearer_than_the_search_reaches_and_farther_than_the_range_is_not_read():
    nearest = EXACT.min_distance(CAMERA)
    assert nearest == pytest.approx(0.152, abs=5e-4)  # librealsense: fx B / 126 is 152 mm at 640x480
    assert (run(EXACT, plane(nearest - 0.001)) == 0).all()
    assert (run(EXACT, plane(nearest + 0.001)) > 0).all()
    assert (run(EXACT, plane(9.9)) > 0).all()
    assert (run(EXACT, plane(10.1)) == 0).all()


def test_near_surfaces_grow_by_two_to_four_pixels():
    near, far, first, last = 0.5, 0.7, 100, 200
    read = run(replace(EXACT, fattening=(2, 4)), step_scene(near, far, first, last), MICRO)[0]
    right = (read[:, last : last + 10] < 0.6).sum(dim=1)
    assert set(right.tolist()) == {2, 3, 4}
    assert (read[:, last + 4 :] > 0.6).all()
    shadow = FOCAL_BASELINE * (1 / near - 1 / far)
    left = (read[:, : first + 1] == 0).sum(dim=1)
    assert (left - shadow).abs().max() <= 1  # the shadow keeps its width and starts left of the grown edge


def test_a_slanted_plane_has_no_edges():
    x = (torch.arange(W) + CAMERA.crop.left - CAMERA.cx) / CAMERA.fx
    depth = (0.5 / (1 - 1.5 * x)).expand(1, H, W)  # 56 degrees
    fat = run(replace(EXACT, fattening=(2, 4)), depth, MICRO)
    torch.testing.assert_close(fat, depth.contiguous(), atol=1.1e-5, rtol=0)


def test_some_grown_pixels_fly_between_the_surfaces():
    near, far, last = 0.5, 0.7, 200
    scene = step_scene(near, far, 0, last, rows=8)
    read = run(replace(EXACT, fattening=(3, 3), flying=0.2), scene, MICRO)[:, :, last : last + 3]
    flying = (read > near + 1e-4) & (read < far - 1e-4)
    assert flying.float().mean().item() == pytest.approx(0.2, abs=0.02)
    assert ((read - near).abs()[~flying] < 1e-4).float().mean() > 0.999


# ---- holes


def share_lost(model, depth, **options):
    return (run(model, depth, **options) == 0).float().mean().item()


def test_single_pixels_drop_out_at_their_rate():
    n = 4 * H * W
    rate = share_lost(replace(EXACT, dropout=0.02), plane(0.6, rows=4))
    assert rate == pytest.approx(0.02, abs=4 * np.sqrt(0.02 * 0.98 / n))


def test_patches_drop_out_at_their_rate_and_are_patches():
    lost = run(replace(EXACT, blobs=0.03), plane(0.6, rows=40)) == 0
    assert lost.float().mean().item() == pytest.approx(0.03, rel=0.12)
    beside = (lost[:, :, 1:] & lost[:, :, :-1]).float().mean() / lost.float().mean()
    assert beside > 0.6  # single pixels at that rate would have 0.03


@pytest.mark.parametrize(("intensity", "rate"), [(0.0, 0.5), (0.075, 0.25), (0.15, 0.0), (0.9, 0.0)])
def test_dark_surfaces_lose_readings(intensity, rate):
    model = replace(EXACT, dark_level=0.15, dark_dropout=0.5)
    lost = share_lost(model, plane(0.6), intensity=torch.full((1, H, W), intensity))
    assert lost == pytest.approx(rate, abs=0.01)


def tilted(angle):
    """A plane through the middle of the image whose normal there makes `angle` degrees with the ray."""
    normal = np.array([np.sin(np.deg2rad(angle)), 0.0, -np.cos(np.deg2rad(angle))])
    return plane_depth(normal, point=(0, 0, 0.6))


def rays():
    u, v = np.meshgrid(np.arange(W) + CAMERA.crop.left, np.arange(H) + CAMERA.crop.top)
    return np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones((H, W))], axis=-1)


def plane_depth(normal, point):
    depth = (normal @ np.asarray(point)) / (rays() @ normal)
    return torch.from_numpy(np.where((depth > 0.2) & (depth < 2), depth, 0).astype(np.float32))[None]


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.5, 0.2, -1), (-0.3, 0.9, -0.6), (0.1, -1.5, -0.6)])
def test_incidence_is_that_of_the_plane(normal):
    normal = np.array(normal) / np.linalg.norm(normal)
    depth = plane_depth(normal, (0, 0, 0.6))
    cosine = incidence_cosine(torch.where(depth > 0, FOCAL_BASELINE / depth, 0.0), CAMERA)[0].numpy()
    expected = np.abs(rays() @ normal) / np.linalg.norm(rays(), axis=-1)
    hit = depth[0].numpy() > 0
    assert hit.mean() > 0.4
    np.testing.assert_allclose(cosine[hit], expected[hit], atol=2e-3)


def test_rims_are_not_taken_for_steep_surfaces():
    depth = step_scene(0.5, 0.7, 100, 200)
    assert share_lost(replace(EXACT, grazing=(70, 80)), depth) == share_lost(EXACT, depth)


@pytest.mark.parametrize(("angle", "low", "high"), [(40, 0, 0), (60, 0, 0), (75, 0.3, 0.7), (85, 1, 1)])
def test_grazing_surfaces_lose_readings(angle, low, high):
    middle = slice(W // 2 - 6, W // 2 + 6)  # where the angle is what it says, to a degree
    read = run(replace(EXACT, grazing=(70, 80)), tilted(angle))[0, :, middle]
    assert low <= (read == 0).float().mean().item() <= high


# ---- rows, seeds, safety


def scenes(rows):
    generator = torch.Generator().manual_seed(2)
    depth = 0.5 + 0.3 * torch.rand(rows, 6, 6, generator=generator)
    depth = depth.repeat_interleave(51, 1).repeat_interleave(51, 2)[:, :H, :W].contiguous()
    depth[:, :20, :30] = 0.0
    return depth, torch.rand(rows, H, W, generator=generator)


def test_a_row_does_not_depend_on_the_other_rows():
    depth, intensity = scenes(8)
    seeds, frames, scale = list(range(40, 48)), [0, 3, 1, 0, 0, 7, 2, 5], torch.linspace(0.99, 1.01, 8)
    together = StereoDepth().apply(depth, CAMERA, seeds, frames, intensity=intensity, scale=scale)
    assert 0.02 < (together == 0).float().mean() < 0.6
    for k in (0, 3, 7):
        one = slice(k, k + 1)
        alone = StereoDepth().apply(
            depth[one], CAMERA, seeds[one], frames[one], intensity=intensity[one], scale=scale[one]
        )
        assert torch.equal(alone[0], together[k])


def test_the_same_seed_and_frame_give_the_same_noise_and_others_do_not():
    depth, _ = scenes(1)
    first = run(StereoDepth(), depth, seed=5, frame=2)
    assert torch.equal(first, run(StereoDepth(), depth, seed=5, frame=2))
    assert not torch.equal(first, run(StereoDepth(), depth, seed=5, frame=3))
    assert not torch.equal(first, run(StereoDepth(), depth, seed=6, frame=2))


def test_whatever_the_scene_readings_are_finite_and_in_range():
    odd = torch.tensor([0.0, 1e-6, 0.05, 0.1521, 0.6, 9.99, 80.0, 1e6])
    pick = torch.randint(len(odd), (4, H, W), generator=torch.Generator().manual_seed(0))
    read = run(StereoDepth(), odd[pick], intensity=torch.zeros(4, H, W))
    assert read.isfinite().all()
    assert read.min() == 0
    assert read.max() <= 10.0
    assert read.dtype == torch.float32
    assert not run(StereoDepth(), torch.zeros(1, H, W)).any()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_device_draws_from_the_same_law():
    there = run(StereoDepth(), plane(0.6, rows=8).cuda()).cpu()
    here = run(StereoDepth(), plane(0.6, rows=8))
    assert there[there > 0].std().item() == pytest.approx(here[here > 0].std().item(), rel=0.05)
    assert (there == 0).float().mean().item() == pytest.approx((here == 0).float().mean().item(), abs=0.005)


@pytest.mark.parametrize(
    "change",
    [
        {"window": 4},
        {"baseline": 0},
        {"dropout": 1.5},
        {"fattening": (4, 2)},
        {"grazing": (80, 70)},
        {"subpixel_sigma": -1},
    ],
)
def test_fields_out_of_range_are_refused(change):
    with pytest.raises(ConfigError, match=next(iter(change))):
        StereoDepth(**change)
