"""The AG-95's four-bar linkage: how knuckle angle, opening and pad height belong together.

Each finger hangs on two parallel cranks of equal length, so that it stays parallel; the pads part on a circle. The
simulated fingers slide instead and are commanded by their opening, which these formulas turn into the angle that the
real gripper's linkage takes (and that a driver's position register is proportional to). Geometry:
`assets/robots/ur3e_ag95/SOURCE.md`.
"""

from __future__ import annotations

import math

from manicm_ms.errors import ActionError

CRANK = 0.055  # m
CRANK_ANGLE_OPEN = math.radians(44.691)  # rad, between crank and closing axis at knuckle angle 0
GAP_OFFSET = 0.0085  # m
HEIGHT_OFFSET = 0.12876  # m


def opening_of_knuckle(angle: float) -> float:
    """Return the distance between the pads, metres, at a knuckle angle in rad (0 open): 2 (d + c cos(A + q))."""
    return 2 * (GAP_OFFSET + CRANK * math.cos(CRANK_ANGLE_OPEN + angle))


def knuckle_of_opening(opening: float) -> float:
    """Return the knuckle angle, rad, at which the pads are `opening` metres apart; the inverse of the above.

    Raises ActionError for an opening that the linkage cannot take.
    """
    cosine = (opening / 2 - GAP_OFFSET) / CRANK
    if opening < 0 or not math.cos(CRANK_ANGLE_OPEN) + 1e-3 >= cosine:
        raise ActionError(f"an opening of {opening} m is out of the AG-95's reach: 0 .. {opening_of_knuckle(0):.4f} m")
    return math.acos(cosine) - CRANK_ANGLE_OPEN


def pad_height_of_knuckle(angle: float) -> float:
    """Return the height of the pads' centres above the flange, metres, at a knuckle angle in rad: h + c sin(A + q)."""
    return HEIGHT_OFFSET + CRANK * math.sin(CRANK_ANGLE_OPEN + angle)
