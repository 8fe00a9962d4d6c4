"""Videos show the evaluated episodes: same actions, same outcome, readable by a decoder."""

import imageio_ffmpeg
import numpy as np
import pytest
from point_mass import PointMass, Proportional

from manicm_ms.evaluation.rollout import EpisodeResult, rollout
from manicm_ms.evaluation.video import Mp4Writer, Take, choose_seeds, film


def decode(path):
    """Return (size (W, H), frames (T, H, W, 3))."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    return meta, np.stack([np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader])


def outcome(seed, success, crashed=None):
    return EpisodeResult(seed, success, 1, 1, 0.0, crashed)


def test_seeds_show_every_kind_of_outcome_before_any_kind_twice():
    first = [outcome(s, s in (1, 2, 3, 4)) for s in range(1, 9)]
    second = [outcome(s, s in (1, 2, 3, 5)) for s in range(1, 9)]
    # 1-3 both, 4 first alone, 5 second alone, 6-8 neither
    assert choose_seeds(first, second, 4) == [1, 4, 5, 6]
    assert choose_seeds(first, second, 6) == [1, 4, 5, 6, 2, 7]
    assert choose_seeds(first, second, 0) == []
    assert len(choose_seeds(first, second, 99)) == 8


def test_crashed_episodes_are_not_filmed():
    first, second = [outcome(1, False, "boom"), outcome(2, True)], [outcome(1, True), outcome(2, True)]
    assert choose_seeds(first, second, 4) == [2]


@pytest.mark.parametrize("rows", [1, 2, 5])
def test_a_film_repeats_the_recorded_episode(tmp_path, rows):
    results = rollout(PointMass(3), Proportional(gain=2.0, noise_scale=0.6), [102, 100, 119])
    assert {r.success for r in results} == {True, False}
    takes = [Take(r, tmp_path / f"{r.seed}.mp4") for r in results]
    filmed = list(film(PointMass(rows, chunk=None), takes, fps=20.0))
    assert [take.episode.seed for take, _ in filmed] == [102, 100, 119]
    assert [success for _, success in filmed] == [r.success for r in results]
    for take in takes:
        meta, frames = decode(take.path)
        assert meta["codec"] == "h264"
        assert meta["fps"] == 20
        assert len(frames) == take.episode.steps + 1 + round(0.6 * 20)
    moved = np.abs(frames[0].astype(int) - frames[-1]).max()
    assert moved > 60, "the point should have moved"


def test_an_odd_size_loses_a_row_and_colours_survive(tmp_path):
    picture = np.zeros((49, 65, 3), np.uint8)
    picture[:, :32] = (200, 30, 30)
    with Mp4Writer(tmp_path / "a.mp4", (49, 65), 10) as writer:
        for _ in range(5):
            writer.add(picture)
    _, frames = decode(tmp_path / "a.mp4")
    assert frames.shape == (5, 48, 64, 3)
    assert np.abs(frames[2, 24, 10].astype(int) - (200, 30, 30)).max() < 25
    assert frames[2, 24, 55].max() < 25


def test_a_failed_recording_leaves_no_file(tmp_path):
    def record():
        with Mp4Writer(tmp_path / "a.mp4", (48, 64), 10) as writer:
            writer.add(np.zeros((48, 64, 3), np.uint8))
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        record()
    assert list(tmp_path.iterdir()) == []
