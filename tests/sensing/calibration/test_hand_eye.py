"""The eye-to-hand solution against closed forms, finite differences, OpenCV and simulated noise."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic_views import BOARD, INFRARED, project, views

from manicm_ms.bench.calibration import TRUTH, error, nudge
from manicm_ms.bench.rendered_board import tool_poses
from manicm_ms.errors import CalibrationError
from manicm_ms.sensing.calibration import hand_eye
from manicm_ms.sensing.calibration.hand_eye import (
    HandEye,
    Noise,
    board_pose,
    board_scale,
    closed_form,
    consensus,
    estimate_noise,
    refine,
    standard_error,
    turn_spread,
)
from manicm_ms.sensing.calibration.intrinsics import solve_intrinsics
from manicm_ms.sensing.calibration.solve import _fit

QUIET = Noise(0.1, 1e-5, 1e-5)


def poses(made):
    return [view.T_base_tool for view in made], [board_pose(view.corners, INFRARED) for view in made]


def test_a_boards_pose_is_the_one_that_made_its_corners():
    for view in views(6):
        true = TRUTH.T_base_camera.inv() * view.T_base_tool * TRUTH.T_tool_board
        np.testing.assert_allclose(board_pose(view.corners, INFRARED).as_matrix(), true.as_matrix(), atol=1e-6)


def test_exact_poses_give_the_exact_camera_in_closed_form():
    tools = [view.T_base_tool for view in views()]
    boards = [TRUTH.T_base_camera.inv() * tool * TRUTH.T_tool_board for tool in tools]
    solved = closed_form(tools, boards)
    np.testing.assert_allclose(solved.T_base_camera.as_matrix(), TRUTH.T_base_camera.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(solved.T_tool_board.as_matrix(), TRUTH.T_tool_board.as_matrix(), atol=1e-9)


def test_the_closed_form_is_opencvs_park():
    rng = np.random.default_rng(7)
    tools = tool_poses(TRUTH.T_base_camera, TRUTH.T_tool_board, BOARD, 6, 7)
    boards = [TRUTH.T_base_camera.inv() * tool * TRUTH.T_tool_board * nudge(rng, 2e-3, 0.5) for tool in tools]
    solved = closed_form(tools, boards).T_tool_board
    # cv2.calibrateHandEye(tools, inverse boards, method=CALIB_HAND_EYE_PARK) of OpenCV 4.14.0
    np.testing.assert_allclose(solved.rotation.as_rotvec(), [0.33669832, -0.09884626, 1.40110983], atol=2e-8)
    np.testing.assert_allclose(solved.translation, [-0.06957233, -0.10088369, 0.14929637], atol=2e-8)


def test_exact_corners_give_the_camera_to_a_millionth():
    made = views(8)
    rng = np.random.default_rng(3)
    start = HandEye(TRUTH.T_base_camera * nudge(rng, 0.02, 3), TRUTH.T_tool_board * nudge(rng, 0.02, 3))
    solved = refine(start, made, INFRARED, QUIET)
    np.testing.assert_allclose(solved.T_base_camera.as_matrix(), TRUTH.T_base_camera.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(solved.T_tool_board.as_matrix(), TRUTH.T_tool_board.as_matrix(), atol=1e-6)


def test_how_a_robots_error_moves_the_corners_against_finite_differences():
    view, step = views(1)[0], 1e-6
    analytic = hand_eye._robot_jacobian(TRUTH, view, INFRARED)
    for k, e in enumerate(step * np.eye(6)):
        turn, shift = Rotation.from_rotvec(e[:3]), e[3:]
        sides = []
        for sign in (1, -1):
            moved = RigidTransform.from_components(sign * shift, turn if sign == 1 else turn.inv())
            T_camera_board = TRUTH.T_base_camera.inv() * view.T_base_tool * moved * TRUTH.T_tool_board
            sides.append(project(T_camera_board, view.corners.points, INFRARED).ravel())
        np.testing.assert_allclose(analytic[:, k], (sides[0] - sides[1]) / (2 * step), rtol=1e-4, atol=1e-3)


def solved_errors(seeds=4, **noise):
    """RMS error of closed form and of the fit, and RMS of what the fit itself expects: (3, 2), mm and deg."""
    rows = []
    for seed in range(seeds):
        made = views(12, seed, **noise)
        start = closed_form(*poses(made))
        solved, found = _fit(start, made, INFRARED)
        rows.append(
            (error(start.T_base_camera), error(solved.T_base_camera), standard_error(solved, made, INFRARED, found))
        )
    return np.sqrt((np.array(rows) ** 2).mean(axis=0))


def test_with_noisy_corners_the_fit_is_better_than_the_closed_form():
    start, solved, expected = solved_errors(pixel=0.3)
    assert (solved < 0.5 * start).all()
    assert (solved < 3 * expected).all()
    assert (expected < 3 * solved).all()


def test_with_a_noisy_robot_the_fit_is_no_worse_and_knows_its_error():
    start, solved, expected = solved_errors(pixel=0.1, shift_m=1e-3, turn_deg=0.2)
    assert (solved < 1.2 * start).all()
    assert solved[0] < 2
    assert solved[1] < 0.3
    assert (solved < 3 * expected).all()
    assert (expected < 3 * solved).all()


def test_the_noise_is_recovered():
    made = views(40, pixel=0.2, shift_m=1.2e-3, turn_deg=0.3)
    _, found = _fit(closed_form(*poses(made)), made, INFRARED)
    assert found.pixel == pytest.approx(0.2, rel=0.15)
    assert found.shift == pytest.approx(1.2e-3 / np.sqrt(3), rel=0.3)
    assert found.turn == pytest.approx(np.deg2rad(0.3) / np.sqrt(3), rel=0.3)


def test_an_exact_robot_is_found_to_be_exact():
    made = views(12, pixel=0.1)
    start = closed_form(*poses(made))
    assert estimate_noise(start, made, INFRARED).shift > 1e-4  # what the board poses' own noise feigns
    assert _fit(start, made, INFRARED)[1].shift < 1e-4


def test_wrong_views_do_not_pull_the_consensus():
    tools, boards = poses(views(12, pixel=0.1))
    tools[2], tools[7] = tools[7], tools[2]
    pulled, held = error(closed_form(tools, boards).T_base_camera), error(consensus(tools, boards).T_base_camera)
    assert pulled[0] > 20
    assert held[0] < 5
    assert held[1] < 0.6


def test_the_jackknife_is_what_leaving_out_each_view_gives():
    made = views(8, pixel=0.2, shift_m=1e-3, turn_deg=0.2)
    solved, noise = _fit(closed_form(*poses(made)), made, INFRARED)
    each = [refine(solved, made[:i] + made[i + 1 :], INFRARED, noise).T_base_camera for i in range(len(made))]
    steps = RigidTransform.from_matrix([(solved.T_base_camera.inv() * pose).as_matrix() for pose in each])
    shifts, turns = (np.sqrt(7 * part.var(axis=0).sum()) for part in (steps.translation, steps.rotation.as_rotvec()))
    assert standard_error(solved, made, INFRARED, noise) == pytest.approx((1000 * shifts, np.rad2deg(turns)), rel=0.05)


def test_the_consensus_repeats():
    tools, boards = poses(views(9, pixel=0.3))
    once, again = consensus(tools, boards), consensus(tools, boards)
    assert (once.T_base_camera.as_matrix() == again.T_base_camera.as_matrix()).all()


def test_the_robots_motions_measure_the_board():
    tools, boards = poses(views())
    shrunk = [RigidTransform.from_components(b.translation / 1.05, b.rotation) for b in boards]
    assert board_scale(closed_form(tools, boards), tools, boards) == pytest.approx(1, abs=1e-6)
    assert board_scale(closed_form(tools, shrunk), tools, shrunk) == pytest.approx(1.05, abs=1e-6)


def test_turn_spread_of_turns_about_one_axis_and_of_known_angles():
    def turned(*angles):
        return [RigidTransform.from_rotation(Rotation.from_rotvec(np.deg2rad(a))) for a in angles]

    spread = turn_spread(turned((0, 0, 20), (0, 0, -20), (0, 0, 20), (0, 0, -20)))
    np.testing.assert_allclose(spread, [20, 0, 0], atol=1e-9)
    spread = turn_spread(turned((10, 0, 0), (-10, 0, 0), (0, 4, 0), (0, -4, 0)))
    np.testing.assert_allclose(spread, [10 / np.sqrt(2), 4 / np.sqrt(2), 0], atol=1e-6)


def test_intrinsics_of_exact_corners():
    solved, errors = solve_intrinsics([view.corners for view in views(10)], (1280, 720))
    np.testing.assert_allclose(solved.matrix, INFRARED.matrix, atol=0.05)
    assert errors.fx < 0.05


def test_distorted_images_are_refused():
    made = []
    for view in views(12):
        x = (view.corners.pixels - [INFRARED.cx, INFRARED.cy]) / INFRARED.fx
        bent = x * (1 - 0.25 * (x**2).sum(axis=1, keepdims=True))
        pixels = bent * INFRARED.fx + [INFRARED.cx, INFRARED.cy]
        made.append(type(view.corners)(pixels, view.corners.points))
    with pytest.raises(CalibrationError, match=r"distorted by up to \d.*rectify"):
        solve_intrinsics(made, (1280, 720))


def test_boards_that_all_face_the_camera_leave_the_focal_length_open():
    rng = np.random.default_rng(0)
    made = []
    for _ in range(8):
        at = RigidTransform.from_translation([rng.uniform(-0.2, 0.1), rng.uniform(-0.2, 0), 0.5])
        made.append(at * RigidTransform.from_rotation(Rotation.from_rotvec([0, 0, rng.uniform(-1, 1)])))
    tools = [TRUTH.T_base_camera * at * TRUTH.T_tool_board.inv() for at in made]
    with pytest.raises(CalibrationError, match=r"do not determine the intrinsics.*--intrinsics"):
        solve_intrinsics([view.corners for view in views(poses=tools, pixel=0.1)], (1280, 720))


def test_the_board_lies_as_its_description_says():
    points = np.asarray(BOARD.board().getChessboardCorners())
    assert points.shape == (24, 3)
    np.testing.assert_allclose(points[0], [0.03, 0.03, 0], atol=1e-7)
    np.testing.assert_allclose(points[-1], [0.12, 0.18, 0], atol=1e-7)
