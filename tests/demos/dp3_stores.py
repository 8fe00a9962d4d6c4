"""Tiny stores of DP3's layout, as the public tools write them."""

import numpy as np
import zarr

LENGTHS = (3, 5, 4)
FRAMES = sum(LENGTHS)
POINTS, DIM, ACTION_DIM = 8, 4, 3


def contents(channels=3, dtype="f4", seed=0):
    """Return the arrays of a store: name -> values, all of them in metres and [-1, 1]."""
    rng = np.random.default_rng(seed)
    return {
        "data/point_cloud": rng.uniform(0.1, 0.9, (FRAMES, POINTS, channels)).astype(dtype),
        "data/state": rng.uniform(-0.5, 0.5, (FRAMES, DIM)).astype(dtype),
        "data/action": rng.uniform(-1, 1, (FRAMES, ACTION_DIM)).astype(dtype),
        "meta/episode_ends": np.cumsum(LENGTHS),
    }


def write_dp3(path, changes=None, zarr_format=2, chunk_frames=5, consolidated=False, given=None, **coding):
    """Write a store; a change to None leaves an array out, `coding` goes to zarr's `create_array`."""
    group = zarr.open_group(str(path), mode="w", zarr_format=zarr_format)
    for name, values in {**(given or contents()), **(changes or {})}.items():
        if values is None:
            continue
        chunks = (chunk_frames, *values.shape[1:])
        array = group.create_array(name, shape=values.shape, chunks=chunks, dtype=values.dtype, **coding)
        array[:] = values
    if consolidated:
        zarr.consolidate_metadata(str(path), zarr_format=zarr_format)
    return path


def rows(values):
    """Return the rows of (N, C) in an order of their own: two sets of points are equal where these are."""
    return values[np.lexsort(values.T)]
