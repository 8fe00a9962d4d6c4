"""Writes a LeRobotDataset from episodes on standard input. Run by a Python that has lerobot; it needs nothing of ours.

usage: python -I lerobot_writer.py ROOT

Each message on standard input is its length, 8 bytes little-endian, and an npz file: first one whose array `job` is
JSON text (repo_id, fps, robot_type, features, task), then one an episode: feature -> (L, ...) values.
"""

from __future__ import annotations

import io
import json
import sys
from typing import Any, BinaryIO

import numpy as np

LENGTH_BYTES = 8


def pack(arrays: dict[str, Any]) -> bytes:
    """Return the message that carries arrays by name."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    content = buffer.getvalue()
    return len(content).to_bytes(LENGTH_BYTES, "little") + content


def unpack(stream: BinaryIO) -> dict[str, np.ndarray] | None:
    """Return the arrays of the next message, or None where the stream has ended between two."""
    head = stream.read(LENGTH_BYTES)
    if not head:
        return None
    size = int.from_bytes(head, "little")
    content = stream.read(size)
    if len(head) < LENGTH_BYTES or len(content) < size:
        raise EOFError("the stream of episodes was cut short")
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


def write(root: str, stream: BinaryIO) -> None:
    """Write the data set at `root`, which must not exist."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    first = unpack(stream)
    if first is None:
        raise EOFError("the stream of episodes is empty")
    job = json.loads(str(first["job"]))
    task = job.pop("task")
    for feature in job["features"].values():
        feature["shape"] = tuple(feature["shape"])  # a tuple does not survive JSON, and lerobot compares it
    dataset = LeRobotDataset.create(root=root, use_videos=False, **job)
    while (episode := unpack(stream)) is not None:
        for k in range(len(episode["action"])):
            dataset.add_frame({name: values[k] for name, values in episode.items()} | {"task": task})
        dataset.save_episode()
    dataset.finalize()


if __name__ == "__main__":
    write(sys.argv[1], sys.stdin.buffer)
