"""Measures the error of `manicm-ms calibrate` on images that SAPIEN renders, with noise of image and robot."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from manicm_ms.bench.rendered_board import Studio, look_at, tool_poses
from manicm_ms.errors import CalibrationError
from manicm_ms.sensing.calibration import CharucoSpec, solve_views
from manicm_ms.sensing.calibration.board import detect
from manicm_ms.sensing.calibration.hand_eye import HandEye, Pinhole, View
from manicm_ms.sensing.camera import CameraModel, Crop
from manicm_ms.sensing.camera_files import default_camera

TRUTH = HandEye(
    look_at((0.710, 0.280, 0.432), (0.31, 0.0, 0.15)),
    RigidTransform.from_components([-0.07, -0.1, 0.15], Rotation.from_euler("xyz", [10, -15, 80], degrees=True)),
)
"""The camera's pose that is to be found, and how the board lies in the hand."""
VIEWS, SEEDS = 14, 3


class Stream(NamedTuple):
    """A camera's pictures, and the board that is printed for them.

    Attributes:
        pinhole: intrinsics, pixels.
        size: (width, height), pixels.
        board: what the robot holds.
    """

    pinhole: Pinhole
    size: tuple[int, int]
    board: CharucoSpec


class Disturbance(NamedTuple):
    """What spoils a session.

    Attributes:
        blur: standard deviation of the image's blur, pixels.
        grey: of the image's noise, grey levels.
        shift_mm, turn_deg: RMS errors of the robot's poses.
    """

    blur: float
    grey: float
    shift_mm: float
    turn_deg: float


STREAMS = {
    "1280x720, f 640": Stream(Pinhole(640.0, 640.0, 641.2, 356.1), (1280, 720), CharucoSpec()),
    "640x480, f 384": Stream(Pinhole(383.6, 383.6, 319.5, 239.5), (640, 480), CharucoSpec(4, 5, 0.04, 0.031)),
}
CASES = {
    "as rendered": Disturbance(0.0, 0.0, 0.0, 0.0),
    "blur 1 px, noise 5/255": Disturbance(1.0, 5.0, 0.0, 0.0),
    "robot off by 1 mm, 0.2 deg": Disturbance(0.0, 0.0, 1.0, 0.2),
    "both": Disturbance(1.0, 5.0, 1.0, 0.2),
}
HEAD = (
    "| stream | noise | intrinsics | views | error mm | error deg | standard error told |\n"
    "|---|---|---|---|---|---|---|"
)


def nudge(rng: np.random.Generator, shift_m: float, turn_deg: float) -> RigidTransform:
    """Return a small random transform; the RMS lengths of its two parts are given."""
    scale = np.sqrt(3)
    turn = Rotation.from_rotvec(rng.normal(0, np.deg2rad(turn_deg) / scale, 3))
    return RigidTransform.from_components(rng.normal(0, shift_m / scale, 3), turn)


def error(T_base_camera: RigidTransform, truth: HandEye = TRUTH) -> tuple[float, float]:
    """Return the distance (mm) and angle (deg) to the true camera."""
    step = truth.T_base_camera.inv() * T_base_camera
    return float(1000 * np.linalg.norm(step.translation)), float(np.rad2deg(step.rotation.magnitude()))


class Solved(NamedTuple):
    """What one calibration came to.

    Attributes:
        mm, deg: error.
        told_mm, told_deg: standard error that it told.
        views: views that it used.
    """

    mm: float
    deg: float
    told_mm: float
    told_deg: float
    views: int


def solve(
    images: Sequence[NDArray[np.uint8]],
    tools: Sequence[RigidTransform],
    stream: Stream,
    template: CameraModel | None,
    noise: Disturbance,
    seed: int,
) -> Solved:
    """Calibrate from spoilt images and robot poses.

    Args:
        images: (H, W, 3) uint8, BGR.
        tools: the true T_base_tool of each.
        stream: what made them.
        template: camera whose intrinsics hold; None to solve them too.
        noise: how much is spoilt.
        seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    views, rejected = [], {}
    for i, (image, tool) in enumerate(zip(images, tools, strict=True)):
        sharp = image.astype(float)
        smooth = cv2.GaussianBlur(sharp, (0, 0), noise.blur) if noise.blur else sharp
        noisy = np.clip(smooth + rng.normal(0, noise.grey, image.shape), 0, 255).astype(np.uint8)
        told = tool * nudge(rng, noise.shift_mm / 1000, noise.turn_deg)
        grey = cv2.cvtColor(noisy, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
        try:
            views.append(View(f"{i:02d}", told, detect(stream.board, grey)))
        except CalibrationError as reason:
            rejected[f"{i:02d}"] = str(reason)
    solved = solve_views(views, rejected, stream.board, stream.size, template)
    mm, deg = error(RigidTransform.from_matrix(solved.camera.pose))
    return Solved(mm, deg, solved.standard_error_mm, solved.standard_error_deg, len(solved.views))


def rows(
    streams: Mapping[str, Stream], cases: Mapping[str, Disturbance], views: int = VIEWS, seeds: int = SEEDS
) -> Iterator[str]:
    """Yield the table's rows: each stream and noise, with given and with solved intrinsics."""
    for name, stream in streams.items():
        tools = tool_poses(TRUTH.T_base_camera, TRUTH.T_tool_board, stream.board, views, 0)
        studio = Studio(stream.board, TRUTH.T_base_camera, stream.pinhole, stream.size)
        images = [studio.picture(tool * TRUTH.T_tool_board) for tool in tools]
        width, height = stream.size
        pinhole = stream.pinhole
        template = replace(
            default_camera(), width=width, height=height, fx=pinhole.fx, fy=pinhole.fy, cx=pinhole.cx, cy=pinhole.cy,
            crop=Crop(0, 0, width, height),
        )  # fmt: skip
        for case, noise in cases.items():
            for source, camera in (("given", template), ("solved", None)):
                found = [solve(images, tools, stream, camera, noise, seed) for seed in range(seeds)]
                yield f"| {name} | {case} | {source} | {_cells(found)} |"


def _cells(found: Sequence[Solved]) -> str:
    mm, deg, told_mm, told_deg, used = np.array(found).T
    return (
        f"{used.min():.0f} to {used.max():.0f} | {mm.mean():.2f} (max {mm.max():.2f}) | {deg.mean():.3f} "
        f"(max {deg.max():.3f}) | {told_mm.mean():.2f} mm, {told_deg.mean():.3f} deg"
    )


def bench() -> None:
    """Print the table, row by row."""
    print(HEAD)
    for row in rows(STREAMS, CASES):
        print(row, flush=True)
