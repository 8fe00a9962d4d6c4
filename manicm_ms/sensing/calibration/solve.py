"""From a folder of images and the robot's poses to the camera file: which views are used, what is solved and told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from manicm_ms.errors import CalibrationError
from manicm_ms.paths import require_free
from manicm_ms.sensing.calibration import other_boards
from manicm_ms.sensing.calibration.board import CharucoSpec, detect
from manicm_ms.sensing.calibration.hand_eye import (
    HandEye,
    Noise,
    Pinhole,
    View,
    board_pose,
    board_scale,
    consensus,
    estimate_noise,
    offsets,
    refine,
    residuals,
    rms,
    standard_error,
    turn_spread,
)
from manicm_ms.sensing.calibration.intrinsics import solve_intrinsics
from manicm_ms.sensing.calibration.robot_poses import read_poses
from manicm_ms.sensing.camera import CameraModel, Crop
from manicm_ms.sensing.camera_files import default_camera, read_camera, write_camera

MIN_VIEWS = 6
"""Views that are needed: three determine both poses, the others show whether one of them is wrong."""
MIN_TURN_DEG = (5.0, 3.0)
"""RMS angles by which the tool must turn about its first and its second principal axis."""
_IMAGES = (".png", ".jpg", ".jpeg")
_MAX_BOARD_PX = 1.5  # RMS of a view's corners about the best board pose: beyond, blurred, bent or of other intrinsics
_OUTLIER = 5.0  # times the median offset, from which on a view disagrees with the others
_LEAST_OUTLIER = np.array([4.0, 0.6])  # mm, deg; offsets below are never outliers
_MAX_OFFSET = np.array([15.0, 3.0])  # mm, deg; a median beyond it is no noise of a robot
_MIN_AGREEING = 0.6  # of the views
_MAX_SCALE_ERROR = 0.02  # of the board, as the robot's motions measure it
_NOISE_ROUNDS = 3
_NAMED = 5  # images that a message names


@dataclass(frozen=True)
class ViewResult:
    """How a view that was used fits.

    Attributes:
        name: file name.
        corners: corners seen.
        board_px: RMS of its corners about its own best board pose, pixels.
        error_px: RMS of its reprojection error with the robot's pose as given, pixels.
        offset_mm: distance from the camera that this view alone would give to the solved one.
        offset_deg: angle between them.
    """

    name: str
    corners: int
    board_px: float
    error_px: float
    offset_mm: float
    offset_deg: float


@dataclass(frozen=True)
class Calibration:
    """A solved camera and how well it is known.

    Attributes:
        camera: what is written to the file.
        T_tool_board: board in the tool frame.
        board: that was looked for.
        views: those used.
        rejected: name and reason of the others.
        error_px: RMS reprojection error over all corners used, pixels.
        standard_error_mm: of the camera's position.
        standard_error_deg: of its orientation.
        noise: of corners and robot poses, as the views show it.
        board_scale: size of the board as the robot's motions measure it / as it was given.
        intrinsics_error: standard errors of solved intrinsics; None where they were given.
    """

    camera: CameraModel
    T_tool_board: RigidTransform
    board: CharucoSpec
    views: tuple[ViewResult, ...]
    rejected: dict[str, str]
    error_px: float
    standard_error_mm: float
    standard_error_deg: float
    noise: Noise
    board_scale: float
    intrinsics_error: Pinhole | None

    @property
    def spread(self) -> tuple[float, float]:
        """RMS offset of the views' own cameras from the solved one, (mm, deg)."""
        each = np.array([(view.offset_mm, view.offset_deg) for view in self.views])
        millimetres, degrees = np.sqrt((each**2).mean(axis=0))
        return float(millimetres), float(degrees)

    def notes(self) -> dict[str, Any]:
        """Return where the numbers come from, for the camera file."""
        spread_mm, spread_deg = self.spread
        return {
            "calibration": str(self.board),
            "intrinsics": "given" if self.intrinsics_error is None else "solved from the board",
            "views": [view.name for view in self.views],
            "rejected": dict(self.rejected),
            "reprojection_error_px": round(self.error_px, 4),
            "standard_error": {"mm": round(self.standard_error_mm, 3), "deg": round(self.standard_error_deg, 4)},
            "spread_between_views": {"mm": round(spread_mm, 3), "deg": round(spread_deg, 4)},
            "T_tool_board": [[float(x) for x in row] for row in self.T_tool_board.as_matrix()],
        }


def calibrate(
    images: Path,
    board: CharucoSpec,
    out: Path,
    *,
    poses: Path | None = None,
    intrinsics: Path | None = None,
    overwrite: bool = False,
    on_image: Callable[[str], None] | None = None,
) -> Calibration:
    """Solve the camera's pose in the robot-base frame and write the camera file.

    Args:
        images: folder of PNG or JPG images of the board in the robot's hand, from the camera that stands still.
        board: the board.
        out: camera file to write (YAML).
        poses: robot poses (`read_poses`); by default poses.json or poses.csv in `images`.
        intrinsics: camera file whose intrinsics, crop, depth unit and names hold; None solves the intrinsics from the
            board and takes a crop with the field of view of the camera that the package ships.
        overwrite: replace `out`.
        on_image: called with the name of each image before it is searched.

    Raises:
        CalibrationError, CameraError, OutputExistsError: see the message; nothing was written.
    """
    require_free(out, overwrite)
    template = None if intrinsics is None else read_camera(intrinsics)
    tools = read_poses(poses or _poses_beside(images))
    pictures = _read_images(images, tools, template)
    seen, rejected = _detect(pictures, tools, board, on_image or (lambda name: None))
    if len(seen) < MIN_VIEWS and (fits := other_boards.advice(board, list(pictures.values()))):
        raise CalibrationError(f"{len(seen)} of {len(pictures)} images show a {board}: {fits}")
    size = next(iter(pictures.values())).shape[::-1]
    solved = solve_views(seen, rejected, board, (size[0], size[1]), template)
    write_camera(out, solved.camera, notes=solved.notes())
    return solved


def solve_views(
    views: Sequence[View],
    rejected: dict[str, str],
    board: CharucoSpec,
    size: tuple[int, int],
    template: CameraModel | None = None,
) -> Calibration:
    """Solve a calibration from corners that were found.

    Args:
        views: corners and robot poses.
        rejected: name -> reason of the images that gave no view; for the report.
        board: the board.
        size: (width, height) of the images, pixels.
        template: camera whose intrinsics hold; None solves them.

    Raises CalibrationError where the views are too few, turn too little, or do not agree.
    """
    rejected = dict(rejected)
    _require_enough(views, rejected)
    pinhole, errors = _intrinsics(views, size, template)
    views = _good_boards(views, pinhole, rejected)
    views, start = _agreeing(views, pinhole, board, rejected)
    hand_eye, noise = _fit(start, views, pinhole)
    tools, boards = [view.T_base_tool for view in views], [board_pose(view.corners, pinhole) for view in views]
    left = residuals(hand_eye, views, pinhole)
    table = zip(views, boards, left, offsets(hand_eye, tools, boards), strict=True)
    millimetres, degrees = standard_error(hand_eye, views, pinhole, noise)
    return Calibration(
        camera=_camera(hand_eye.T_base_camera, pinhole, size, template),
        T_tool_board=hand_eye.T_tool_board,
        board=board,
        views=tuple(
            ViewResult(view.name, len(r), _board_px(view, pose, pinhole), rms(r), float(mm), float(deg))
            for view, pose, r, (mm, deg) in table
        ),
        rejected=rejected,
        error_px=rms(np.concatenate(left)),
        standard_error_mm=millimetres,
        standard_error_deg=degrees,
        noise=noise,
        board_scale=board_scale(hand_eye, tools, boards),
        intrinsics_error=errors,
    )


# ---- input ------------------------------------------------------------------------------------------------------


def _poses_beside(images: Path) -> Path:
    _require_folder(images)
    found = [path for path in (images / "poses.json", images / "poses.csv") if path.is_file()]
    if len(found) != 1:
        has = "both poses.json and poses.csv" if found else "neither poses.json nor poses.csv"
        raise CalibrationError(f"{images} holds {has}: name the file of the robot's poses by --poses")
    return found[0]


def _require_folder(images: Path) -> None:
    if not images.is_dir():
        what = "is a file" if images.exists() else "does not exist"
        raise CalibrationError(f"{images} {what}: name the folder of the recorded views")


def _read_images(folder: Path, tools: dict[str, RigidTransform], template: CameraModel | None) -> dict[str, np.ndarray]:
    """Return name -> (H, W) uint8 of all images, which have a pose each and one size, that of the intrinsics."""
    _require_folder(folder)
    names = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in _IMAGES)
    if not names:
        raise CalibrationError(f"{folder} holds no image ({', '.join(_IMAGES)}): name the folder of the recorded views")
    if without := [name for name in names if name not in tools]:
        raise CalibrationError(
            f"no robot pose for {', '.join(without[:_NAMED])}{' ...' if len(without) > _NAMED else ''} of {folder}: "
            "add them to the poses, or move these images away"
        )
    pictures: dict[str, np.ndarray] = {}
    for name in names:
        data = np.frombuffer((folder / name).read_bytes(), np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
        if picture is None:
            raise CalibrationError(f"{folder / name} is no image that can be read: record it again or move it away")
        pictures[name] = picture
    _require_one_size(folder, pictures, template)
    return pictures


def _require_one_size(folder: Path, pictures: dict[str, np.ndarray], template: CameraModel | None) -> None:
    first = next(iter(pictures))
    wanted = pictures[first].shape if template is None else (template.height, template.width)
    told = first if template is None else "the intrinsics"
    for name, picture in pictures.items():
        if picture.shape != wanted:
            raise CalibrationError(
                f"{folder / name} is {picture.shape[1]}x{picture.shape[0]} pixels and {told} "
                f"{'is' if template is None else 'are for'} {wanted[1]}x{wanted[0]}: record all views in one stream, "
                "and give the intrinsics of that stream"
            )


def _detect(
    pictures: dict[str, np.ndarray],
    tools: dict[str, RigidTransform],
    board: CharucoSpec,
    on_image: Callable[[str], None],
) -> tuple[list[View], dict[str, str]]:
    views, rejected = [], {name: "no such image" for name in tools if name not in pictures}
    for name, picture in pictures.items():
        on_image(name)
        try:
            views.append(View(name, tools[name], detect(board, picture)))
        except CalibrationError as reason:
            rejected[name] = str(reason)
    return views, rejected


# ---- which views may be used ------------------------------------------------------------------------------------


def _intrinsics(
    views: Sequence[View], size: tuple[int, int], template: CameraModel | None
) -> tuple[Pinhole, Pinhole | None]:
    if template is not None:
        return Pinhole(template.fx, template.fy, template.cx, template.cy), None
    return solve_intrinsics([view.corners for view in views], size)


def _good_boards(views: Sequence[View], camera: Pinhole, rejected: dict[str, str]) -> list[View]:
    """Return the views whose corners lie where some pose of the board puts them."""
    kept = []
    for view in views:
        left = _board_px(view, board_pose(view.corners, camera), camera)
        if left <= _MAX_BOARD_PX:
            kept.append(view)
        else:
            rejected[view.name] = f"its corners fit the board only to {left:.1f} px: blurred, bent or other intrinsics"
    _require_enough(kept, rejected)
    return kept


def _agreeing(
    views: Sequence[View], camera: Pinhole, board: CharucoSpec, rejected: dict[str, str]
) -> tuple[list[View], HandEye]:
    """Return the views on whose camera most agree, and a start; name the others in `rejected`."""
    tools, boards = [view.T_base_tool for view in views], [board_pose(view.corners, camera) for view in views]
    _require_turns(tools)
    start = consensus(tools, boards)
    each = offsets(start, tools, boards)
    median = np.median(each, axis=0)
    good = (each <= np.maximum(_OUTLIER * median, _LEAST_OUTLIER)).all(axis=1)
    if (median > _MAX_OFFSET).any() or good.mean() < _MIN_AGREEING:
        raise CalibrationError(
            f"images and robot poses do not agree (the cameras of single views differ by {median[0]:.0f} mm and "
            f"{median[1]:.1f} deg): poses must be T_base_tool in metres, in the order of the images, with the board "
            f"fixed in the hand and the camera standing still"
        )
    agreed = np.flatnonzero(good)
    scale = board_scale(start, [tools[i] for i in agreed], [boards[i] for i in agreed])
    if abs(scale - 1) > _MAX_SCALE_ERROR:
        raise CalibrationError(
            f"by the robot's motions the board's squares are {1000 * scale * board.square_length:.1f} mm, not "
            f"{1000 * board.square_length:g} mm: measure the printed board, and check the intrinsics' focal length"
        )
    for view, keep, (mm, deg) in zip(views, good, each, strict=True):
        if not keep:
            rejected[view.name] = f"its camera differs by {mm:.0f} mm and {deg:.1f} deg from the other views'"
    kept = [view for view, keep in zip(views, good, strict=True) if keep]
    _require_enough(kept, rejected)
    _require_turns([view.T_base_tool for view in kept])
    return kept, start


def _require_enough(views: Sequence[View], rejected: dict[str, str]) -> None:
    if len(views) >= MIN_VIEWS:
        return
    why = "; ".join(f"{name}: {reason}" for name, reason in sorted(rejected.items()))
    raise CalibrationError(
        f"{len(views)} of {len(views) + len(rejected)} views are usable, at least {MIN_VIEWS} are needed"
        f"{f' ({why})' if why else ': record more'}"
    )


def _require_turns(tools: Sequence[RigidTransform]) -> None:
    first, second, _ = turn_spread(tools)
    what = None
    if first < MIN_TURN_DEG[0]:
        what = f"the tool turns by only {first:.1f} deg RMS, at least {MIN_TURN_DEG[0]:g} are needed"
    elif second < MIN_TURN_DEG[1]:
        what = (
            f"the tool turns about one axis only ({first:.1f} deg RMS about it, {second:.1f} across, at least "
            f"{MIN_TURN_DEG[1]:g} are needed), which leaves the camera's position along it open"
        )
    if what:
        raise CalibrationError(f"{what}: turn the hand by 20 to 30 deg about two axes or three between views")


# ---- solution ---------------------------------------------------------------------------------------------------


def _fit(start: HandEye, views: Sequence[View], camera: Pinhole) -> tuple[HandEye, Noise]:
    """Return the refined poses and the noise under which they are the most probable ones."""
    noise = estimate_noise(start, views, camera)
    solved = start
    for _ in range(_NOISE_ROUNDS):
        solved = refine(solved, views, camera, noise)
        noise = estimate_noise(solved, views, camera, noise)
    return refine(solved, views, camera, noise), noise


def _board_px(view: View, T_camera_board: RigidTransform, camera: Pinhole) -> float:
    return rms(view.corners.pixels - camera.project(T_camera_board.apply(view.corners.points)))


def _camera(
    T_base_camera: RigidTransform, camera: Pinhole, size: tuple[int, int], template: CameraModel | None
) -> CameraModel:
    rows = tuple(tuple(float(x) for x in row) for row in T_base_camera.as_matrix())
    if template is not None:
        return replace(template, T_base_camera=rows)
    fx, fy, cx, cy = (float(number) for number in astuple(camera))
    return CameraModel(*size, fx, fy, cx, cy, T_base_camera=rows, crop=_crop_like_default(camera, size))


def _crop_like_default(camera: Pinhole, size: tuple[int, int]) -> Crop:
    """Return the part of the image that spans the angle of the shipped camera's crop, as far as the image goes."""
    shipped = default_camera()
    sides = shipped.crop.width * camera.fx / shipped.fx, shipped.crop.height * camera.fy / shipped.fy
    width, height = (min(round(side), whole) for side, whole in zip(sides, size, strict=True))
    left, top = round(camera.cx + 0.5 - width / 2), round(camera.cy + 0.5 - height / 2)
    return Crop(min(max(left, 0), size[0] - width), min(max(top, 0), size[1] - height), width, height)
