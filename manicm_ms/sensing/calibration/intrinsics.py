"""Intrinsics solved from the board itself, for a camera that does not report its own."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from manicm_ms.errors import CalibrationError
from manicm_ms.sensing.calibration.board import Corners
from manicm_ms.sensing.calibration.hand_eye import Pinhole

_NO_TANGENTIAL = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
_PINHOLE = _NO_TANGENTIAL | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
_MAX_FOCAL_ERROR = 0.02  # standard error of the focal length / itself: beyond, the distances are off by as much
_MAX_BEND_PX = 1.0  # that a radial term may move a seen corner before the images count as distorted
_MIN_BEND_GAIN = 1.3  # residual without the term / with it, from which on the bend is more than noise
_ADVICE = "give the camera's own intrinsics by --intrinsics, or tilt the board more and fill more of the image"


def solve_intrinsics(views: Sequence[Corners], size: tuple[int, int]) -> tuple[Pinhole, Pinhole]:
    """Solve focal lengths and principal point without distortion (cv2.calibrateCamera); robot poses play no part.

    Args:
        views: the corners of each image.
        size: (width, height) of the images, pixels.

    Returns:
        Intrinsics and their standard errors, pixels.

    Raises:
        CalibrationError: the views leave the focal length open, or the images are visibly distorted.
    """
    rms, matrix, _, errors = _calibrate(views, size, _PINHOLE)
    bent_rms, bent, radial, _ = _calibrate(views, size, _NO_TANGENTIAL)
    pixels = _largest_bend(views, bent, radial)
    if rms > _MIN_BEND_GAIN * bent_rms and pixels > _MAX_BEND_PX:
        raise CalibrationError(
            f"the images are distorted by up to {pixels:.1f} px (radial terms {radial[0]:.3f}, {radial[1]:.3f}): "
            "rectify them first, or record the rectified stream"
        )
    solved = Pinhole(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    if not (0 <= solved.cx < size[0] and 0 <= solved.cy < size[1]) or errors[0] > _MAX_FOCAL_ERROR * solved.fx:
        raise CalibrationError(
            f"the views do not determine the intrinsics (focal length {solved.fx:.0f} px with standard error "
            f"{errors[0]:.0f} px, principal point {solved.cx:.0f}, {solved.cy:.0f}): {_ADVICE}"
        )
    return solved, Pinhole(*errors)


def _calibrate(
    views: Sequence[Corners], size: tuple[int, int], flags: int
) -> tuple[float, np.ndarray, np.ndarray, list[float]]:
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    try:
        rms, matrix, distortion, _, _, errors, *_ = cv2.calibrateCameraExtended(
            points, pixels, size, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise CalibrationError(f"the views do not determine the intrinsics: {_ADVICE}") from error
    return float(rms), matrix, distortion.ravel(), [float(e) for e in errors.ravel()[:4]]


def _largest_bend(views: Sequence[Corners], matrix: np.ndarray, radial: np.ndarray) -> float:
    """Return how far the radial terms move any seen corner, pixels."""
    pixels = np.concatenate([view.pixels for view in views])
    straight = cv2.undistortPoints(pixels[:, None], matrix, radial, P=matrix)
    return float(np.linalg.norm(straight[:, 0] - pixels, axis=1).max())
