"""Views of a board made by projecting its corners: exact, or with the noise that is asked for."""

import numpy as np

from manicm_ms.bench.calibration import TRUTH, nudge
from manicm_ms.bench.rendered_board import tool_poses
from manicm_ms.sensing.calibration.board import CharucoSpec, Corners
from manicm_ms.sensing.calibration.hand_eye import Pinhole, View

BOARD = CharucoSpec()
INFRARED = Pinhole(640.0, 641.0, 641.2, 356.1)
SIZE = (1280, 720)


def project(T_camera_board, points, camera):
    """Pixels (K, 2) by the textbook: K [R t] p, divided by its last row."""
    homogeneous = camera.matrix @ (T_camera_board.as_matrix() @ np.column_stack([points, np.ones(len(points))]).T)[:3]
    return (homogeneous[:2] / homogeneous[2]).T


def views(count=12, seed=0, pixel=0.0, shift_m=0.0, turn_deg=0.0, truth=TRUTH, camera=INFRARED, poses=None):
    """Views of the whole board."""
    rng = np.random.default_rng(1000 + seed)
    points = np.asarray(BOARD.board().getChessboardCorners(), float)
    made = []
    poses = poses or tool_poses(truth.T_base_camera, truth.T_tool_board, BOARD, count, seed)
    for i, tool in enumerate(poses):
        seen = project(truth.T_base_camera.inv() * tool * truth.T_tool_board, points, camera)
        told = tool * nudge(rng, shift_m, turn_deg)
        made.append(
            View(f"{i:02d}.png", told, Corners(seen + rng.normal(0, pixel, seen.shape) if pixel else seen, points))
        )
    return made
