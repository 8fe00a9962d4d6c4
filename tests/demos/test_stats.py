"""Statistics against NumPy on the whole array at once."""

import numpy as np
import pytest

from manicm_ms.demos.stats import field_stats
from manicm_ms.errors import StoreError


@pytest.mark.parametrize("frames", [1, 511, 512, 1300])
def test_blocks_merge_to_the_statistics_of_the_whole(frames):
    rng = np.random.default_rng(0)
    array = rng.normal([3.0, -1e3, 0.0], [1e-3, 1.0, 50.0], size=(frames, 7, 3)).astype(np.float32)
    stats = field_stats(array)
    flat = array.reshape(-1, 3)
    np.testing.assert_array_equal(stats.min, flat.min(0))
    np.testing.assert_array_equal(stats.max, flat.max(0))
    np.testing.assert_allclose(stats.mean, flat.mean(0, dtype=np.float64), rtol=1e-6)
    np.testing.assert_allclose(stats.std, flat.std(0, dtype=np.float64), rtol=1e-5)
    assert {a.dtype for a in (stats.min, stats.max, stats.mean, stats.std)} == {np.dtype("float32")}


def test_nan_is_named():
    array = np.zeros((600, 2))
    array[555, 1] = np.nan
    with pytest.raises(StoreError, match="agent_pos holds NaN or infinity between frames 512"):
        field_stats(array, "agent_pos")


def test_empty_is_refused():
    with pytest.raises(StoreError, match="action is empty"):
        field_stats(np.zeros((0, 4)), "action")
