"""Calibration of a fixed camera against a robot that holds a ChArUco board (eye to hand)."""

from manicm_ms.sensing.calibration.board import DICTIONARIES, CharucoSpec, print_board
from manicm_ms.sensing.calibration.robot_poses import read_poses
from manicm_ms.sensing.calibration.solve import Calibration, calibrate, solve_views

__all__ = ["DICTIONARIES", "Calibration", "CharucoSpec", "calibrate", "print_board", "read_poses", "solve_views"]
