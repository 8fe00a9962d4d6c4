"""Measure the error of `manicm-ms calibrate` on images that SAPIEN renders, with noise of image and robot.

    python scripts/bench_calibration.py

prints the table of docs/results/calibration.md.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "calibration"))

from rendered_board import Studio, tool_poses
from synthetic_views import TRUTH, error, nudge

from manicm_ms.errors import CalibrationError
from manicm_ms.sensing.calibration import CharucoSpec, solve_views
from manicm_ms.sensing.calibration.board import detect
from manicm_ms.sensing.calibration.hand_eye import Pinhole, View
from manicm_ms.sensing.camera import Crop
from manicm_ms.sensing.camera_files import default_camera

VIEWS, SEEDS = 14, 3
STREAMS = {
    "1280x720, f 640": (Pinhole(640.0, 640.0, 641.2, 356.1), (1280, 720), CharucoSpec()),
    "640x480, f 384": (Pinhole(383.6, 383.6, 319.5, 239.5), (640, 480), CharucoSpec(4, 5, 0.04, 0.031)),
}
CASES = {  # blur (px), noise (grey levels), robot (mm, deg)
    "as rendered": (0.0, 0.0, 0.0, 0.0),
    "blur 1 px, noise 5/255": (1.0, 5.0, 0.0, 0.0),
    "robot off by 1 mm, 0.2 deg": (0.0, 0.0, 1.0, 0.2),
    "both": (1.0, 5.0, 1.0, 0.2),
}


def main() -> None:
    """Print the table."""
    print("| stream | noise | intrinsics | views | error mm | error deg | standard error told |")
    print("|---|---|---|---|---|---|---|")
    for stream, (pinhole, size, board) in STREAMS.items():
        tools = tool_poses(TRUTH.T_base_camera, TRUTH.T_tool_board, board, VIEWS, 0)
        studio = Studio(board, TRUTH.T_base_camera, pinhole, size)
        images = [studio.picture(tool * TRUTH.T_tool_board) for tool in tools]
        template = replace(
            default_camera(), width=size[0], height=size[1], fx=pinhole.fx, fy=pinhole.fy, cx=pinhole.cx, cy=pinhole.cy,
            crop=Crop(0, 0, *size),
        )  # fmt: skip
        for case, values in CASES.items():
            for source, camera in (("given", template), ("solved", None)):
                rows = [solve(images, tools, board, size, camera, values, seed) for seed in range(SEEDS)]
                mm, deg, told_mm, told_deg, used = np.array(rows).T
                print(
                    f"| {stream} | {case} | {source} | {used.min():.0f} to {used.max():.0f} | {mm.mean():.2f} "
                    f"(max {mm.max():.2f}) | {deg.mean():.3f} (max {deg.max():.3f}) | {told_mm.mean():.2f} mm, "
                    f"{told_deg.mean():.3f} deg |",
                    flush=True,
                )


def solve(images, tools, board, size, template, values, seed):
    """Error (mm, deg), standard error told (mm, deg) and number of views used."""
    rng, (blur, grey, shift_mm, turn_deg) = np.random.default_rng(seed), values
    views, rejected = [], {}
    for i, (image, tool) in enumerate(zip(images, tools, strict=True)):
        smooth = cv2.GaussianBlur(image.astype(float), (0, 0), blur) if blur else image.astype(float)
        noisy = np.clip(smooth + rng.normal(0, grey, image.shape), 0, 255).astype(np.uint8)
        told = tool * nudge(rng, shift_mm / 1000, turn_deg)
        try:
            views.append(View(f"{i:02d}", told, detect(board, cv2.cvtColor(noisy, cv2.COLOR_BGR2GRAY))))
        except CalibrationError as reason:
            rejected[f"{i:02d}"] = str(reason)
    solved = solve_views(views, rejected, board, size, template)
    found = error(RigidTransform.from_matrix(solved.camera.pose))
    return *found, solved.standard_error_mm, solved.standard_error_deg, len(solved.views)


if __name__ == "__main__":
    main()
