"""Crops against torchvision's and against a search for the window that a random one was taken from."""

import pytest
import torch
from policy_specs import make_spec
from torchvision_oracle import functional

from manicm_ms.errors import ConfigError
from manicm_ms.policies.encoders.crop import ImageCrop, ImageCropConfig, VoxelCrop, VoxelCropConfig, kept_side

SPEC = make_spec()


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_the_published_sizes_are_kept():
    image, voxel = ImageCropConfig().share, VoxelCropConfig().share
    assert [kept_side(84, image), kept_side(64, voxel), kept_side(32, voxel)] == [76, 58, 29]


@pytest.mark.parametrize(("height", "width"), [(84, 84), (32, 31), (6, 8)])
def test_the_middle_of_an_image_is_torchvisions(height, width):
    image = torch.randint(256, (3, 2, height, width, 3), generator=generator(), dtype=torch.uint8)
    crop = ImageCrop(ImageCropConfig(), SPEC)
    seen = crop.read_acting({"image": image}, torch.zeros(3, 4, 3))["image"]
    size = [kept_side(height, 76 / 84), kept_side(width, 76 / 84)]
    assert seen.dtype == torch.uint8
    assert torch.equal(seen.movedim(-1, 2), functional.center_crop(image.movedim(-1, 2), size))


def test_the_middle_of_a_grid_is_torchvisions_along_each_axis():
    grid = torch.randint(256, (2, 2, 1, 32, 32, 32), generator=generator(), dtype=torch.uint8)
    seen = VoxelCrop(VoxelCropConfig(), SPEC).read_acting({"voxel_grid": grid}, torch.zeros(2, 4, 3))["voxel_grid"]
    planes = functional.center_crop(grid, [29, 29])  # y and z
    assert torch.equal(seen, functional.center_crop(planes.transpose(-1, -3), [29, 29]).transpose(-1, -3))


def windows(frame, shape):
    """Every part of `shape` of a frame, place -> part."""
    rests = [range(side - kept + 1) for side, kept in zip(frame.shape, shape, strict=True)]
    places = torch.cartesian_prod(*[torch.tensor(rest) for rest in rests]).tolist()
    return {tuple(p): frame[tuple(slice(a, a + k) for a, k in zip(p, shape, strict=True))] for p in places}


@pytest.mark.parametrize(
    ("crop", "shape", "cropped"),
    [
        (ImageCrop(ImageCropConfig(0.8), SPEC), (10, 15, 3), (8, 12, 3)),
        (VoxelCrop(VoxelCropConfig(0.8), SPEC), (4, 5, 5, 5), (4, 4, 4, 4)),
    ],
)
def test_a_random_part_is_one_of_all_parts_and_every_frame_has_its_own(crop, shape, cropped):
    frames = torch.randint(256, (20, 2, *shape), generator=generator(), dtype=torch.uint8)
    obs = {crop.key: frames, "agent_pos": torch.zeros(20, 2, 5)}
    assert crop.varies(obs)
    seen = crop.read_training(obs, generator(1))
    assert seen["agent_pos"] is obs["agent_pos"]
    assert (seen[crop.key].shape, seen[crop.key].dtype) == ((20, 2, *cropped), torch.uint8)
    places = []
    for frame, part in zip(frames.flatten(0, 1), seen[crop.key].flatten(0, 1), strict=True):
        places += [place for place, window in windows(frame, cropped).items() if torch.equal(window, part)]
    possible = len(windows(frames[0, 0], cropped))
    assert len(places) == 40  # each is found once
    assert possible / 2 < len(set(places)) <= possible  # all places are drawn, to both ends
    assert any(a != b for a, b in zip(places[::2], places[1::2], strict=True))  # the frames of one row differ
    again = crop.read_training(obs, generator(1))[crop.key]
    assert torch.equal(again, seen[crop.key])


def test_a_whole_frame_does_not_vary_and_a_senseless_share_is_refused():
    crop = ImageCrop(ImageCropConfig(1.0), SPEC)
    image = torch.randint(256, (1, 2, 6, 8, 3), generator=generator(), dtype=torch.uint8)
    assert not crop.varies({"image": image})
    assert torch.equal(crop.read_training({"image": image}, generator())["image"], image)
    with pytest.raises(ConfigError, match=r"must lie in \(0, 1\], got 1.5"):
        VoxelCropConfig(1.5)
