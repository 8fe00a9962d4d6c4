"""Views of a board made by projecting its corners: exact, or with the noise that is asked for."""

import numpy as np
from rendered_board import look_at, tool_poses
from scipy.spatial.transform import RigidTransform, Rotation

from manicm_ms.sensing.calibration.board import CharucoSpec, Corners
from manicm_ms.sensing.calibration.hand_eye import HandEye, Pinhole, View

BOARD = CharucoSpec()
INFRARED = Pinhole(640.0, 641.0, 641.2, 356.1)
SIZE = (1280, 720)
TRUTH = HandEye(
    look_at((0.710, 0.280, 0.432), (0.31, 0.0, 0.15)),
    RigidTransform.from_components([-0.07, -0.1, 0.15], Rotation.from_euler("xyz", [10, -15, 80], degrees=True)),
)


def project(T_camera_board, points, camera):
    """Pixels (K, 2) by the textbook: K [R t] p, divided by its last row."""
    homogeneous = camera.matrix @ (T_camera_board.as_matrix() @ np.column_stack([points, np.ones(len(points))]).T)[:3]
    return (homogeneous[:2] / homogeneous[2]).T


def nudge(rng, shift_m, turn_deg):
    """A small random transform; the RMS lengths of its two parts are given."""
    scale = np.sqrt(3)
    turn = Rotation.from_rotvec(rng.normal(0, np.deg2rad(turn_deg) / scale, 3))
    return RigidTransform.from_components(rng.normal(0, shift_m / scale, 3), turn)


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


def error(T_base_camera, truth=TRUTH):
    """Distance (mm) and angle (deg) to the true camera."""
    step = truth.T_base_camera.inv() * T_base_camera
    return 1000 * np.linalg.norm(step.translation), np.rad2deg(step.rotation.magnitude())
