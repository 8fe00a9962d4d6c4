"""The ChArUco board: its description, its corners in an image, and a print of it at exact size."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np

from manicm_ms.errors import CalibrationError, ConfigError, UnknownNameError
from manicm_ms.paths import require_free, write_bytes

DICTIONARIES = tuple(
    sorted(name.removeprefix("DICT_") for name in dir(cv2.aruco) if name.startswith("DICT_") and "h" not in name)
)
"""Names of OpenCV's marker dictionaries, without their common prefix."""
MIN_CORNERS = 6
"""Corners that a view must show: a plane's pose needs four, the rest average the noise."""
_ENLARGED_BELOW_PX = 1200  # images narrower than this are enlarged twice, where their small markers are read surer
_PIXELS_PER_BIT = 8  # at which a marker's bits are read; OpenCV's 4 lose the noisy ones
_MIN_RELIEF = 0.1  # smallest extent of the seen corners / largest: below, they lie nearly on one line
_PAPER_M = {"A4": (0.210, 0.297), "A3": (0.297, 0.420), "A2": (0.420, 0.594), "A1": (0.594, 0.841)}
_PRINT_MARGIN_M = 0.01  # that common printers leave white
_PIXELS_PER_M = 10_000  # of the printed picture
_INCH_M = 0.0254
_DPI = 300  # of a PNG; PDF and SVG hold the picture as it is


@dataclass(frozen=True)
class CharucoSpec:
    """A ChArUco board: a chessboard whose white squares carry markers.

    Its frame is OpenCV's: origin at the outer corner of the first square, x along the row, y down the column, z into
    the board.

    Attributes:
        squares_x: squares in a row.
        squares_y: squares in a column.
        square_length: side of a square, metres; measure it on the print.
        marker_length: side of a marker with its black border, metres.
        dictionary: OpenCV's marker dictionary, one of `DICTIONARIES`.
        legacy: the pattern of boards made by OpenCV before 4.6, whose first square is a marker's.
    """

    squares_x: int = 5
    squares_y: int = 7
    square_length: float = 0.030
    marker_length: float = 0.022
    dictionary: str = "4X4_50"
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.dictionary not in DICTIONARIES:
            raise UnknownNameError("dictionary", self.dictionary, DICTIONARIES)
        if min(self.squares_x, self.squares_y) < 3:
            raise ConfigError(f"a board has at least 3 squares a side, not {self.squares_x} x {self.squares_y}")
        if not 0 < self.marker_length < self.square_length <= 1:
            raise ConfigError(
                "board lengths are metres with 0 < marker_length < square_length <= 1, "
                f"got marker_length={self.marker_length:g}, square_length={self.square_length:g}"
            )
        have, need = len(self._dictionary().bytesList), self.squares_x * self.squares_y // 2
        if need > have:
            raise ConfigError(
                f"{self} needs {need} markers and {self.dictionary} has {have}: choose a larger dictionary"
            )

    def __str__(self) -> str:
        return (
            f"board of {self.squares_x} x {self.squares_y} squares of {self.square_length * 1000:g} mm "
            f"with {self.dictionary} markers of {self.marker_length * 1000:g} mm"
        )

    @property
    def size(self) -> tuple[float, float]:
        """(width, height) of the pattern, metres."""
        return self.squares_x * self.square_length, self.squares_y * self.square_length

    def board(self) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's object for the board."""
        shape = self.squares_x, self.squares_y
        board = cv2.aruco.CharucoBoard(shape, self.square_length, self.marker_length, self._dictionary())
        board.setLegacyPattern(self.legacy)
        return board

    def picture(self, pixels_per_m: float = _PIXELS_PER_M) -> np.ndarray:
        """Return the pattern without a margin, (H, W) uint8; the first row of pixels is the edge y = 0."""
        width, height = (max(1, round(side * pixels_per_m)) for side in self.size)
        return self.board().generateImage((width, height))

    def _dictionary(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))


@dataclass(frozen=True)
class Corners:
    """Chessboard corners found in an image.

    Attributes:
        pixels: (K, 2) float64, x and y in the image; the centre of the first pixel is (0, 0).
        points: (K, 3) float64, the same corners in the board's frame, metres.
    """

    pixels: np.ndarray
    points: np.ndarray


def detect(spec: CharucoSpec, grey: np.ndarray) -> Corners:
    """Find the board's corners to a fraction of a pixel in a (H, W) uint8 image.

    Raises CalibrationError saying what was seen instead where the board is not there or shows too little.
    """
    board = spec.board()
    parameters = cv2.aruco.DetectorParameters()
    parameters.perspectiveRemovePixelPerCell = _PIXELS_PER_BIT
    detector = cv2.aruco.CharucoDetector(board)
    detector.setDetectorParameters(parameters)
    factor = 2 if grey.shape[1] < _ENLARGED_BELOW_PX else 1
    image = grey if factor == 1 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    pixels, ids, _, markers = detector.detectBoard(image)
    if ids is None or len(ids) < MIN_CORNERS:
        raise CalibrationError(_nothing(spec, 0 if ids is None else len(ids), markers))
    points = np.asarray(board.getChessboardCorners(), np.float64)[ids.ravel()]
    extents = np.linalg.svd(points - points.mean(0), compute_uv=False)
    if extents[1] < _MIN_RELIEF * extents[0]:
        raise CalibrationError(f"the {len(points)} corners seen lie nearly on one line")
    # enlarged about the corner of the image, half a pixel before the centre of its first pixel
    return Corners((pixels.reshape(-1, 2).astype(np.float64) + 0.5) / factor - 0.5, points)


def _nothing(spec: CharucoSpec, corners: int, markers: np.ndarray | None) -> str:
    if markers is None or not len(markers):
        return f"no marker of {spec.dictionary} found"
    ours = set(np.ravel(spec.board().getIds()).tolist())
    foreign = sorted(set(markers.ravel().tolist()) - ours)
    if foreign:
        return f"markers {', '.join(map(str, foreign[:5]))} are not of this {spec}"
    return f"{corners} corners found, {MIN_CORNERS} are needed"


def print_board(spec: CharucoSpec, out: Path, *, overwrite: bool = False) -> str:
    """Write the board at its exact size, centred on a sheet, as PDF, SVG or PNG; return the sheet's name.

    Print it at 100 %, without "fit to page", and measure a row of squares afterwards.

    Raises OutputExistsError where `out` exists, and ConfigError where its suffix or the board's size does not fit.
    """
    from matplotlib.figure import Figure

    if out.suffix not in (".pdf", ".svg", ".png"):
        raise ConfigError(f"{out}: a board is written as .pdf, .svg or .png")
    require_free(out, overwrite)
    paper, sheet = _sheet(spec)
    figure = Figure(figsize=(sheet[0] / _INCH_M, sheet[1] / _INCH_M))
    width, height = (side / whole for side, whole in zip(spec.size, sheet, strict=True))
    axes = figure.add_axes((0.5 - width / 2, 0.5 - height / 2, width, height))
    axes.imshow(spec.picture(), cmap="gray", vmin=0, vmax=255, interpolation="none", aspect="auto")
    axes.set_axis_off()
    figure.text(0.5, 0.25 - height / 4, f"{spec}; print at 100 % on {paper}", ha="center", va="center", fontsize=7)
    file = BytesIO()
    figure.savefig(file, dpi=_DPI, format=out.suffix[1:])
    write_bytes(out, file.getvalue())
    return paper


def _sheet(spec: CharucoSpec) -> tuple[str, tuple[float, float]]:
    """Return the smallest sheet, upright or lying, that takes the board with the printer's margins."""
    need = [side + 2 * _PRINT_MARGIN_M for side in spec.size]
    for name, (width, height) in _PAPER_M.items():
        for sheet in ((width, height), (height, width)):
            if need[0] <= sheet[0] and need[1] <= sheet[1]:
                return name, sheet
    raise ConfigError(f"{spec} fits no sheet up to {list(_PAPER_M)[-1]}: choose smaller squares")
