"""Writes a data set with another project's library from episodes on standard input: the child of `writer.py`.

It runs in a process of its own because that library may need another interpreter than ours (lerobot pins its own torch)
or may not outlive a full disk (HDF5 crashes). So it imports nothing of ours.

usage: python -I child.py {lerobot,minari} ROOT

Each message on standard input is its length, 8 bytes little-endian, and an npz file: first one whose array `job` is
JSON text, then one an episode.
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

LENGTH_BYTES = 8
Arrays = dict[str, np.ndarray]


def pack(arrays: dict[str, Any]) -> bytes:
    """Return the message that carries arrays by name."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    content = buffer.getvalue()
    return len(content).to_bytes(LENGTH_BYTES, "little") + content


def unpack(stream: BinaryIO) -> Iterator[Arrays]:
    """Yield the arrays of each message; raise EOFError where the stream ends within one."""
    while head := stream.read(LENGTH_BYTES):
        size = int.from_bytes(head, "little")
        content = stream.read(size)
        if len(head) < LENGTH_BYTES or len(content) < size:
            raise EOFError("the stream of episodes was cut short")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            yield dict(arrays)


def write_lerobot(root: Path, job: dict[str, Any], episodes: Iterator[Arrays]) -> None:
    """Write a LeRobotDataset at `root`, which must not exist.

    The job holds what `LeRobotDataset.create` takes, and `task`; an episode maps each feature to (L, ...) values.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    task = job.pop("task")
    for feature in job["features"].values():
        feature["shape"] = tuple(feature["shape"])  # a tuple does not survive JSON, and lerobot compares it
    dataset = LeRobotDataset.create(root=root, use_videos=False, **job)
    for episode in episodes:
        for k in range(len(episode["action"])):
            dataset.add_frame({name: values[k] for name, values in episode.items()} | {"task": task})
        dataset.save_episode()
    dataset.finalize()


def write_minari(root: Path, job: dict[str, Any], episodes: Iterator[Arrays]) -> None:
    """Write a Minari data set in the folder `root`, which must not exist, with pictures as they are (no JPEG).

    The job holds `metadata`, and `spaces`: name -> (low, high, shape, type) of each observation and of "action". An
    episode maps each observation to (L + 1, ...) values, and holds `action`, `reward`, `termination`, `truncation`
    (L, ...), `seed` (negative: not known) and `success`.
    """
    import minari
    from gymnasium.spaces import Box, Dict
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    boxes: dict[str, Any] = {
        n: Box(low, high, tuple(shape), np.dtype(kind).type) for n, (low, high, shape, kind) in job["spaces"].items()
    }
    action_space = boxes.pop("action")
    (root / "data").mkdir(parents=True)
    storage = MinariStorage.new(
        root / "data", observation_space=Dict(boxes), action_space=action_space, jpeg_encoding=False
    )
    storage.update_metadata({**job["metadata"], "minari_version": minari.__version__})
    for number, episode in enumerate(episodes):
        seed, success = int(episode.pop("seed")), bool(episode.pop("success"))
        buffer = EpisodeBuffer(
            seed=seed if seed >= 0 else None,
            actions=episode.pop("action"),
            rewards=episode.pop("reward"),
            terminations=episode.pop("termination"),
            truncations=episode.pop("truncation"),
            infos={},
            observations=episode,
        )
        storage.update_episodes([buffer])
        storage.update_episode_metadata([{"success": success}], [number])


WRITERS = {"lerobot": write_lerobot, "minari": write_minari}


def main(format: str, root: str) -> None:
    """Write the data set that standard input holds."""
    messages = unpack(sys.stdin.buffer)
    job = json.loads(str(next(messages)["job"]))
    WRITERS[format](Path(root), job, messages)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
