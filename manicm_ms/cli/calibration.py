"""`manicm-ms calibrate` and `board`: what they print."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.table import Table

from manicm_ms.progress import progress_bars
from manicm_ms.sensing.calibration import Calibration

_POOR_MM, _POOR_DEG = 3.0, 0.5  # standard errors above which more views are worth their while


@contextmanager
def progress() -> Iterator[Callable[[str], None]]:
    """Show the image that is being searched; yields what is to be called with its name."""
    with progress_bars(Console(stderr=True), "{task.fields[image]}") as shown:
        task = shown.add_task("looking for the board", total=None, image="")
        yield lambda name: shown.update(task, advance=1, image=name)


def report(solved: Calibration, console: Console) -> None:
    """Print each view, those that were rejected, and how well the camera is known."""
    table = Table("view", "corners", "board px", "error px", "offset mm", "offset deg", box=None)
    for view in solved.views:
        numbers = (view.board_px, view.error_px, view.offset_mm, view.offset_deg)
        table.add_row(view.name, str(view.corners), *(f"{number:.2f}" for number in numbers))
    console.print(table)
    for name, reason in sorted(solved.rejected.items()):
        console.print(f"{name} not used: {reason}", markup=False)
    for line in _summary(solved):
        console.print(line, markup=False)


def _summary(solved: Calibration) -> list[str]:
    camera, noise, (spread_mm, spread_deg) = solved.camera, solved.noise, solved.spread
    position = ", ".join(f"{1000 * row[3]:.1f}" for row in camera.T_base_camera[:3])
    mm, deg = solved.standard_error_mm, solved.standard_error_deg
    errors = solved.intrinsics_error
    source = "given" if errors is None else f"solved, standard errors {errors.fx:.1f}, {errors.cx:.1f}, {errors.cy:.1f}"
    lines = [
        f"camera at ({position}) mm in the robot-base frame, standard error {mm:.2f} mm and {deg:.3f} deg",
        f"reprojection error {solved.error_px:.3f} px RMS over {len(solved.views)} views; spread between views "
        f"{spread_mm:.2f} mm, {spread_deg:.3f} deg",
        f"noise of corners {noise.pixel:.3f} px, of robot poses {1000 * noise.shift:.2f} mm and "
        f"{57.29578 * noise.turn:.3f} deg an axis; board {100 * (solved.board_scale - 1):+.2f} % of its size",
        f"intrinsics ({source}): fx {camera.fx:.1f}, fy {camera.fy:.1f}, cx {camera.cx:.1f}, cy {camera.cy:.1f}",
    ]
    if mm > _POOR_MM or deg > _POOR_DEG:
        lines.append("the standard error is large: record more views, with larger turns, over more of the workspace")
    return lines
