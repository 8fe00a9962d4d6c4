"""Which board is in the images where it is not the one that was described: another pattern, order or dictionary."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np

from manicm_ms.errors import CalibrationError, ConfigError
from manicm_ms.sensing.calibration.board import DICTIONARIES, CharucoSpec, detect

_TRIED = 3  # images: a board that is in none of them is not looked for in all
_SURE = 4  # markers of another dictionary that an image must show: fewer may be noise


def advice(board: CharucoSpec, pictures: Sequence[np.ndarray]) -> str | None:
    """Return which options describe the board that the pictures show, and how often it was found; None if unknown.

    Tried are the other pattern (`legacy`), the squares of a row and a column exchanged, both, and where no marker is
    found the other dictionaries.

    Args:
        board: as it was described.
        pictures: (H, W) uint8, in which it was not found.
    """
    pictures = pictures[:: max(len(pictures) // _TRIED, 1)][:_TRIED]
    best, most = None, 0
    for other in _variations(board, pictures):
        found = sum(_shows(other, picture) for picture in pictures)
        if found > most:
            best, most = other, found
    if best is None:
        return None
    return f"{' '.join(_options(board, best))} fits, in {most} of {len(pictures)} images tried"


def _variations(board: CharucoSpec, pictures: Iterable[np.ndarray]) -> Iterator[CharucoSpec]:
    """Yield the boards that are mistaken for one another, the likeliest first."""
    names = [board.dictionary, *_seen_dictionaries(board, pictures)]
    for name in names:
        for swapped in (False, True):
            sides = (board.squares_y, board.squares_x) if swapped else (board.squares_x, board.squares_y)
            for legacy in (board.legacy, not board.legacy):
                try:
                    other = replace(board, dictionary=name, squares_x=sides[0], squares_y=sides[1], legacy=legacy)
                except ConfigError:  # too few markers in this dictionary
                    continue
                if other != board:
                    yield other


def _seen_dictionaries(board: CharucoSpec, pictures: Iterable[np.ndarray]) -> list[str]:
    """Return the dictionary, other than the board's, of which most markers are seen, in a list; none if few are."""
    picture = next(iter(pictures))
    if _markers(board.dictionary, picture):
        return []
    # The markers of a small dictionary are the first of the large one of the same kind: the smallest is named.
    by_size = sorted(DICTIONARIES, key=lambda name: len(_dictionary(name).bytesList))
    counts = {name: _markers(name, picture) for name in by_size if name != board.dictionary}
    name = max(counts, key=lambda name: counts[name])
    return [name] if counts[name] >= _SURE else []


def _markers(name: str, picture: np.ndarray) -> int:
    _, ids, _ = cv2.aruco.ArucoDetector(_dictionary(name)).detectMarkers(picture)
    return 0 if ids is None else len(ids)


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _shows(board: CharucoSpec, picture: np.ndarray) -> bool:
    try:
        detect(board, picture)
    except CalibrationError:
        return False
    return True


def _options(asked: CharucoSpec, found: CharucoSpec) -> list[str]:
    """Return the options of the command line in which the board that was found differs."""
    words = []
    if found.dictionary != asked.dictionary:
        words.append(f"--dictionary {found.dictionary}")
    if (found.squares_x, found.squares_y) != (asked.squares_x, asked.squares_y):
        words.append(f"--squares {found.squares_x} {found.squares_y}")
    if found.legacy != asked.legacy:
        words.append("--legacy" if found.legacy else "--no-legacy")
    return words
