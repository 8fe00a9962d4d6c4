"""`manicm-ms calibrate` on images that SAPIEN rendered with a known camera, and on what users get wrong."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import RigidTransform, Rotation
from synthetic_views import BOARD, INFRARED, SIZE, views

from manicm_ms.bench.calibration import TRUTH, error, nudge
from manicm_ms.bench.rendered_board import Studio, tool_poses
from manicm_ms.cli import USER_ERROR, main
from manicm_ms.errors import CalibrationError, CameraError, ConfigError, OutputExistsError, UnknownNameError
from manicm_ms.sensing.calibration import CharucoSpec, calibrate, print_board, solve_views
from manicm_ms.sensing.calibration.board import detect
from manicm_ms.sensing.calibration.other_boards import advice
from manicm_ms.sensing.camera import Crop
from manicm_ms.sensing.camera_files import default_camera, read_camera, write_camera

VIEWS = 12


def write_poses(path, tools):
    """Poses as the guide shows them: position and quaternion."""
    content = {
        name: {"position": tool.translation.tolist(), "quat_wxyz": tool.rotation.as_quat(scalar_first=True).tolist()}
        for name, tool in tools.items()
    }
    path.write_text(json.dumps(content))


def camera_file(path, **changes):
    """Intrinsics of the rendered stream; the pose in it is another and must not matter."""
    camera = replace(
        default_camera(), width=SIZE[0], height=SIZE[1], fx=INFRARED.fx, fy=INFRARED.fy, cx=INFRARED.cx,
        cy=INFRARED.cy, crop=Crop(300, 100, 500, 500), serial="12345", **changes,
    )  # fmt: skip
    write_camera(path, camera)
    return path


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A folder of rendered images with their poses."""
    folder = tmp_path_factory.mktemp("session")
    studio = Studio(BOARD, TRUTH.T_base_camera, INFRARED, SIZE)
    tools = {
        f"{i:02d}.png": t for i, t in enumerate(tool_poses(TRUTH.T_base_camera, TRUTH.T_tool_board, BOARD, VIEWS, 0))
    }
    for name, tool in tools.items():
        assert cv2.imwrite(str(folder / name), studio.picture(tool * TRUTH.T_tool_board))
    write_poses(folder / "poses.json", tools)
    return folder, tools


@pytest.fixture
def copied(session, tmp_path):
    """The same, to be spoilt."""
    folder = tmp_path / "views"
    folder.mkdir()
    for file in session[0].iterdir():
        (folder / file.name).hardlink_to(file)
    return folder


def rewritten(folder, tools):
    (folder / "poses.json").unlink()
    write_poses(folder / "poses.json", tools)
    return folder


def read_pose(path):
    return RigidTransform.from_matrix(read_camera(path).pose)


def assert_refused(kind, match, folder, out, board=BOARD, **options):
    with pytest.raises(kind, match=match) as caught:
        calibrate(folder, board, out, **options)
    assert "\n" not in str(caught.value)
    assert not out.exists()


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in arguments])
    return end.value.code, *capsys.readouterr()


# ---- rendered images


def test_rendered_corners_lie_where_the_camera_sees_them(session):
    folder, tools = session
    for name in list(tools)[:4]:
        corners = detect(BOARD, cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE))
        true = views(poses=[tools[name]])[0].corners
        expected = {tuple(np.round(p, 6)): pixel for p, pixel in zip(true.points, true.pixels, strict=True)}
        differences = [
            px - expected[tuple(np.round(p, 6))] for p, px in zip(corners.points, corners.pixels, strict=True)
        ]
        assert len(differences) == 24
        assert np.abs(differences).max() < 0.5
        assert np.abs(np.mean(differences, axis=0)).max() < 0.05  # half a pixel off would show here


def test_the_command_finds_the_camera_with_given_intrinsics(session, tmp_path, capsys):
    given, out = camera_file(tmp_path / "given.yaml"), tmp_path / "camera.yaml"
    status, printed, _ = run(capsys, "calibrate", session[0], "--out", out, "--intrinsics", given)
    assert status == 0
    assert "reprojection error 0." in printed
    assert "spread between views" in printed
    assert any(line.startswith("noise of corners") and line.endswith("of its size") for line in printed.splitlines())
    assert all(name in printed for name in session[1])
    millimetres, degrees = error(read_pose(out))
    assert millimetres < 0.3  # wanted: 2 mm and 0.3 degrees
    assert degrees < 0.03
    camera, notes = read_camera(out), yaml.safe_load(out.read_text())["notes"]
    assert camera == replace(read_camera(given), T_base_camera=camera.T_base_camera)
    assert 0 < notes["reprojection_error_px"] < 0.2
    assert notes["views"] == list(session[1])
    status, _, told = run(capsys, "calibrate", session[0], "--out", out)
    assert status == USER_ERROR
    assert told.count("\n") == 1
    assert "--overwrite" in told


def test_the_camera_is_found_with_solved_intrinsics_and_replaces_a_file_if_told(session, tmp_path):
    out = tmp_path / "camera.yaml"
    out.write_text("mine")
    with pytest.raises(OutputExistsError, match="--overwrite"):
        calibrate(session[0], BOARD, out)
    assert out.read_text() == "mine"
    solved = calibrate(session[0], BOARD, out, overwrite=True)
    assert solved.camera == read_camera(out)
    millimetres, degrees = error(read_pose(out))
    assert millimetres < 2
    assert degrees < 0.3
    assert solved.camera.fx == pytest.approx(INFRARED.fx, rel=0.005)
    shipped, crop = default_camera(), solved.camera.crop
    assert crop.width / solved.camera.fx == pytest.approx(shipped.crop.width / shipped.fx, rel=0.01)
    assert crop.left + crop.width / 2 - 0.5 == pytest.approx(solved.camera.cx, abs=1)


def test_blur_noise_and_a_robot_that_is_off_stay_within_the_target(session, tmp_path):
    folder, tools = session
    rng, told = np.random.default_rng(0), {}
    for name, tool in tools.items():
        image = cv2.GaussianBlur(cv2.imread(str(folder / name)).astype(float), (0, 0), 1.0)
        noisy = np.clip(image + rng.normal(0, 5, image.shape), 0, 255).astype(np.uint8)
        assert cv2.imwrite(str(tmp_path / name), noisy)
        told[name] = tool * nudge(rng, 1e-3, 0.2)
    write_poses(tmp_path / "poses.json", told)
    solved = calibrate(tmp_path, BOARD, tmp_path / "camera.yaml", intrinsics=camera_file(tmp_path / "given.yaml"))
    millimetres, degrees = error(read_pose(tmp_path / "camera.yaml"))
    assert millimetres < 2
    assert degrees < 0.3
    assert 0.2 < solved.standard_error_mm < 3


def test_small_jpg_images_and_a_csv_of_rotation_vectors(session, tmp_path):
    folder, tools = session
    rows = ["file, x, y, z, rx, ry, rz"]
    for name, tool in tools.items():
        half = cv2.resize(cv2.imread(str(folder / name)), (640, 360), interpolation=cv2.INTER_AREA)
        jpg = name.replace("png", "jpg")
        assert cv2.imwrite(str(tmp_path / jpg), half)
        rows.append(", ".join(map(str, [jpg, *tool.translation, *tool.rotation.as_rotvec()])))
    (tmp_path / "poses.csv").write_text("\n".join(rows))
    calibrate(tmp_path, BOARD, tmp_path / "camera.yaml")
    millimetres, degrees = error(read_pose(tmp_path / "camera.yaml"))
    assert millimetres < 3
    assert degrees < 0.3


def test_views_that_cannot_be_used_are_named_and_left_out(session, copied, tmp_path):
    tools = dict(session[1])
    tools["01.png"], tools["02.png"] = tools["02.png"], tools["01.png"]  # swapped
    tools["gone.png"] = tools["00.png"]
    rewritten(copied, tools)
    (copied / "03.png").unlink()
    assert cv2.imwrite(str(copied / "03.png"), np.full((*SIZE[::-1], 3), 90, np.uint8))
    solved = calibrate(copied, BOARD, tmp_path / "camera.yaml", intrinsics=camera_file(tmp_path / "given.yaml"))
    assert set(solved.rejected) == {"01.png", "02.png", "03.png", "gone.png"}
    assert "no marker" in solved.rejected["03.png"]
    assert "no such image" in solved.rejected["gone.png"]
    assert "differs by" in solved.rejected["01.png"]
    assert error(read_pose(tmp_path / "camera.yaml"))[0] < 0.5


# ---- bad input: one line, nothing written


def test_other_boards_are_refused(session, copied, tmp_path):
    out = tmp_path / "camera.yaml"
    tools = dict(list(session[1].items())[:6])
    rewritten(copied, tools)
    for file in set(copied.glob("*.png")) - {copied / name for name in tools}:
        file.unlink()
    assert_refused(CalibrationError, r"0 of 6 images show .* 6X6_50 .*: --dictionary 4X4_50 fits, in 3 of 3 images",
                   copied, out, replace(BOARD, dictionary="6X6_50"))  # fmt: skip
    assert_refused(CalibrationError, r"a board of 7 x 5 squares .*: --squares 5 7 fits, in 3 of 3 images",
                   copied, out, replace(BOARD, squares_x=7, squares_y=5))  # fmt: skip
    assert_refused(CalibrationError, "not of this board", copied, out, replace(BOARD, squares_x=4, squares_y=4))
    assert_refused(CalibrationError, r"squares are (29|30)\.\d mm, not 28 mm", copied, out,
                   replace(BOARD, square_length=0.028), intrinsics=camera_file(tmp_path / "given.yaml"))  # fmt: skip


def even_board(legacy):
    """With an even number of squares in a column the two patterns differ."""
    return CharucoSpec(6, 8, 0.03, 0.022, "4X4_50", legacy)


@pytest.mark.parametrize(
    ("asked", "shown", "options"),
    [
        (even_board(False), even_board(True), "--legacy"),
        (even_board(True), even_board(False), "--no-legacy"),
        (replace(even_board(False), squares_x=8, squares_y=6), even_board(True), "--squares 6 8 --legacy"),
    ],
)
def test_the_board_that_is_shown_is_found_out(asked, shown, options):
    picture = cv2.copyMakeBorder(shown.picture(3000), 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    with pytest.raises(CalibrationError):
        detect(asked, picture)
    assert advice(asked, [picture]) == f"{options} fits, in 1 of 1 images tried"


def test_no_board_is_advised_where_none_is_shown():
    blank = np.full((480, 640), 128, np.uint8)
    assert advice(BOARD, [blank] * 12) is None
    assert advice(even_board(False), [CharucoSpec(4, 4).picture(3000)]) is None


def test_poses_that_are_missing_are_refused(session, copied, tmp_path):
    tools, out = session[1], tmp_path / "camera.yaml"
    rewritten(copied, {name: tool for name, tool in tools.items() if name != "05.png"})
    assert_refused(CalibrationError, "no robot pose for 05.png", copied, out)
    (copied / "poses.json").unlink()
    assert_refused(CalibrationError, "neither poses.json nor poses.csv", copied, out)


def test_poses_in_another_order_or_inverted_are_refused(tmp_path):
    given, made = read_camera(camera_file(tmp_path / "given.yaml")), views(VIEWS, pixel=0.1)
    order = np.random.default_rng(0).permutation(VIEWS)
    shuffled = [replace(view, T_base_tool=made[k].T_base_tool) for view, k in zip(made, order, strict=True)]
    with pytest.raises(CalibrationError, match="do not agree"):
        solve_views(shuffled, {}, BOARD, SIZE, given)
    inverted = [replace(view, T_base_tool=view.T_base_tool.inv()) for view in made]
    with pytest.raises(CalibrationError, match="T_base_tool in metres"):
        solve_views(inverted, {}, BOARD, SIZE, given)


def test_images_that_are_missing_broken_or_of_another_size_are_refused(session, copied, tmp_path):
    out = tmp_path / "camera.yaml"
    assert_refused(
        CalibrationError, "nowhere does not exist", tmp_path / "nowhere", out, poses=session[0] / "poses.json"
    )
    (copied / "04.png").unlink()
    (copied / "04.png").write_bytes(b"")
    assert_refused(CalibrationError, "04.png is no image", copied, out)
    assert cv2.imwrite(str(copied / "04.png"), np.zeros((480, 640), np.uint8))
    assert_refused(CalibrationError, "04.png is 640x480 pixels and 00.png is 1280x720", copied, out)
    write_camera(tmp_path / "vga.yaml", default_camera())
    assert_refused(CalibrationError, "1280x720 pixels and the intrinsics are for 640x480", session[0], out,
                   intrinsics=tmp_path / "vga.yaml")  # fmt: skip


def test_the_file_of_another_camera_model_is_refused(session, tmp_path):
    content = yaml.safe_load(camera_file(tmp_path / "given.yaml").read_text())
    (tmp_path / "fish.yaml").write_text(yaml.safe_dump({**content, "model": "fisheye"}))
    assert_refused(
        CameraError, r"fisheye.*pinhole", session[0], tmp_path / "out.yaml", intrinsics=tmp_path / "fish.yaml"
    )


def test_too_few_views_are_refused():
    with pytest.raises(CalibrationError, match=r"5 of 7 views are usable, at least 6 .*a.png: dark; b.png: x"):
        solve_views(views(5), {"a.png": "dark", "b.png": "x"}, BOARD, SIZE)


def about(axis, degrees):
    """Tools that turn about one axis of the tool alone, at several places."""
    first = tool_poses(TRUTH.T_base_camera, TRUTH.T_tool_board, BOARD, 1, 0)[0]
    rng = np.random.default_rng(0)
    turns = [Rotation.from_rotvec(np.deg2rad(a) * np.asarray(axis, float)) for a in np.linspace(-degrees, degrees, 10)]
    return [
        RigidTransform.from_components(rng.normal(0, 0.03, 3) + first.translation, first.rotation * t) for t in turns
    ]


@pytest.mark.parametrize(
    ("axis", "degrees", "words"), [((0, 0, 1), 30, "one axis only"), ((1, 0, 0), 4, "turns by only")]
)
def test_degenerate_views_are_refused(axis, degrees, words, tmp_path):
    given = read_camera(camera_file(tmp_path / "given.yaml"))
    with pytest.raises(CalibrationError, match=f"{words}.*turn the hand"):
        solve_views(views(poses=about(axis, degrees), pixel=0.1), {}, BOARD, SIZE, given)


# ---- print


def test_the_printed_board_has_its_size_and_is_found(tmp_path, capsys):
    assert run(capsys, "board", "--out", tmp_path / "board.png")[0] == 0
    sheet = cv2.imread(str(tmp_path / "board.png"), cv2.IMREAD_GRAYSCALE)
    assert sheet.shape == pytest.approx((297 / 25.4 * 300, 210 / 25.4 * 300), abs=1)
    small = cv2.resize(sheet, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    corners = detect(BOARD, small)
    scale = 25.4 / 150  # mm a pixel
    measured = np.linalg.norm(corners.pixels[-1] - corners.pixels[0]) * scale
    assert measured == pytest.approx(1000 * np.linalg.norm(corners.points[-1] - corners.points[0]), abs=0.1)
    with pytest.raises(OutputExistsError):
        print_board(BOARD, tmp_path / "board.png")
    with pytest.raises(ConfigError, match="fits no sheet"):
        print_board(CharucoSpec(9, 12, 0.1, 0.08, "4X4_100"), tmp_path / "large.pdf")


@pytest.mark.parametrize(
    ("fields", "kind", "match"),
    [
        ({"dictionary": "4x4_50"}, UnknownNameError, "4X4_50"),
        ({"marker_length": 0.04}, ConfigError, "marker_length < square_length"),
        ({"squares_x": 2}, ConfigError, "at least 3"),
        ({"squares_x": 20, "squares_y": 20}, ConfigError, "needs 200 markers and 4X4_50 has 50"),
    ],
)
def test_boards_that_cannot_be_are_refused(fields, kind, match):
    with pytest.raises(kind, match=match):
        CharucoSpec(**fields)
