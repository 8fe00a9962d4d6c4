"""A depth camera as it stands in the cell: intrinsics, pose and crop."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manicm_ms.errors import CameraError
from manicm_ms.sensing.point_cloud import Box

_ROTATION_TOLERANCE = 1e-4  # a rotation written with five digits passes
_DEPTH_UNITS = (1e-5, 1e-2)  # m: ten micrometres to a centimetre
_GRID = 9  # points along each side of a box


class Crop(NamedTuple):
    """A rectangle of an image, pixels: `left`, `top` is its first pixel."""

    left: int
    top: int
    width: int
    height: int


@dataclass(frozen=True)
class CameraModel:
    """A rectified pinhole depth camera, fixed in the robot-base frame; the picture of a depth camera has no distortion.

    Attributes:
        width: of the native depth image, pixels.
        height: of the native depth image, pixels.
        fx: focal length along a row, pixels.
        fy: focal length along a column, pixels.
        cx: column of the optical axis, pixels; the centre of the first pixel is 0 (OpenCV).
        cy: row of the optical axis, pixels; the centre of the first pixel is 0 (OpenCV).
        T_base_camera: 4x4 rows, metres; camera axes as in OpenCV: x right, y down, z forward.
        depth_unit: metres per unit of a uint16 depth image.
        crop: part of the native image that is used.
        name: for people.
        serial: for people.

    Raises:
        CameraError: a field is out of range; the message names it and says what is accepted.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    T_base_camera: tuple[tuple[float, ...], ...]
    crop: Crop
    depth_unit: float = 0.001
    name: str = ""
    serial: str = ""

    def __post_init__(self) -> None:
        for condition, text in self._conditions():
            if not condition:
                raise CameraError(text)

    def _conditions(self) -> list[tuple[bool, str]]:
        low, high = _DEPTH_UNITS
        left, top, width, height = self.crop
        fits = min(left, top) >= 0 and min(width, height) >= 1
        fits = fits and left + width <= self.width and top + height <= self.height
        of = ": of another size?"
        return [
            (min(self.width, self.height) >= 1, f"width and height must be 1 or more, got {self.width}, {self.height}"),
            (min(self.fx, self.fy) > 0, f"fx and fy must be above 0 pixels, got {self.fx}, {self.fy}"),
            (0 <= self.cx < self.width, f"cx must lie in the image, 0 to {self.width - 1} pixels, got {self.cx}{of}"),
            (0 <= self.cy < self.height, f"cy must lie in the image, 0 to {self.height - 1} pixels, got {self.cy}{of}"),
            (low <= self.depth_unit <= high, f"depth_unit must be {low:g} to {high:g} m, got {self.depth_unit:g}"),
            (fits, f"crop {tuple(self.crop)} (left, top, width, height) leaves the {self.width}x{self.height} image"),
            (is_rigid(self.T_base_camera), "T_base_camera must be a 4x4 rigid transform: a rotation matrix, "
                                           "a translation in metres and the last row 0 0 0 1"),
        ]  # fmt: skip

    @property
    def pose(self) -> NDArray[np.float64]:
        """T_base_camera as an array (4, 4), metres."""
        return np.array(self.T_base_camera, np.float64)

    @property
    def crop_intrinsic(self) -> NDArray[np.float64]:
        """(3, 3) pinhole matrix of the crop, pixels, pixel centres at half-integers: as renderers count."""
        cx, cy = self.cx - self.crop.left + 0.5, self.cy - self.crop.top + 0.5
        return np.array([[self.fx, 0, cx], [0, self.fy, cy], [0, 0, 1]])

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values, to be recorded and compared."""
        return json.loads(json.dumps(asdict(self)))

    def share_seen(self, box: Box) -> float:
        """Return the share of a box of the robot-base frame that lies before the crop, as a grid of points has it."""
        grid = np.stack(np.meshgrid(*np.linspace(box.low, box.high, _GRID).T), axis=-1).reshape(-1, 3)
        x, y, z = ((grid - self.pose[:3, 3]) @ self.pose[:3, :3]).T
        before = z > 0
        u = self.fx * x[before] / z[before] + self.cx - self.crop.left
        v = self.fy * y[before] / z[before] + self.cy - self.crop.top
        inside_crop = (u >= -0.5) & (u < self.crop.width - 0.5) & (v >= -0.5) & (v < self.crop.height - 0.5)
        return float(inside_crop.sum() / len(grid))

    def metres(self, raw: Tensor) -> Tensor:
        """Return the depth in metres, float32, of raw readings in units: one rounding for all who convert."""
        return raw.to(torch.float32) * self.depth_unit

    def cropped(self, image: Tensor) -> Tensor:
        """Return the used part (..., h, w) of native images (..., height, width)."""
        left, top, width, height = self.crop
        return image[..., top : top + height, left : left + width]


def require_view(camera: CameraModel, box: Box, env_id: str) -> None:
    """Raise CameraError where the camera sees nothing of an environment's workspace: every cloud would be empty."""
    if camera.share_seen(box) == 0:
        at = ", ".join(f"{x:.2f}" for x in camera.pose[:3, 3])
        raise CameraError(
            f"the camera at ({at}) m sees nothing of the workspace of {env_id}, {box.low} to {box.high} m: is its "
            "T_base_camera in the robot-base frame, in metres, with z along the optical axis?"
        )


def is_rigid(T: Any) -> bool:
    """Return whether T is a finite 4x4 rigid transform, to the digits that people write."""
    try:
        M = np.array(T, np.float64)
    except (ValueError, TypeError):
        return False
    if M.shape != (4, 4) or not np.isfinite(M).all():
        return False
    R = M[:3, :3]
    proper = np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(R) > 0
    return bool(proper and np.array_equal(M[3], [0, 0, 0, 1]))
