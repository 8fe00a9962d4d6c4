"""What `manicm-ms cloud` does: a recorded depth image becomes the cloud that a policy would see."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from torch import Tensor

from manicm_ms.errors import CameraError, ConfigError
from manicm_ms.paths import require_free, write_bytes
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.camera_files import read_camera
from manicm_ms.sensing.depth_cloud import CLOUD_SIZE, depth_to_cloud
from manicm_ms.sensing.depth_images import read_depth
from manicm_ms.sensing.point_cloud import Box, inside
from manicm_ms.sensing.realism import resolve_realism

Pose = NDArray[Any]


def cloud(depth: Path, camera: Path, out: Path, env: str, realism: str, num_points: int, overwrite: bool) -> None:
    """Write the cloud of a recorded depth image and say what became of its readings.

    Raises:
        CameraError: camera file or depth image cannot be used, or nothing of the workspace is seen.
        ConfigError: `out` has another ending than .ply or .npy, or `num_points` is not 1 to the pixels that there are.
        UnknownNameError: no such environment or realism preset.
        OutputExistsError: `out` exists and is not to be replaced.
    """
    if out.suffix not in _WRITERS:
        raise ConfigError(f"cannot write {out}: name a file that ends in {' or '.join(_WRITERS)}")
    require_free(out, overwrite)
    most = CLOUD_SIZE[0] * CLOUD_SIZE[1]
    if not 1 <= num_points <= most:
        raise ConfigError(
            f"--num-points must be 1 to {most}, the pixels of the {CLOUD_SIZE[1]}x{CLOUD_SIZE[0]} picture that become "
            f"points, got {num_points}"
        )
    crop_floor = resolve_realism(realism).crop_floor
    model = read_camera(camera)
    readings = model.cropped(read_depth(depth, model))
    from manicm_ms.envs.maniskill import workspace_of  # seconds of a simulator's import: errors of files come first

    box = workspace_of(env).raised(crop_floor)
    points = depth_to_cloud(readings[None], model, box, num_points)[0].numpy()
    if not points.any():
        raise CameraError(
            f"{depth} shows nothing of the workspace of {env}: {why_nothing_is_seen(readings, model, box)}"
        )
    write_bytes(out, _WRITERS[out.suffix](points))
    distinct = len(np.unique(points, axis=0))
    count = int((readings > 0).sum())
    print(
        f"{out}: {num_points} points, {distinct} of them distinct, of {count} readings in the crop; "
        f"{100 * _seen(readings, model, box):.0f} % of these lie in the workspace"
    )
    if (far := float((readings > _FAR_M).sum()) / count) > _NOTABLE:
        print(f"{100 * far:.0f} % of the readings are beyond {_FAR_M:g} m: does the camera write 65535 for no reading?")
    if distinct < min(num_points, _FEW):
        print(f"only {distinct} points are seen: {why_nothing_is_seen(readings, model, box)}")


def why_nothing_is_seen(readings: Tensor, camera: CameraModel, box: Box) -> str:
    """Return where the readings lie, where the workspace is, and the likely cause that the one is not in the other.

    Args:
        readings: (h, w) float32 of the camera's crop, metres; 0 = no reading.
        camera: as the file says.
        box: the workspace, robot-base frame, metres.
    """
    points = _in_base(readings, camera)
    spans = (f"{axis} {low:.2f} to {high:.2f}" for axis, low, high in zip("xyz", box.low, box.high, strict=True))
    found = np.percentile(points, (2, 98), axis=0).T
    lies = (f"{axis} {low:.2f} to {high:.2f}" for axis, (low, high) in zip("xyz", found, strict=True))
    return (
        f"it reads {', '.join(lies)} m, the workspace is {', '.join(spans)} m; {_likely_cause(readings, camera, box)}"
    )


def _likely_cause(readings: Tensor, camera: CameraModel, box: Box) -> str:
    """Return the usual mistake whose correction brings most readings into the workspace, or a question."""
    if _seen(readings, camera, box._replace(low=(*box.low[:2], -_TABLE_M))) > _LIKELY:
        return f"the table is seen, and nothing above {1000 * box.low[2]:g} mm: is anything else there?"
    shares = {cause: _seen(readings * scale, other, box) for cause, scale, other in _usual_mistakes(camera)}
    likely = max(shares, key=lambda cause: shares[cause])
    if shares[likely] > max(_LIKELY, 2 * _seen(readings, camera, box)):
        return likely
    return "is T_base_camera that of this cell, in the robot-base frame, and --env the right one?"


def _usual_mistakes(camera: CameraModel) -> Iterator[tuple[str, float, CameraModel]]:
    """Yield what a user may have got wrong, the factor on the depth and the camera that would put it right."""
    pose = camera.pose
    for wrong, right in _POSES:
        yield f"T_base_camera looks like {wrong}", 1.0, replace(camera, T_base_camera=_rows(right(pose)))
    for factor, name in ((1e-3, "millimetres"), (1e-2, "centimetres")):
        scaled = pose.copy()
        scaled[:3, 3] *= factor
        yield f"the last column of T_base_camera looks like {name}", 1.0, replace(camera, T_base_camera=_rows(scaled))
    for unit in _UNITS:
        if not np.isclose(unit, camera.depth_unit):
            yield f"depth_unit looks like {unit:g} m, not {camera.depth_unit:g}", unit / camera.depth_unit, camera


def _seen(readings: Tensor, camera: CameraModel, box: Box) -> float:
    """Return the share of the readings that lie in the workspace."""
    return float(inside(torch.from_numpy(_in_base(readings, camera)), box).float().mean())


def _in_base(readings: Tensor, camera: CameraModel) -> NDArray[np.float64]:
    """Return every reading of the crop (h, w), metres, as a point (M, 3) of the robot-base frame."""
    depth = readings.numpy().astype(np.float64)
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns]
    x = (columns + camera.crop.left - camera.cx) / camera.fx * z
    y = (rows + camera.crop.top - camera.cy) / camera.fy * z
    return np.column_stack([x, y, z]) @ camera.pose[:3, :3].T + camera.pose[:3, 3]


def _rows(pose: NDArray[np.float64]) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in pose.tolist())


def _ply(points: NDArray[np.float32]) -> bytes:
    return trimesh.PointCloud(points).export(file_type="ply")


def _npy(points: NDArray[np.float32]) -> bytes:
    file = BytesIO()
    np.save(file, points, allow_pickle=False)
    return file.getvalue()


_FEW = 64  # distinct points, below which it is asked why
_FAR_M = 20.0  # no depth camera reads so far
_NOTABLE = 0.01  # share of the readings
_TABLE_M = 0.02  # that the table's readings may lie too low
_LIKELY = 0.05  # share of the readings that a correction must bring into the workspace to be named
_UNITS = (1e-3, 1e-4, 2.5e-4, 1e-2)  # metres: a RealSense as delivered, an L515 or Zivid, an L515 of old, centimetres
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # about z
_BODY_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # x forward, y left, z up
_OPENGL_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # x right, y up, z backward
_POSES: tuple[tuple[str, Callable[[Pose], Pose]], ...] = (
    ("its inverse, T_camera_base: invert it", np.linalg.inv),
    ("that of UR's own base frame: turn it by 180 degrees about z", lambda pose: _HALF_TURN @ pose),
    ("that of a camera with x forward, y left and z up (ROS's camera_link): give that of the optical frame",
     lambda pose: pose @ _BODY_OPTICAL),
    ("that of a camera with y up and z backward (OpenGL, Blender): give OpenCV's axes",
     lambda pose: pose @ _OPENGL_OPENCV),
)  # fmt: skip
"""What a pose may look like beside what it should be, and how it is put right."""
_WRITERS: dict[str, Callable[[NDArray[np.float32]], bytes]] = {".ply": _ply, ".npy": _npy}
