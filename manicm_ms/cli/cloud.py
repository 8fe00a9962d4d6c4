"""What `manicm-ms cloud` does: a recorded depth image becomes the cloud that a policy would see."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from manicm_ms.camera_model import depth_to_cloud, read_camera, read_depth
from manicm_ms.errors import ConfigError, OutputExistsError
from manicm_ms.paths import write_bytes
from manicm_ms.realism import resolve_realism


def cloud(depth: Path, camera: Path, out: Path, env: str, realism: str, num_points: int, overwrite: bool) -> None:
    """Write the cloud of a recorded depth image and say what became of its readings.

    Raises:
        CameraError: camera file or depth image cannot be used.
        ConfigError: `out` has another ending than .ply or .npy, or `num_points` is not positive.
        UnknownNameError: no such environment or realism preset.
        OutputExistsError: `out` exists and is not to be replaced.
    """
    if out.suffix not in _WRITERS:
        raise ConfigError(f"cannot write {out}: name a file that ends in {' or '.join(_WRITERS)}")
    if out.exists() and not overwrite:
        raise OutputExistsError(f"{out} exists: choose another --out or add --overwrite")
    if num_points < 1:
        raise ConfigError(f"--num-points must be at least 1, got {num_points}")
    crop_floor = resolve_realism(realism).crop_floor
    model = read_camera(camera)
    readings = model.cropped(read_depth(depth, model))
    from manicm_ms.envs.maniskill import workspace_of  # seconds of a simulator's import: errors of files come first

    box = workspace_of(env).raised(crop_floor)
    points = depth_to_cloud(readings[None], model, box, num_points)[0].numpy()
    distinct = len(np.unique(points, axis=0)) if points.any() else 0
    write_bytes(out, _WRITERS[out.suffix](points))
    print(
        f"{out}: {num_points} points, {distinct} of them distinct, of {int((readings > 0).sum())} readings in the crop"
    )
    if distinct == 0:
        print(
            f"no reading lies in the workspace of {env}, {box.low} to {box.high} m: is T_base_camera that of this cell?"
        )


def _ply(points: NDArray[np.float32]) -> bytes:
    return trimesh.PointCloud(points).export(file_type="ply")


def _npy(points: NDArray[np.float32]) -> bytes:
    file = BytesIO()
    np.save(file, points, allow_pickle=False)
    return file.getvalue()


_WRITERS: dict[str, Callable[[NDArray[np.float32]], bytes]] = {".ply": _ply, ".npy": _npy}
