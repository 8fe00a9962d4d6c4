"""The eye-to-hand problem: camera pose and board-in-hand pose from corners seen at known robot poses.

With Z = T_base_camera and X = T_tool_board, every view i says T_base_tool_i X = Z T_camera_board_i. A closed form gives
the start; what is kept minimises the reprojection error of all corners over both poses at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from manicm_ms.sensing.calibration.board import Corners

_HALF_TURN = np.deg2rad(170.0)  # from here on the axis of a rotation's logarithm may flip its sign
_SUBSET, _SUBSETS = 5, 60  # with a quarter of wrong views, all but one in 10^7 draws hold a subset without any
_MM_PER_DEG = 10.0  # what a degree weighs against a millimetre: the arc at half a metre
_FLOOR_PX, _FLOOR_RAD, _FLOOR_M = 0.01, 1e-5, 1e-5  # least noise that is assumed: nothing measured is exact


@dataclass(frozen=True)
class View:
    """What one image says.

    Attributes:
        name: file name.
        T_base_tool: the robot's pose.
        corners: the board's corners in the image.
    """

    name: str
    T_base_tool: RigidTransform
    corners: Corners


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics of an image without distortion, pixels; the centre of the first pixel is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the pixels (K, 2) of points (K, 3) in the camera frame, metres."""
        x, y, z = points.T
        return np.column_stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy])


@dataclass(frozen=True)
class Noise:
    """Standard deviations of what is measured.

    Attributes:
        pixel: of a corner, along each axis, pixels.
        turn: of the robot's orientation, about each axis, radians.
        shift: of the robot's position, along each axis, metres.
    """

    pixel: float
    turn: float
    shift: float

    @property
    def robot(self) -> np.ndarray:
        """(6,) variances of turn and shift: the diagonal of S."""
        return np.array([self.turn**2] * 3 + [self.shift**2] * 3)


@dataclass(frozen=True)
class HandEye:
    """Both unknown poses.

    Attributes:
        T_base_camera: camera in the robot-base frame, OpenCV axes (x right, y down, z forward), metres.
        T_tool_board: board in the tool frame.
    """

    T_base_camera: RigidTransform
    T_tool_board: RigidTransform


def board_pose(corners: Corners, camera: Pinhole) -> RigidTransform:
    """Return T_camera_board of one view: of the two poses that a plane leaves, the one that fits better, refined."""
    points, pixels = corners.points, corners.pixels
    _, rotations, translations, _ = cv2.solvePnPGeneric(
        points, pixels, camera.matrix, None, flags=cv2.SOLVEPNP_IPPE
    )  # best first
    rotation, translation = cv2.solvePnPRefineLM(
        points, pixels, camera.matrix, None, rotations[0].copy(), translations[0].copy()
    )
    return RigidTransform.from_components(translation.ravel(), Rotation.from_rotvec(rotation.ravel()))


def closed_form(tools: Sequence[RigidTransform], boards: Sequence[RigidTransform]) -> HandEye:
    """Solve A X = X B over all pairs of views, rotation first, then translation.

    A = T_base_tool_j^-1 T_base_tool_i and B = T_camera_board_j^-1 T_camera_board_i. The logarithms obey a = R_X b;
    the least-squares rotation is Park and Martin's (Robot sensor calibration: solving AX = XB on the Euclidean group,
    IEEE T-RA 10(5), 1994). OpenCV has it as calibrateHandEye(method=CALIB_HAND_EYE_PARK), which its release 5.0.0 does
    not offer to Python (opencv/opencv#29565).

    Args:
        tools: T_base_tool of each view.
        boards: T_camera_board of each view.
    """
    a, b = _motions(tools, boards)
    turns, seen = a.rotation.as_rotvec(), b.rotation.as_rotvec()
    kept = np.linalg.norm(turns, axis=1) < _HALF_TURN
    rotation, _ = Rotation.align_vectors(turns[kept], seen[kept]) if kept.any() else Rotation.align_vectors(turns, seen)
    # (R_A - I) t_X = R_X t_B - t_A
    left = (a.rotation.as_matrix() - np.eye(3)).reshape(-1, 3)
    right = (rotation.apply(b.translation) - a.translation).ravel()
    T_tool_board = RigidTransform.from_components(np.linalg.lstsq(left, right)[0], rotation)
    each = _stacked(tools) * T_tool_board * _stacked(boards).inv()
    centre = RigidTransform.from_components(np.median(each.translation, axis=0), each.rotation.mean())
    return HandEye(centre, T_tool_board)


def board_scale(hand_eye: HandEye, tools: Sequence[RigidTransform], boards: Sequence[RigidTransform]) -> float:
    """Return by how much the board seems larger to the robot's motions than it was said to be; 1 where all is right."""
    a, b = _motions(tools, boards)  # (R_A - I) t_X - s R_X t_B = -t_A
    turned = hand_eye.T_tool_board.rotation.apply(b.translation)
    left = np.concatenate([a.rotation.as_matrix() - np.eye(3), -turned[..., None]], axis=2)
    return float(np.linalg.lstsq(left.reshape(-1, 4), -a.translation.ravel())[0][3])


def turn_spread(tools: Sequence[RigidTransform]) -> np.ndarray:
    """Return how far the tool turns about its three principal axes, largest first: RMS angles in degrees, (3,).

    Where the second is small all rotation axes are parallel, and the position along them stays unknown.
    """
    rotations = Rotation.concatenate([tool.rotation for tool in tools])
    vectors = (rotations.mean().inv() * rotations).as_rotvec()
    spread = np.linalg.svd(vectors, compute_uv=False) / np.sqrt(len(tools))
    return np.rad2deg(np.pad(spread, (0, 3 - len(spread))))


def residuals(hand_eye: HandEye, views: Sequence[View], camera: Pinhole) -> list[np.ndarray]:
    """Return seen minus predicted pixels, (K, 2) for each view."""
    return _Flat.of(views).residuals(hand_eye, camera)


def rms(residual: np.ndarray) -> float:
    """Return the root mean square of the lengths of (K, 2) residuals, pixels."""
    return float(np.sqrt((residual**2).sum(axis=1).mean()))


def refine(start: HandEye, views: Sequence[View], camera: Pinhole, noise: Noise) -> HandEye:
    """Minimise the reprojection error of all corners over both poses, each view weighted by the inverse of its noise.

    A robot's pose error moves all corners of its view together, by J e. The residuals of a view so have the covariance
    C = pixel^2 I + J S J^T, with S of `Noise.robot`; generalised least squares whitens them by C's Cholesky factor
    (Aitken, 1936). With an exact robot this is the plain reprojection error; without the second term, errors of the
    robot would be paid for by the camera's pose.

    Args:
        start: poses to begin with; the noise is propagated at them.
        views: at least three.
        camera: intrinsics, kept.
        noise: of corners and robot poses.
    """
    return _minimise(start, views, camera, noise)[0]


def _minimise(
    start: HandEye, views: Sequence[View], camera: Pinhole, noise: Noise
) -> tuple[HandEye, np.ndarray, np.ndarray]:
    """Return the solution of `refine`, the whitened residuals there (2M,) and their Jacobian (2M, 12)."""
    flat = _Flat.of(views)
    whitenings = [_whitening(start, view, camera, noise) for view in views]

    def at(x: np.ndarray) -> HandEye:
        return HandEye(
            start.T_base_camera * RigidTransform.from_exp_coords(x[:6]),
            start.T_tool_board * RigidTransform.from_exp_coords(x[6:]),
        )

    def whitened(x: np.ndarray) -> np.ndarray:
        pairs = zip(whitenings, flat.residuals(at(x), camera), strict=True)
        return np.concatenate([whitening @ residual.ravel() for whitening, residual in pairs])

    found = least_squares(whitened, np.zeros(12), x_scale="jac", max_nfev=100, xtol=1e-9, ftol=1e-9, gtol=1e-9)
    return at(found.x), found.fun, found.jac


def estimate_noise(hand_eye: HandEye, views: Sequence[View], camera: Pinhole, before: Noise | None = None) -> Noise:
    """Return the noise of corners and robot poses that the views show at a solution.

    The corners' noise is what is left where each board pose is free. The robot's is the root mean square of the pose
    errors that best explain the residuals: all of what the view's own board pose asks for, or, given the noise that was
    assumed `before`, what is left of it by weighing it against the corners' noise.
    """
    left = [view.corners.pixels - _seen(board_pose(view.corners, camera), view, camera) for view in views]
    degrees = sum(max(r.size - 6, 1) for r in left)  # six of a view's numbers are taken up by its board pose
    pixel = max(np.sqrt(sum((r**2).sum() for r in left) / degrees), _FLOOR_PX)
    if before is None:
        predicted = [
            hand_eye.T_base_camera * board_pose(v.corners, camera) * hand_eye.T_tool_board.inv() for v in views
        ]
        steps = [view.T_base_tool.inv() * pose for view, pose in zip(views, predicted, strict=True)]
        errors = np.array([np.concatenate([s.rotation.as_rotvec(), s.translation]) for s in steps])
    else:
        errors = np.array([_robot_error(hand_eye, view, camera, before) for view in views])
    # 12 of the 6 n errors are taken up by the two poses
    spread = np.sqrt((errors**2).sum(axis=0) / max(len(views) - 2, 1))
    turn, shift = np.sqrt((spread[:3] ** 2).mean()), np.sqrt((spread[3:] ** 2).mean())
    return Noise(float(pixel), max(float(turn), _FLOOR_RAD), max(float(shift), _FLOOR_M))


def standard_error(solved: HandEye, views: Sequence[View], camera: Pinhole, noise: Noise) -> tuple[float, float]:
    """Return the standard error of T_base_camera, (mm, deg), by the jackknife over views.

    The corners of a view share the robot's error of that view, so what they seem to say together is too much; leaving
    out one view at a time does not count on it (Efron and Tibshirani, An introduction to the bootstrap, 1993, chapter
    11). Each time the solution moves by a Gauss-Newton step, for which the views' normal equations are summed.
    """
    _, residual, jacobian = _minimise(solved, views, camera, noise)
    ends = np.cumsum([2 * len(view.corners.points) for view in views])[:-1]
    blocks = list(zip(np.split(jacobian, ends), np.split(residual, ends), strict=True))
    normal, gradient = jacobian.T @ jacobian, jacobian.T @ residual
    without = np.array([-np.linalg.lstsq(normal - j.T @ j, gradient - j.T @ r)[0][:6] for j, r in blocks])
    n = len(views)
    turn, shift = np.sqrt((n - 1) / n * ((without - without.mean(axis=0)) ** 2).sum(axis=0).reshape(2, 3).sum(axis=1))
    return 1000 * float(shift), float(np.rad2deg(turn))


def offsets(hand_eye: HandEye, tools: Sequence[RigidTransform], boards: Sequence[RigidTransform]) -> np.ndarray:
    """Return how far the camera that each view alone would give lies from the solved one: (n, 2), mm and degrees."""
    each = _stacked(tools) * hand_eye.T_tool_board * _stacked(boards).inv()
    steps = hand_eye.T_base_camera.inv() * each
    return np.column_stack([1000 * np.linalg.norm(steps.translation, axis=1), np.rad2deg(steps.rotation.magnitude())])


def consensus(tools: Sequence[RigidTransform], boards: Sequence[RigidTransform], seed: int = 0) -> HandEye:
    """Return the closed form of those few views with which most others agree: a start that wrong views do not pull.

    Least median of squares over random subsets (Rousseeuw, J. Am. Stat. Assoc. 79, 1984), the whole set among them.
    """
    rng = np.random.default_rng(seed)
    subsets = [rng.choice(len(tools), _SUBSET, replace=False) for _ in range(_SUBSETS)] if len(tools) > _SUBSET else []
    best, least = None, np.inf
    for subset in [np.arange(len(tools)), *subsets]:
        trial = closed_form([tools[i] for i in subset], [boards[i] for i in subset])
        millimetres, degrees = np.median(offsets(trial, tools, boards), axis=0)
        cost = millimetres + _MM_PER_DEG * degrees
        if cost < least:
            best, least = trial, cost
    assert best is not None
    return best


def _stacked(poses: Sequence[RigidTransform]) -> RigidTransform:
    return RigidTransform.from_matrix([pose.as_matrix() for pose in poses])


def _motions(
    tools: Sequence[RigidTransform], boards: Sequence[RigidTransform]
) -> tuple[RigidTransform, RigidTransform]:
    """Return A and B of all pairs of views."""
    i, j = np.triu_indices(len(tools), 1)
    tool, board = _stacked(tools), _stacked(boards)
    return tool[j].inv() * tool[i], board[j].inv() * board[i]


def _project(hand_eye: HandEye, view: View, camera: Pinhole) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixels (K, 2), the corners in the tool frame (K, 3) and in the camera frame (K, 3)."""
    in_tool = hand_eye.T_tool_board.apply(view.corners.points)
    in_camera = (hand_eye.T_base_camera.inv() * view.T_base_tool).apply(in_tool)
    return camera.project(in_camera), in_tool, in_camera


def _seen(T_camera_board: RigidTransform, view: View, camera: Pinhole) -> np.ndarray:
    return camera.project(T_camera_board.apply(view.corners.points))


def _robot_jacobian(hand_eye: HandEye, view: View, camera: Pinhole) -> np.ndarray:
    """Return d pixels / d (w, v), (2K, 6), for the robot pose T exp(w, v): turns in radians, shifts in metres."""
    _, in_tool, (x, y, z) = (part.T for part in _project(hand_eye, view, camera))
    zero = np.zeros_like(z)
    pixels = np.array([[camera.fx / z, zero, -camera.fx * x / z**2], [zero, camera.fy / z, -camera.fy * y / z**2]])
    turn = (hand_eye.T_base_camera.inv() * view.T_base_tool).rotation.as_matrix()
    a, b, c = in_tool
    moved = np.array([[zero, c, -b], [-c, zero, a], [b, -a, zero]])  # w x p = -[p]x w
    moved = np.concatenate([moved, np.broadcast_to(np.eye(3)[..., None], (3, 3, len(z)))], axis=1)  # (3, 6, K)
    return np.einsum("ijk,jl,lmk->kim", pixels, turn, moved).reshape(-1, 6)


def _covariance(hand_eye: HandEye, view: View, camera: Pinhole, noise: Noise) -> tuple[np.ndarray, np.ndarray]:
    """Return C (2K, 2K) of a view's residuals and S J^T (6, 2K)."""
    jacobian = _robot_jacobian(hand_eye, view, camera)
    gain = noise.robot[:, None] * jacobian.T
    return noise.pixel**2 * np.eye(len(jacobian)) + jacobian @ gain, gain


def _whitening(hand_eye: HandEye, view: View, camera: Pinhole, noise: Noise) -> np.ndarray:
    covariance, _ = _covariance(hand_eye, view, camera, noise)
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _robot_error(hand_eye: HandEye, view: View, camera: Pinhole, noise: Noise) -> np.ndarray:
    """Return the most probable (w, v) of the robot's pose given a view's residuals, (6,)."""
    covariance, gain = _covariance(hand_eye, view, camera, noise)
    residual = view.corners.pixels - _project(hand_eye, view, camera)[0]
    return gain @ np.linalg.solve(covariance, residual.ravel())


@dataclass(frozen=True)
class _Flat:
    """The corners of all views in one array, so that projecting them is a few numpy calls.

    Attributes:
        turns: (M, 3, 3) rotation of T_base_tool of each corner's view.
        shifts: (M, 3) its translation.
        points: (M, 3) in the board's frame.
        pixels: (M, 2).
        starts: where in these the second view begins, the third and so on.
    """

    turns: np.ndarray
    shifts: np.ndarray
    points: np.ndarray
    pixels: np.ndarray
    starts: np.ndarray

    @classmethod
    def of(cls, views: Sequence[View]) -> _Flat:
        """Return the corners of all views in one row each, with their view's tool pose (metres, base frame)."""
        counts = [len(view.corners.points) for view in views]
        return cls(
            np.repeat([view.T_base_tool.rotation.as_matrix() for view in views], counts, axis=0),
            np.repeat([view.T_base_tool.translation for view in views], counts, axis=0),
            np.concatenate([view.corners.points for view in views]),
            np.concatenate([view.corners.pixels for view in views]),
            np.cumsum(counts)[:-1],
        )

    def residuals(self, hand_eye: HandEye, camera: Pinhole) -> list[np.ndarray]:
        in_tool = hand_eye.T_tool_board.apply(self.points)
        in_base = np.einsum("mij,mj->mi", self.turns, in_tool) + self.shifts
        return np.split(self.pixels - camera.project(hand_eye.T_base_camera.inv().apply(in_base)), self.starts)
