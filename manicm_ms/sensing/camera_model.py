"""A depth camera as it stands in the cell: intrinsics, pose, crop, file format, and how its depth becomes a cloud."""

from __future__ import annotations

import difflib
import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from torch import Tensor

from manicm_ms.errors import CameraError, CameraWarning
from manicm_ms.paths import asset, write_text
from manicm_ms.sensing.camera_doubts import doubts
from manicm_ms.sensing.point_cloud import Box, crop_transformed, inside, sample_cloud, sample_cloud_batch, transform
from manicm_ms.sensing.written_numbers import as_number, point_for_comma

CLOUD_SIZE = (84, 84)
"""(H, W) of the picture that a depth image is resized to before it becomes points."""
PINHOLE = "pinhole"
_ROTATION_TOLERANCE = 1e-4  # a rotation written with five digits passes
_DEPTH_UNITS = (1e-5, 1e-2)  # m: ten micrometres to a centimetre
_NEAREST, _FARTHEST = 0.1, 20.0  # m: readings that are all outside say that the unit is wrong
_GRID = 9  # points along each side of a box
MAX_RAW = 65535  # largest value of a uint16


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


# ---- depth to cloud -------------------------------------------------------------------------------------------


def nearest_pixels(count: int, wanted: int) -> NDArray[np.int64]:
    """Return which of `count` pixels of a row a nearest-neighbour resize to `wanted` pixels takes, (wanted,)."""
    return np.floor((np.arange(wanted) + 0.5) * count / wanted).astype(np.int64)


@lru_cache(maxsize=16)
def _rays(camera: CameraModel, size: tuple[int, int]) -> Tensor:
    """Return the rays (h * w, 3) float32 of the sampled pixels, in camera axes, with z = 1."""
    rows, columns = (nearest_pixels(n, k) for n, k in zip((camera.crop.height, camera.crop.width), size, strict=True))
    y = (rows + camera.crop.top - camera.cy) / camera.fy
    x = (columns + camera.crop.left - camera.cx) / camera.fx
    grid = np.stack([*np.meshgrid(x, y), np.ones(size)], axis=-1)
    return torch.from_numpy(grid.reshape(-1, 3).astype(np.float32))


def depth_to_cloud(
    depth: Tensor,
    camera: CameraModel,
    workspace: Box,
    num_points: int,
    size: tuple[int, int] = CLOUD_SIZE,
    *,
    T_base_camera: Tensor | None = None,
    rgb: Tensor | None = None,
) -> Tensor:
    """Return the clouds that a policy sees, from depth images: the one way for simulator, recordings and a real robot.

    Nearest-neighbour resize of the crop (averaging would invent points between surfaces), pinhole model with the
    native intrinsics of the sampled pixels, robot-base frame, workspace box, farthest-point order.

    Args:
        depth: (N, h, w) float32, metres along the optical axis, of `camera.crop` at native resolution; 0 = no
            reading.
        camera: intrinsics, crop and pose.
        workspace: crop box, robot-base frame, metres.
        num_points: P.
        size: (H, W) that the crop is resized to.
        T_base_camera: (N, 4, 4) float32, a pose for each row in OpenCV axes; None takes the camera's.
        rgb: (N, h, w, 3) in [0, 1], appended to xyz.

    Returns:
        (N, P, 3) float32 in the robot-base frame, metres, or (N, P, 6) with rgb; zeros where no point is in the box.

    Raises:
        CameraError: `depth` has not the crop's size.
    """
    h, w = camera.crop.height, camera.crop.width
    if depth.ndim != 3 or depth.shape[1:] != (h, w):
        raise CameraError(f"depth of the crop must be (N, {h}, {w}), got {tuple(depth.shape)}")
    n, device = len(depth), depth.device
    rows, columns = (torch.from_numpy(nearest_pixels(a, b)).to(device) for a, b in ((h, size[0]), (w, size[1])))
    z = depth[:, rows[:, None], columns].reshape(n, -1)
    xyz = _rays(camera, size).to(device) * z[..., None]  # (N, M, 3)
    colors = None if rgb is None else rgb[:, rows[:, None], columns].reshape(n, -1, 3).to(torch.float32)
    if T_base_camera is None:
        T_base_camera = torch.tensor(camera.T_base_camera, dtype=torch.float32, device=device).expand(n, 4, 4)
    if device.type == "cpu":
        return _clouds_by_row(xyz, colors, T_base_camera, workspace, num_points)
    return _clouds_together(xyz, colors, T_base_camera, workspace, num_points)


def _clouds_by_row(xyz: Tensor, colors: Tensor | None, T: Tensor, workspace: Box, num_points: int) -> Tensor:
    """Return clouds (N, P, C) of points (N, M, 3) in camera axes: a row at a time, the quick way on a CPU."""
    clouds = []
    for k in range(len(xyz)):
        camera_points = xyz[k].numpy()
        read = np.flatnonzero(camera_points[:, 2])
        index, points = crop_transformed(camera_points[read], T[k].numpy(), workspace)
        if colors is not None:
            points = np.concatenate([points, colors[k].numpy()[read[index]]], axis=1)
        clouds.append(torch.from_numpy(sample_cloud(points, num_points)))
    return torch.stack(clouds)


def _clouds_together(xyz: Tensor, colors: Tensor | None, T: Tensor, workspace: Box, num_points: int) -> Tensor:
    """Return the same without a loop over rows, for a device: the order starts from the first point of the cloud."""
    base = transform(xyz, T)
    points = base if colors is None else torch.cat([base, colors], dim=-1)
    return sample_cloud_batch(points, (xyz[..., 2] > 0) & inside(base, workspace), num_points)


# ---- files ----------------------------------------------------------------------------------------------------

_NUMBER, _COUNT, _TEXT = "a number", "a whole number", "a text"
_ACCEPTED = {
    "model": f"{PINHOLE!r}",
    "width": _COUNT,
    "height": _COUNT,
    "fx": _NUMBER,
    "fy": _NUMBER,
    "cx": _NUMBER,
    "cy": _NUMBER,
    "distortion": "a list of zeros: the depth stream of a RealSense is rectified; rectify other images first",
    "depth_unit": f"{_NUMBER}, metres per unit",
    "crop": "the whole numbers left, top, width and height",
    "T_base_camera": "four rows of four numbers",
    "name": _TEXT,
    "serial": _TEXT,
    "notes": "a mapping",
}
"""Fields of a camera file, each with what it accepts."""
_OPTIONAL = {"distortion", "name", "serial", "notes"}
_NO_NUMBERS = {"model", "name", "serial", "notes"}


def default_camera() -> CameraModel:
    """Return the RealSense D435i of the cell as the package ships it."""
    return read_camera(asset("cameras", "d435i.yaml"))


def read_camera(path: Path) -> CameraModel:
    """Read a camera file (YAML; docs/guides/real_camera.md describes it).

    Numbers that YAML reads as text, as 1e-3, are read as numbers.

    Warns:
        CameraWarning: the numbers can hardly be those of one camera, as intrinsics of another resolution.

    Raises:
        CameraError: the file is missing, not YAML, of another camera model, or a field is missing, unknown or out of
            range; the message names file and field and says what is accepted.
    """
    try:
        fields_ = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CameraError(f"{path} does not exist: name a camera file, as 'manicm-ms calibrate' writes it") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise CameraError(f"{path} is not YAML: {' '.join(str(error).split())}") from error
    try:
        camera = _camera_of(fields_)
    except CameraError as error:
        raise CameraError(f"{path}: {error}") from None
    for doubt in doubts(camera):
        warnings.warn(f"{path}: {doubt}", CameraWarning, stacklevel=2)
    return camera


def write_camera(path: Path, camera: CameraModel, *, notes: Mapping[str, Any] | None = None) -> None:
    """Write a camera file, atomically; `read_camera` returns the same camera to the bit.

    Args:
        path: the file.
        camera: what to write.
        notes: plain values that say where the numbers come from; kept for people, read by nobody.
    """
    content = {"model": PINHOLE, **asdict(camera)}
    content["crop"] = camera.crop._asdict()
    content["T_base_camera"] = [[float(x) for x in row] for row in camera.T_base_camera]
    content["notes"] = dict(notes or {})
    # Flow style for the innermost lists and mappings alone: a matrix row is a line.
    write_text(Path(path), yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120))


def _camera_of(content: Any) -> CameraModel:
    """Return the camera of a file's content, or raise a CameraError that names the field."""
    if not isinstance(content, dict):
        raise CameraError(f"a camera file is a mapping with the fields {', '.join(_ACCEPTED)}")
    if (model := content.get("model")) != PINHOLE:
        raise CameraError(
            f"field model is {model!r}: only {PINHOLE!r} is accepted; rectify the images of another camera"
        )
    for name in content:
        if name not in _ACCEPTED:
            near = difflib.get_close_matches(str(name), _ACCEPTED, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise CameraError(f"unknown field {name!r}: {hint}known: {', '.join(_ACCEPTED)}")
    content = {name: value if name in _NO_NUMBERS else _numbers(value) for name, value in content.items()}
    for name, accepted in _ACCEPTED.items():
        if name not in content and name not in _OPTIONAL:
            raise CameraError(f"field {name} is missing: it must be {accepted}")
        if name in content and not _accepts(name, content[name]):
            written = point_for_comma(content[name])
            hint = "" if written is None or name in _NO_NUMBERS else f"; write {written}, with a point"
            raise CameraError(f"field {name} is {content[name]!r}: it must be {accepted}{hint}")
    values: dict[str, Any] = {field.name: content[field.name] for field in fields(CameraModel) if field.name in content}
    values["crop"] = Crop(**content["crop"])
    values["T_base_camera"] = tuple(tuple(float(x) for x in row) for row in content["T_base_camera"])
    values |= {name: float(value) for name, value in values.items() if _ACCEPTED[name].startswith(_NUMBER)}
    return CameraModel(**values)


def _numbers(value: Any) -> Any:
    """Return a value of the file with the texts in it that spell numbers read as such."""
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    if isinstance(value, dict):
        return {key: _numbers(item) for key, item in value.items()}
    return as_number(value)


def _accepts(name: str, value: Any) -> bool:
    """Return whether a field's value has the right type; ranges are the CameraModel's business."""
    if name == "crop":
        return isinstance(value, dict) and set(value) == set(Crop._fields) and all(map(_is_count, value.values()))
    if name == "distortion":
        return isinstance(value, list) and all(_is_number(x) and x == 0 for x in value)
    if name == "T_base_camera":
        return isinstance(value, list) and len(value) == 4 and all(_is_row(row) for row in value)
    if name == "notes":
        return value is None or isinstance(value, dict)
    if _ACCEPTED[name] == _COUNT:
        return _is_count(value)
    return _is_number(value) if _ACCEPTED[name].startswith(_NUMBER) else isinstance(value, str)


def _is_row(row: Any) -> bool:
    return isinstance(row, list) and len(row) == 4 and all(map(_is_number, row))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


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
