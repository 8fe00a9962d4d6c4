"""What is odd about a camera's numbers, though nothing forbids them: intrinsics of another resolution, wrong units."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from manicm_ms.sensing.camera import CameraModel

_OFF_CENTRE = (
    0.1  # of a side; the axis of a rectified stream lies within 0.03, that of 640 pixels is off by 0.13 in 848
)
_STREAMS = ((1280, 720), (1280, 800), (848, 480), (640, 480), (640, 360), (480, 270), (424, 240), (1920, 1080))
_NEAR = 0.04  # of a side
_FIELDS_DEG = (25.0, 115.0)  # from a long lens to the widest depth camera
_ASPECT = 0.05  # by which fx and fy may differ: square pixels are within 0.01
_CROP_DEG = 43.0  # of the policies' camera
_CROP_TOLERANCE = 0.25
_FARTHEST_M = 10.0  # of a camera from the robot that it watches


def doubts(camera: CameraModel) -> list[str]:
    """Return a line for each thing that is odd about `camera`, with its likely cause; none for a usual camera."""
    return [line for ask in _QUESTIONS if (line := ask(camera)) is not None]


def _principal_point(camera: CameraModel) -> str | None:
    sides = {"cx": (camera.cx, camera.width), "cy": (camera.cy, camera.height)}
    for name, (centre, side) in sides.items():
        if abs(centre - (side - 1) / 2) > _OFF_CENTRE * side:
            return (
                f"{name} {centre:g} lies far from {(side - 1) / 2:g}, the middle of the {camera.width}x{camera.height} "
                f"picture: are fx, fy, cx and cy those of {_stream(camera)}?"
            )
    return None


def _stream(camera: CameraModel) -> str:
    """Return the name of the stream in whose middle the principal point lies."""
    for width, height in _STREAMS:
        if abs(2 * camera.cx + 1 - width) < _NEAR * width and abs(2 * camera.cy + 1 - height) < _NEAR * height:
            return f"the {width}x{height} stream"
    return "another stream"


def _field_of_view(camera: CameraModel) -> str | None:
    low, high = _FIELDS_DEG
    width, height = _degrees(camera.width, camera.fx), _degrees(camera.height, camera.fy)
    if low <= max(width, height) <= high:
        return None
    return (
        f"fx {camera.fx:g} and fy {camera.fy:g} give the {camera.width}x{camera.height} picture a field of view of "
        f"{width:.0f} x {height:.0f} degrees, depth cameras have {low:g} to {high:g}: are they those of another "
        "resolution, or in another unit than pixels?"
    )


def _aspect(camera: CameraModel) -> str | None:
    if abs(camera.fx / camera.fy - 1) <= _ASPECT:
        return None
    return (
        f"fx {camera.fx:g} and fy {camera.fy:g} differ by {100 * abs(camera.fx / camera.fy - 1):.0f} %, pixels are "
        "square: is one of them that of another resolution?"
    )


def _crop(camera: CameraModel) -> str | None:
    width, height = _degrees(camera.crop.width, camera.fx), _degrees(camera.crop.height, camera.fy)
    if all(abs(side / _CROP_DEG - 1) <= _CROP_TOLERANCE for side in (width, height)):
        return None
    size = f"{camera.crop.width}x{camera.crop.height}"
    return (
        f"the crop of {size} pixels spans {width:.0f} x {height:.0f} degrees, that of "
        f"the policies' camera {_CROP_DEG:g}: choose it about {round(_pixels(camera.fx))}x{round(_pixels(camera.fy))} "
        "pixels, or are fx and fy those of another resolution?"
    )


def _distance(camera: CameraModel) -> str | None:
    position = camera.pose[:3, 3]
    if abs(position).max() <= _FARTHEST_M:
        return None
    at = ", ".join(f"{x:g}" for x in position)
    return f"T_base_camera puts the camera at ({at}) m: is its last column in millimetres?"


def _degrees(pixels: float, focal: float) -> float:
    return math.degrees(2 * math.atan(pixels / 2 / focal))


def _pixels(focal: float) -> float:
    return 2 * focal * math.tan(math.radians(_CROP_DEG / 2))


_QUESTIONS: tuple[Callable[[CameraModel], str | None], ...] = (
    _principal_point, _field_of_view, _aspect, _crop, _distance
)  # fmt: skip
