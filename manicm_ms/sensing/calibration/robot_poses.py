"""Robot poses of a calibration: a JSON or CSV file that gives the tool's pose for each image."""

from __future__ import annotations

import codecs
import csv
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from manicm_ms.errors import CalibrationError
from manicm_ms.sensing.written_numbers import point_for_comma

POSITION, QUATERNION, ROTATION_VECTOR = "position", "quat_wxyz", "rotation_vector"
"""Keys of a pose: metres; a unit quaternion, w first; or axis times angle in radians, as UR controllers show it."""
_COLUMNS = {POSITION: ("x", "y", "z"), QUATERNION: ("qw", "qx", "qy", "qz"), ROTATION_VECTOR: ("rx", "ry", "rz")}
_LENGTHS = {key: len(columns) for key, columns in _COLUMNS.items()}
_UNIT_TOLERANCE = 1e-3  # of a quaternion's norm: six written digits keep it far below
_FARTHEST_M = 10.0  # beyond any arm: the positions are then millimetres
_LARGEST_ANGLE = 2 * np.pi + 1e-3  # of a rotation vector in radians
_SEPARATORS = (",", ";", "\t")
_FORMS = (
    f'JSON {{"view.png": {{"{POSITION}": [x, y, z], "{QUATERNION}": [w, x, y, z] or '
    f'"{ROTATION_VECTOR}": [rx, ry, rz]}}, ...}} or CSV with the columns file,x,y,z,qw,qx,qy,qz or file,x,y,z,rx,ry,rz'
)


def read_poses(path: Path) -> dict[str, RigidTransform]:
    """Read the poses T_base_tool of a calibration.

    JSON: image file name -> {"position": [x, y, z], "quat_wxyz": [w, x, y, z]}; CSV: a header and the columns file, x,
    y, z, qw, qx, qy, qz. In place of the quaternion either may hold a rotation vector ("rotation_vector"; rx, ry, rz).
    Columns are separated by commas, semicolons or tabs; a decimal comma is read where it cannot separate columns.
    Metres and radians. The tool frame may be any that is fixed to the robot's last link.

    Returns image file name -> T_base_tool.

    Raises CalibrationError naming the file, the image and the field.
    """
    if not path.is_file():
        what = "is no file" if path.exists() else "does not exist"
        raise CalibrationError(f"{path} {what}: give the robot's poses as {_FORMS}")
    try:
        text = _decoded(path.read_bytes())
        rows = _from_json(text) if path.suffix.lower() == ".json" else _from_csv(text)
    except (ValueError, csv.Error) as error:
        raise CalibrationError(f"{path} cannot be read ({error}): wanted is {_FORMS}") from error
    poses: dict[str, RigidTransform] = {}
    for name, fields in rows:
        if name in poses:
            raise CalibrationError(f"{path} gives two poses for {name}: remove one")
        poses[name] = _pose(f"{path}, {name}", fields)
    return poses


def _decoded(content: bytes) -> str:
    """Return the text of a file in UTF-8, or in UTF-16 as some spreadsheets write it, with or without a mark."""
    marked = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if marked else "utf-8-sig")


def _from_json(text: str) -> list[tuple[str, Any]]:
    pairs = json.loads(text, object_pairs_hook=list)  # pairs, so that a name given twice is seen
    if not isinstance(pairs, list) or not all(isinstance(pair, tuple) for pair in pairs):
        raise ValueError("not an object of images")
    return [(name, dict(fields) if _is_object(fields) else fields) for name, fields in pairs]


def _is_object(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, tuple) for item in value)


def _from_csv(text: str) -> list[tuple[str, Any]]:
    lines = text.splitlines()
    header, separator = _header(lines[0] if lines else "")
    present = {key: columns for key, columns in _COLUMNS.items() if set(columns) <= set(header)}
    if "file" not in header or POSITION not in present or len(present) < 2:
        raise ValueError(f"its header is {','.join(header) or 'missing'}")
    rows = []
    for number, values in enumerate(csv.reader(lines[1:], delimiter=separator, skipinitialspace=True), start=2):
        values = [value.strip() for value in values]
        while len(values) > len(header) and not values[-1]:  # a separator at the end of the line
            values.pop()
        if any(values):
            row = dict(zip(header, _of_one_length(number, values, header, separator), strict=True))
            rows.append((row["file"], {key: [row[c] for c in columns] for key, columns in present.items()}))
    return rows


def _header(line: str) -> tuple[list[str], str]:
    """Return the names of the columns, in small letters, and the separator under which one of them is file."""
    for separator in _SEPARATORS:
        names = [name.strip().lower() for name in next(csv.reader([line], delimiter=separator), [])]
        if "file" in names:
            return [name for k, name in enumerate(names) if name or k + 1 < len(names)], separator
    return [name.strip() for name in line.split(",") if name.strip()], ","


def _of_one_length(number: int, values: list[str], header: list[str], separator: str) -> list[str]:
    """Return the values of a row that has as many as the header; raise ValueError for any other."""
    if len(values) == len(header):
        return values
    commas = separator == "," and len(values) > len(header)
    hint = "; are these decimal commas? Write points, or separate the columns by semicolons" if commas else ""
    raise ValueError(f"its line {number} has {len(values)} values and the header {len(header)}{hint}")


def _pose(where: str, fields: Any) -> RigidTransform:
    if not isinstance(fields, Mapping):
        raise CalibrationError(f"{where}: not a pose: wanted is {_FORMS}")
    if POSITION not in fields or (QUATERNION in fields) == (ROTATION_VECTOR in fields):
        raise CalibrationError(
            f"{where}: needs {POSITION} and either {QUATERNION} or {ROTATION_VECTOR}, has {', '.join(fields) or 'none'}"
        )
    position = _numbers(where, POSITION, fields[POSITION])
    if np.abs(position).max() > _FARTHEST_M:
        raise CalibrationError(
            f"{where}: {POSITION} {position.tolist()} is no robot's in metres: were it millimetres or centimetres?"
        )
    if ROTATION_VECTOR in fields:
        rotation = _rotation(where, _numbers(where, ROTATION_VECTOR, fields[ROTATION_VECTOR]))
    else:
        rotation = _unit_quaternion(where, _numbers(where, QUATERNION, fields[QUATERNION]))
    return RigidTransform.from_components(position, rotation)


def _rotation(where: str, vector: np.ndarray) -> Rotation:
    if (angle := float(np.linalg.norm(vector))) > _LARGEST_ANGLE:
        raise CalibrationError(
            f"{where}: {ROTATION_VECTOR} {vector.tolist()} turns by {angle:.4g} rad, more than a whole turn: degrees?"
        )
    return Rotation.from_rotvec(vector)


def _unit_quaternion(where: str, wxyz: np.ndarray) -> Rotation:
    norm = float(np.linalg.norm(wxyz))
    if abs(norm - 1) > _UNIT_TOLERANCE:
        raise CalibrationError(
            f"{where}: {QUATERNION} {wxyz.tolist()} has norm {norm:.4f}, a rotation has 1: correct it"
        )
    return Rotation.from_quat(wxyz, scalar_first=True)


def _numbers(where: str, key: str, values: Any) -> np.ndarray:
    try:
        array = np.array([_number(v) for v in _sequence(values)])
    except (TypeError, ValueError):
        raise CalibrationError(f"{where}: {key} {values!r} is not {_LENGTHS[key]} numbers") from None
    if array.shape != (_LENGTHS[key],) or not np.isfinite(array).all():
        raise CalibrationError(f"{where}: {key} {values!r} is not {_LENGTHS[key]} finite numbers")
    return array


def _number(value: Any) -> float:
    """Return a number that may be written with a decimal comma: within one value, it can be nothing else."""
    return float(point_for_comma(value) or value)


def _sequence(values: Any) -> Iterable[Any]:
    if isinstance(values, str):
        raise TypeError
    return values
