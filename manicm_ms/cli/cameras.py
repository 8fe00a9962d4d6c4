"""`manicm-ms calibrate`, `board` and `cloud`: the commands about the depth camera of a cell."""

from __future__ import annotations

from pathlib import Path

import tyro

from manicm_ms.cli.counts import Count


def calibrate_command(
    images: tyro.conf.Positional[Path],
    out: Path,
    poses: Path | None = None,
    intrinsics: Path | None = None,
    squares: tuple[int, int] = (5, 7),
    square_length: float = 0.030,
    marker_length: float = 0.022,
    dictionary: str = "4X4_50",
    legacy: bool = False,
    overwrite: bool = False,
) -> None:
    """Solve the pose of a fixed camera from images of a ChArUco board in the robot's hand; write the camera file.

    Args:
        images: folder of PNG or JPG images, all of one stream.
        out: camera file to write (YAML), for the tasks, 'manicm-ms cloud' and a real camera.
        poses: robot poses of the images, JSON or CSV; by default poses.json or poses.csv in the folder.
        intrinsics: camera file whose intrinsics hold; without it they are solved from the board.
        squares: squares in a row and in a column of the board.
        square_length: side of a square, metres, as measured on the print.
        marker_length: side of a marker, metres.
        dictionary: OpenCV's marker dictionary.
        legacy: the board was made by OpenCV before 4.6.
        overwrite: replace the camera file where there is one.
    """
    from manicm_ms.cli.calibration import progress, report
    from manicm_ms.cli.listing import console
    from manicm_ms.sensing.calibration import CharucoSpec, calibrate

    board = CharucoSpec(*squares, square_length, marker_length, dictionary, legacy)
    with progress() as on_image:
        solved = calibrate(
            images, board, out, poses=poses, intrinsics=intrinsics, overwrite=overwrite, on_image=on_image
        )
    report(solved, console())
    print(f"{out} written")


def board_command(
    out: Path = Path("board.pdf"),
    squares: tuple[int, int] = (5, 7),
    square_length: float = 0.030,
    marker_length: float = 0.022,
    dictionary: str = "4X4_50",
    legacy: bool = False,
    overwrite: bool = False,
) -> None:
    """Draw a ChArUco board for calibrate at its exact size, to be printed at 100 %.

    Args:
        out: NAME.pdf, NAME.svg or NAME.png.
        squares: squares in a row and in a column.
        square_length: side of a square, metres.
        marker_length: side of a marker, metres.
        dictionary: OpenCV's marker dictionary.
        legacy: the pattern of OpenCV before 4.6.
        overwrite: replace the file where there is one.
    """
    from manicm_ms.sensing.calibration import CharucoSpec, print_board

    board = CharucoSpec(*squares, square_length, marker_length, dictionary, legacy)
    paper = print_board(board, out, overwrite=overwrite)
    print(f"{out}: {board}; print it on {paper} at 100 % and measure a row of squares")


def cloud_command(
    depth: tyro.conf.Positional[Path],
    camera: Path,
    out: Path,
    env: str = "ur3e/slide-block",
    realism: str = "d435i",
    num_points: Count = 512,
    overwrite: bool = False,
) -> None:
    """Turn a recorded depth image into the cloud that a policy sees, exactly as the simulator makes its own.

    Args:
        depth: a PNG of one 16-bit channel, of the camera's native size, in its depth units.
        camera: camera file of the cell, as 'manicm-ms calibrate' writes it.
        out: where to write the points, metres, robot-base frame: NAME.ply or NAME.npy.
        env: environment whose workspace box crops the cloud.
        realism: preset whose crop floor applies; a real camera's errors lift the table above that of clean.
        num_points: points wanted.
        overwrite: replace the file where there is one.
    """
    from manicm_ms.cli.cloud import cloud

    cloud(depth, camera, out, env, realism, num_points, overwrite)
