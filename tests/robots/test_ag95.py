"""The gripper's linkage formulas against an explicit four-bar mechanism and the data sheet."""

from __future__ import annotations

import math

import numpy as np
import pytest

from manicm_ms.errors import ActionError
from manicm_ms.robots.ag95 import knuckle_of_opening, opening_of_knuckle, pad_height_of_knuckle
from manicm_ms.robots.ur3e_ag95 import OPENING_MAX, action_to_opening, opening_to_action


def turn(angle: float) -> np.ndarray:
    """Rotation in the (x, z) plane of the linkage, x towards z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


@pytest.mark.parametrize("q", np.linspace(0, 0.93, 8))
def test_formulas_follow_the_linkage(q: float) -> None:
    # Left finger in the (x, z) plane: pivot of the outer crank, crank, finger (parallel), pad, grip face, pad centre.
    pivot, crank = np.array([0.036673, 0.098336]), np.array([0.055, 0.0])
    finger_to_pad, pad_to_face = np.array([-0.021173, 0.022224]), np.array([-0.007, 0.0082])
    face = pivot + turn(math.radians(44.691) + q) @ crank + finger_to_pad + pad_to_face
    assert opening_of_knuckle(q) == pytest.approx(2 * face[0], abs=1e-9)
    assert pad_height_of_knuckle(q) == pytest.approx(face[1], abs=1e-9)
    # The inner crank closes the loop: same length, same angle, from its own pivot to its own point of the finger.
    inner = np.array([0.016, 0.10586]) + turn(math.radians(44.691) + q) @ crank
    outer = pivot + turn(math.radians(44.691) + q) @ crank
    np.testing.assert_allclose(inner, outer + np.array([-0.020673, 0.007524]), atol=1e-5)


def test_stroke_is_the_data_sheets() -> None:
    assert opening_of_knuckle(0.0) == pytest.approx(0.095, abs=5e-4)
    assert opening_of_knuckle(0.0) == pytest.approx(OPENING_MAX, abs=5e-5)


@pytest.mark.parametrize("opening", [0.0, 0.02, 0.04, 0.08, OPENING_MAX])
def test_inverse(opening: float) -> None:
    assert opening_of_knuckle(knuckle_of_opening(opening)) == pytest.approx(opening, abs=1e-4)


@pytest.mark.parametrize("opening", [-0.01, 0.2])
def test_out_of_reach_is_refused(opening: float) -> None:
    with pytest.raises(ActionError, match="out of the AG-95's reach"):
        knuckle_of_opening(opening)


def test_action_and_opening() -> None:
    assert opening_to_action(0.0) == -1
    assert opening_to_action(OPENING_MAX) == 1
    assert action_to_opening(opening_to_action(0.03)) == pytest.approx(0.03)
