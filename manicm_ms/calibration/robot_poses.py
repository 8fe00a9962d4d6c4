"""Robot poses of a calibration: a JSON or CSV file that gives the tool's pose for each image."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from manicm_ms.errors import CalibrationError

POSITION, QUATERNION, ROTATION_VECTOR = "position", "quat_wxyz", "rotation_vector"
"""Keys of a pose: metres; a unit quaternion, w first; or axis times angle in radians, as UR controllers show it."""
_COLUMNS = {POSITION: ("x", "y", "z"), QUATERNION: ("qw", "qx", "qy", "qz"), ROTATION_VECTOR: ("rx", "ry", "rz")}
_LENGTHS = {key: len(columns) for key, columns in _COLUMNS.items()}
_UNIT_TOLERANCE = 1e-3  # of a quaternion's norm: six written digits keep it far below
_FARTHEST_M = 10.0  # beyond any arm: the positions are then millimetres
_FORMS = (
    f'JSON {{"view.png": {{"{POSITION}": [x, y, z], "{QUATERNION}": [w, x, y, z] or '
    f'"{ROTATION_VECTOR}": [rx, ry, rz]}}, ...}} or CSV with the columns file,x,y,z,qw,qx,qy,qz or file,x,y,z,rx,ry,rz'
)


def read_poses(path: Path) -> dict[str, RigidTransform]:
    """Read the poses T_base_tool of a calibration.

    JSON: image file name -> {"position": [x, y, z], "quat_wxyz": [w, x, y, z]}; CSV: a header and the columns file, x,
    y, z, qw, qx, qy, qz. In place of the quaternion either may hold a rotation vector ("rotation_vector"; rx, ry, rz).
    Metres and radians. The tool frame may be any that is fixed to the robot's last link.

    Returns image file name -> T_base_tool.

    Raises CalibrationError naming the file, the image and the field.
    """
    if not path.is_file():
        raise CalibrationError(f"{path} does not exist: give the robot's poses as {_FORMS}")
    try:
        text = path.read_text(encoding="utf-8-sig")
        rows = _from_json(text) if path.suffix.lower() == ".json" else _from_csv(text)
    except (ValueError, csv.Error) as error:
        raise CalibrationError(f"{path} cannot be read ({error}): wanted is {_FORMS}") from error
    poses: dict[str, RigidTransform] = {}
    for name, fields in rows:
        if name in poses:
            raise CalibrationError(f"{path} gives two poses for {name}: remove one")
        poses[name] = _pose(f"{path}, {name}", fields)
    return poses


def _from_json(text: str) -> list[tuple[str, Any]]:
    pairs = json.loads(text, object_pairs_hook=list)  # pairs, so that a name given twice is seen
    if not isinstance(pairs, list) or not all(isinstance(pair, tuple) for pair in pairs):
        raise ValueError("not an object of images")
    return [(name, dict(fields) if _is_object(fields) else fields) for name, fields in pairs]


def _is_object(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(item, tuple) for item in value)


def _from_csv(text: str) -> list[tuple[str, Any]]:
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    header = [column.strip() for column in reader.fieldnames or ()]
    if "file" not in header:
        raise ValueError(f"its header is {','.join(header) or 'missing'}")
    reader.fieldnames = header
    present = {key: columns for key, columns in _COLUMNS.items() if set(columns) <= set(header)}
    return [
        ((row["file"] or "").strip(), {key: [row[c] for c in columns] for key, columns in present.items()})
        for row in reader
    ]


def _pose(where: str, fields: Any) -> RigidTransform:
    if not isinstance(fields, Mapping):
        raise CalibrationError(f"{where}: not a pose: wanted is {_FORMS}")
    if POSITION not in fields or (QUATERNION in fields) == (ROTATION_VECTOR in fields):
        raise CalibrationError(
            f"{where}: needs {POSITION} and either {QUATERNION} or {ROTATION_VECTOR}, has {', '.join(fields) or 'none'}"
        )
    position = _numbers(where, POSITION, fields[POSITION])
    if np.abs(position).max() > _FARTHEST_M:
        raise CalibrationError(f"{where}: {POSITION} {position.tolist()} is no robot's in metres: were it millimetres?")
    if ROTATION_VECTOR in fields:
        rotation = Rotation.from_rotvec(_numbers(where, ROTATION_VECTOR, fields[ROTATION_VECTOR]))
    else:
        rotation = _unit_quaternion(where, _numbers(where, QUATERNION, fields[QUATERNION]))
    return RigidTransform.from_components(position, rotation)


def _unit_quaternion(where: str, wxyz: np.ndarray) -> Rotation:
    norm = float(np.linalg.norm(wxyz))
    if abs(norm - 1) > _UNIT_TOLERANCE:
        raise CalibrationError(
            f"{where}: {QUATERNION} {wxyz.tolist()} has norm {norm:.4f}, a rotation has 1: correct it"
        )
    return Rotation.from_quat(wxyz, scalar_first=True)


def _numbers(where: str, key: str, values: Any) -> np.ndarray:
    try:
        array = np.array([float(v) for v in _sequence(values)])
    except (TypeError, ValueError):
        raise CalibrationError(f"{where}: {key} {values!r} is not {_LENGTHS[key]} numbers") from None
    if array.shape != (_LENGTHS[key],) or not np.isfinite(array).all():
        raise CalibrationError(f"{where}: {key} {values!r} is not {_LENGTHS[key]} finite numbers")
    return array


def _sequence(values: Any) -> Iterable[Any]:
    if isinstance(values, str):
        raise TypeError
    return values
