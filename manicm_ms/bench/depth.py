"""Times the model of the depth camera and the way to a cloud, a frame of one row and batches.

The scene is a table with a box on it, seen by the shipped camera.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from manicm_ms.bench.pages import publish, results_page
from manicm_ms.errors import require_at_least
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.camera_files import default_camera
from manicm_ms.sensing.depth_cloud import depth_to_cloud
from manicm_ms.sensing.point_cloud import Box
from manicm_ms.sensing.stereo_depth import StereoDepth

PAGE = "depth_camera.md"
WORKSPACE = Box((0.15, -0.25, 0.003), (0.50, 0.25, 0.15))  # of the UR3e tasks
BOX = Box((0.28, -0.04, 0.0), (0.34, 0.02, 0.06))  # m, robot-base frame


@dataclass(frozen=True)
class Options:
    """What to measure.

    Attributes:
        rows: numbers of rows.
        repetitions: frames timed for each of them.
        device: torch device.
    """

    rows: tuple[int, ...]
    repetitions: int
    device: torch.device

    def __post_init__(self) -> None:
        for rows in self.rows:
            require_at_least(1, rows=rows)


def scene(camera: CameraModel) -> Tensor:
    """Return the exact depth (h, w) m of a table with a box on it: the nearest of the planes that a ray meets."""
    left, top, width, height = camera.crop
    u, v = np.meshgrid(np.arange(left, left + width), np.arange(top, top + height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    directions, eye = rays @ camera.pose[:3, :3].T, camera.pose[:3, 3]
    depth = -eye[2] / directions[..., 2]  # a ray has z = 1 in camera axes: its length is its depth
    low, high = ((np.array(corner) - eye) / directions for corner in BOX)
    enter, leave = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
    return torch.from_numpy(np.where(enter < leave, enter, depth).astype(np.float32))


def milliseconds(run: Callable[[], object], repetitions: int, device: torch.device) -> float:
    """Return the median time of a call after a few calls of warm-up: of the CPU, or by the clock with a device."""
    clock = time.thread_time if device.type == "cpu" else time.perf_counter  # other work on the CPU does not count
    times = []
    for _ in range(repetitions + 5):
        begin = clock()
        run()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(1e3 * (clock() - begin))
    return float(np.median(times[5:]))


def table(options: Options, camera: CameraModel) -> str:
    """Return the Markdown table of all numbers of rows."""
    model = StereoDepth()
    lines = ["| rows | depth model | to the cloud | both, a row |", "|---|---|---|---|"]
    for n in options.rows:
        depth = scene(camera).to(options.device).repeat(n, 1, 1)
        intensity = torch.full_like(depth, 0.5)

        def noisy(depth: Tensor = depth, intensity: Tensor = intensity, n: int = n) -> Tensor:
            return model.apply(depth, camera, range(n), [0] * n, intensity=intensity)

        read = noisy()

        def clouds(read: Tensor = read) -> Tensor:
            return depth_to_cloud(read, camera, WORKSPACE, 512)

        model_ms = milliseconds(noisy, options.repetitions, options.device)
        cloud_ms = milliseconds(clouds, options.repetitions, options.device)
        lines.append(f"| {n} | {model_ms:.1f} ms | {cloud_ms:.1f} ms | {(model_ms + cloud_ms) / n:.1f} ms |")
    return "\n".join(lines)


def page(options: Options, camera: CameraModel, body: str, command: str) -> str:
    """Return the page around the table, which names `command` as its origin."""
    on_gpu = options.device.type == "cuda"
    name = torch.cuda.get_device_name(options.device) if on_gpu else f"one thread of {platform.machine()}"
    load = os.getloadavg()[0]
    clock = "Time" if on_gpu else "CPU time"
    return f"""# Cost of the depth camera's model

From an exact depth picture of {camera.crop.width}x{camera.crop.height} pixels to the readings of the D435i's model, and
from these to a cloud of 512 points, as a worker does it. Every effect is on; rendering is not in it. {clock}, median of
{options.repetitions} frames; {name}, torch {torch.__version__}, load {load:.1f} on {os.cpu_count()} cores.

{body}

Made by `{command}`.
"""


def bench(options: Options, write: bool, command: str) -> None:
    """Measure, print the page, and keep it in docs/results where `write` says so."""
    kept = results_page(PAGE) if write else None
    torch.set_num_threads(1)  # as in a worker
    camera = default_camera()
    publish(page(options, camera, table(options, camera), command), kept)
