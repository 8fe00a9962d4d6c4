"""Windows against DP3's own index arithmetic, written out frame by frame."""

import numpy as np
import pytest
import torch

from manicm_ms.demos.sequence_dataset import SequenceDataset, sequence_index
from manicm_ms.errors import ConfigError
from manicm_ms.spec import ChunkSpec


def dp3_sequences(episode_ends, horizon, pad_before, pad_after):
    """Frames of every sequence as diffusion_policy's create_indices and sample_sequence choose them."""
    sequences = []
    for i, end in enumerate(episode_ends):
        start = 0 if i == 0 else episode_ends[i - 1]
        length = end - start
        for idx in range(-min(pad_before, horizon - 1), length - horizon + min(pad_after, horizon - 1) + 1):
            buffer_start, buffer_end = max(idx, 0) + start, min(idx + horizon, length) + start
            sample_start = buffer_start - (idx + start)
            sample_end = horizon - ((idx + horizon + start) - buffer_end)
            sample = [None] * horizon
            sample[sample_start:sample_end] = range(buffer_start, buffer_end)
            sample[:sample_start] = [buffer_start] * sample_start
            sample[sample_end:] = [buffer_end - 1] * (horizon - sample_end)
            sequences.append(sample)
    return sequences


@pytest.mark.parametrize("ends", [[5], [1, 4, 11], [3, 20, 22, 23], [2, 30]])
@pytest.mark.parametrize("shape", [(2, 4, 3), (2, 4, 2), (1, 1, 1), (2, 16, 8), (3, 8, 6), (1, 5, 1)])
def test_index_equals_dp3(ends, shape):
    chunk = ChunkSpec(*shape)
    ours = sequence_index(np.array(ends), chunk)
    theirs = dp3_sequences(ends, chunk.horizon, chunk.n_obs_steps - 1, chunk.n_action_steps - 1)
    assert ours.tolist() == theirs


@pytest.fixture
def arrays():
    frames = np.arange(12)
    cloud = frames[:, None, None] + np.zeros((12, 6, 3))
    return cloud, frames[:, None] + np.array([0.0, 100.0]), -frames[:, None] / 12.0, np.array([5, 12])


def test_batch_holds_the_frames_of_its_windows(arrays):
    chunk = ChunkSpec(2, 4, 3)
    windows = SequenceDataset.from_arrays(*arrays, chunk)
    assert len(windows) == 12
    picked = torch.tensor([0, 4, 5, 11])
    batch = windows.batch(picked)
    expected = torch.tensor(dp3_sequences([5, 12], 4, 1, 2))[picked]
    assert {k: (tuple(v.shape), v.dtype) for k, v in batch.items()} == {
        "point_cloud": ((4, 2, 6, 3), torch.float32),
        "agent_pos": ((4, 2, 2), torch.float32),
        "action": ((4, 4, 1), torch.float32),
    }
    assert torch.equal(batch["point_cloud"][:, :, 5, 2], expected[:, :2].float())
    assert torch.equal(batch["agent_pos"][:, :, 1], expected[:, :2] + 100.0)
    torch.testing.assert_close(batch["action"][:, :, 0], -expected / 12.0)


def test_windows_do_not_share_memory_with_the_arrays(arrays):
    cloud = arrays[0].astype(np.float32)
    windows = SequenceDataset.from_arrays(cloud, *arrays[1:], ChunkSpec())
    cloud[:] = -1
    assert windows.point_cloud.min() == 0


def test_no_window_is_refused(arrays):
    with pytest.raises(ConfigError, match="no window of horizon 40"):
        SequenceDataset.from_arrays(*arrays, ChunkSpec(1, 40, 1))


def test_arrays_of_different_length_are_refused(arrays):
    with pytest.raises(ConfigError, match="differ in length"):
        SequenceDataset.from_arrays(arrays[0][:-1], *arrays[1:], ChunkSpec())
