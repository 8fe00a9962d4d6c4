"""Depth images: PNG files of one 16-bit channel, in a camera's depth units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manicm_ms.errors import CameraError
from manicm_ms.sensing.camera import CameraModel

_NEAREST, _FARTHEST = 0.1, 20.0  # m: readings that are all outside say that the unit is wrong
MAX_RAW = 65535  # largest value of a uint16


def read_depth(path: Path, camera: CameraModel) -> Tensor:
    """Read a recorded depth image: a PNG of one 16-bit channel at the camera's native size, in its depth units.

    Returns:
        (height, width) float32, metres; 0 = no reading.

    Raises:
        CameraError: the file is missing, no such image, of another size, or its readings inside the crop are all nearer
            than 0.1 m or all farther than 20 m, so that they cannot be in the camera's depth unit.
    """
    raw = _read_png(Path(path))
    if raw.ndim != 2 or raw.dtype != np.uint16:
        channels = 1 if raw.ndim == 2 else raw.shape[2]
        raise CameraError(
            f"{path} has {channels} channel(s) of {raw.dtype}: a depth image has one channel of uint16; "
            "record the raw depth stream, not a colour picture of it"
        )
    if raw.shape != (camera.height, camera.width):
        raise CameraError(
            f"{path} is {raw.shape[1]}x{raw.shape[0]} pixels and the camera {camera.width}x{camera.height}: "
            "record at the native size, or give the camera file of that stream"
        )
    depth = camera.metres(torch.from_numpy(raw.astype(np.int32)))
    readings = camera.cropped(depth)
    readings = readings[readings > 0]
    if len(readings) == 0:
        raise CameraError(f"{path} holds no reading inside the camera's crop {tuple(camera.crop)}: every pixel is 0")
    if readings.max() < _NEAREST or readings.min() > _FARTHEST:
        raise CameraError(
            f"{path} reads {readings.min():.3g} to {readings.max():.3g} m in units of {camera.depth_unit:g} m, outside "
            f"{_NEAREST:g} to {_FARTHEST:g} m: correct depth_unit in the camera file to the unit of the recording"
        )
    return depth


def write_depth(path: Path, depth: Tensor, camera: CameraModel) -> None:
    """Write depth (height, width) in metres as a PNG that `read_depth` reads; readings are rounded to depth units."""
    import cv2  # a tenth of a second that who reads no pictures need not wait

    raw = torch.round(depth.double() / camera.depth_unit).clamp(0, MAX_RAW).numpy().astype(np.uint16)
    done, data = cv2.imencode(".png", raw)
    assert done
    Path(path).write_bytes(data.tobytes())


def _read_png(path: Path) -> NDArray[Any]:
    import cv2

    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise CameraError(f"{path} does not exist: name a depth image, a PNG of 16 bits") from None
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None:
        raise CameraError(f"{path} is no image that can be read: a depth image is a PNG of one 16-bit channel")
    return image
