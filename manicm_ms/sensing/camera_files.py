"""Camera files: the YAML that `manicm-ms calibrate` writes and people edit, checked field by field."""

from __future__ import annotations

import difflib
import math
import warnings
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import yaml

from manicm_ms.errors import CameraError, CameraWarning
from manicm_ms.paths import asset, write_text
from manicm_ms.sensing.camera import CameraModel, Crop
from manicm_ms.sensing.camera_doubts import doubts
from manicm_ms.sensing.written_numbers import as_number, point_for_comma

PINHOLE = "pinhole"
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
