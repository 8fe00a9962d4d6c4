"""Numbers of the UR3e arm and the DH AG-95 gripper that the URDF is generated from.

`assets/robots/ur3e_ag95/SOURCE.md` says where each number comes from. SI units; poses are URDF's xyz and fixed-axis
roll-pitch-yaw.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

PI = math.pi
Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Inertia:
    """Mass (kg), centre of mass (m), principal axes (rpy) and principal moments about it (kg m^2)."""

    mass: float
    com: Vector
    moments: Vector
    rpy: Vector = ZERO


@dataclass(frozen=True)
class Cylinder:
    """A solid cylinder in its link's frame: axis "x", "y" or "z", centre (m), radius (m), length (m)."""

    axis: str
    centre: Vector
    radius: float
    length: float


@dataclass(frozen=True)
class Box:
    """A solid box in its link's frame: lower and upper corner (m)."""

    lower: Vector
    upper: Vector

    @property
    def centre(self) -> Vector:
        """Return the middle of the box, (3,) metres."""
        x, y, z = ((lo + hi) / 2 for lo, hi in zip(self.lower, self.upper, strict=True))
        return (x, y, z)

    @property
    def size(self) -> Vector:
        """Return the edge lengths, (3,) metres."""
        x, y, z = (hi - lo for lo, hi in zip(self.lower, self.upper, strict=True))
        return (x, y, z)


@dataclass(frozen=True)
class Link:
    """A rigid link: its inertia (None for a massless frame of the fixed root) and collision shapes."""

    name: str
    inertia: Inertia | None = None
    shapes: tuple[Cylinder | Box, ...] = ()
    mesh: bool = False


@dataclass(frozen=True)
class Joint:
    """A joint from `parent` to `child`; limits in rad or m, per second, Nm or N; fixed where `kind` says so."""

    name: str
    kind: str
    parent: str
    child: str
    xyz: Vector
    rpy: Vector
    axis: Vector = (0.0, 0.0, 1.0)
    lower: float = 0.0
    upper: float = 0.0
    velocity: float = 0.0
    effort: float = 0.0


# --- AG-95 linkage: parallelogram four-bar, both cranks 55 mm --------------------------------------------------------
CRANK = 0.055  # m
CRANK_ANGLE_OPEN = math.radians(44.691)  # rad, angle A of a crank from the closing axis when the gripper is open
GAP_OFFSET = 0.0085  # m: gap(q) = 2 (GAP_OFFSET + CRANK cos(A + q))
OPENING_MAX = 0.0952  # m, gap at q = 0; the data sheet says 95 mm
TCP_HEIGHT = 0.1825  # m above the flange: pad centre at a gap of 40 mm
FINGER_SPEED = 0.068  # m/s per finger: half of 95 mm in 0.7 s
FINGER_EFFORT = 80.0  # N

# Finger pivots and body in frames that the meshes need.
OUTER_PIVOT = (0.028173, -0.030424)  # (x, z) in the finger's frame: outer crank meets finger
INNER_PIVOT = (0.0075, -0.0229)  # (x, z) in the finger's frame: inner crank meets finger
PAD_HALF_WIDTH = 0.0105  # m, along the finger's y
PAD_THICKNESS = 0.012  # m, along the finger's x
PAD_HALF_HEIGHT = 0.017  # m, along the finger's z
BODY_HALF_DEPTH = 0.0254  # m
BODY_OUTLINE = ((0.005, 0.0465), (0.03, 0.0465), (0.07, 0.054), (0.118, 0.0635), (0.1345, 0.022))  # (z, half width), m

# (height above the tip from, to, half width beyond the grip face): steps of at most 10 mm follow the finger's wedge.
FINGER_STEPS = (
    (0.000, 0.005, 0.0095),
    (0.005, 0.010, 0.0125),
    (0.010, 0.019, 0.0180),
    (0.019, 0.030, 0.0245),
    (0.030, 0.0375, 0.0290),
    (0.0375, 0.064, 0.0330),
)

_FRAME = Inertia(0.001, ZERO, (1e-6, 1e-6, 1e-6))  # 1 g, so that no loader hangs its default mass at the wrist


def _finger_boxes() -> tuple[Box, ...]:
    tip = PAD_HALF_HEIGHT
    return tuple(
        Box((0.0, -PAD_HALF_WIDTH, tip - high), (width, PAD_HALF_WIDTH, tip - low)) for low, high, width in FINGER_STEPS
    )


def _gripper_boxes() -> tuple[Box, ...]:
    levels = ((0.0, 0.03, 0.0465), (0.03, 0.07, 0.054), (0.07, 0.118, 0.0635), (0.118, 0.1345, 0.04))
    return tuple(Box((-w, -BODY_HALF_DEPTH, low), (w, BODY_HALF_DEPTH, high)) for low, high, w in levels)


# One 90 g link per finger: lighter ones sink into what they hold. Inertia of a homogeneous 33 x 21 x 81 mm block.
_FINGER_INERTIA = Inertia(0.090, (0.014, 0.0, -0.012), (5.25e-5, 5.74e-5, 1.15e-5))
# Plate 0.05336 kg and body 0.7808 kg in one; the data sheet's 1 kg is met with the fingers.
_GRIPPER_INERTIA = Inertia(0.83416, (0.0, 0.0, 0.05495), (1.285e-3, 1.490e-3, 4.96e-4))

LINKS = (
    Link("base_link"),
    Link(
        "base_link_inertia",
        Inertia(2.0, ZERO, (0.003053, 0.003053, 0.005625)),
        (Cylinder("z", (0, 0, 0.0475), 0.064, 0.095),),
        mesh=True,
    ),
    Link(
        "shoulder_link",
        Inertia(1.98, (0, 0, -0.02), (0.00809317, 0.00809317, 0.005625)),
        (Cylinder("z", (0, 0, -0.0035), 0.045, 0.107), Cylinder("y", (0, -0.009, 0), 0.045, 0.108)),
        mesh=True,
    ),
    Link(
        "upper_arm_link",
        Inertia(3.4445, (-0.11355, 0, 0.1157), (0.02172849, 0.02172849, 0.00961875), (0, PI / 2, 0)),
        (
            Cylinder("z", (0, 0, 0.1205), 0.046, 0.115),
            Cylinder("x", (-0.1218, 0, 0.120), 0.036, 0.2436),
            Cylinder("z", (-0.24355, 0, 0.121), 0.039, 0.110),
        ),
        mesh=True,
    ),
    Link(
        "forearm_link",
        Inertia(1.437, (-0.1632, 0, 0.0238), (0.00654457, 0.00654457, 0.00354375), (0, PI / 2, 0)),
        (
            Cylinder("z", (0, 0, 0.0335), 0.0375, 0.065),
            Cylinder("x", (-0.1066, 0, 0.027), 0.029, 0.2132),
            Cylinder("z", (-0.2132, 0, 0.029), 0.032, 0.097),
        ),
        mesh=True,
    ),
    Link(
        "wrist_1_link",
        Inertia(0.871, (0, -0.01, 0), (0.002085, 0.002085, 0.00225)),
        (Cylinder("z", (0, 0, -0.0115), 0.032, 0.085), Cylinder("y", (0, -0.002, 0), 0.032, 0.096)),
        mesh=True,
    ),
    Link(
        "wrist_2_link",
        Inertia(0.805, (0, 0.01, 0), (0.002085, 0.002085, 0.00225)),
        (Cylinder("z", (0, 0, -0.002), 0.032, 0.066), Cylinder("y", (0, 0.002, 0), 0.032, 0.097)),
        mesh=True,
    ),
    Link(
        "wrist_3_link",
        Inertia(0.261, (0, 0, -0.02), (0.00013627, 0.00013627, 0.0001792)),
        (Cylinder("z", (0, 0, -0.021), 0.032, 0.0417),),
        mesh=True,
    ),
    Link("flange", _FRAME),
    Link("tool0", _FRAME),
    Link("ag95_body", _GRIPPER_INERTIA, _gripper_boxes(), mesh=True),
    Link("tcp", _FRAME),
    Link("left_finger", _FINGER_INERTIA, _finger_boxes(), mesh=True),
    Link("right_finger", _FINGER_INERTIA, _finger_boxes(), mesh=True),
)


def _revolute(name: str, parent: str, child: str, xyz: Vector, rpy: Vector, limits: Vector) -> Joint:
    bound, velocity, effort = limits
    return Joint(name, "revolute", parent, child, xyz, rpy, (0, 0, 1), -bound, bound, velocity, effort)


def _finger(side: str, yaw: float) -> Joint:
    return Joint(
        f"{side}_finger_joint",
        "prismatic",
        "ag95_body",
        f"{side}_finger",
        (0, 0, TCP_HEIGHT),
        (0, 0, yaw),
        (1, 0, 0),
        0.0,
        OPENING_MAX / 2,
        FINGER_SPEED,
        FINGER_EFFORT,
    )


JOINTS = (
    Joint("base_joint", "fixed", "base_link", "base_link_inertia", ZERO, (0, 0, PI)),
    _revolute("shoulder_pan_joint", "base_link_inertia", "shoulder_link", (0, 0, 0.15185), ZERO, (2 * PI, PI, 54)),
    _revolute("shoulder_lift_joint", "shoulder_link", "upper_arm_link", ZERO, (PI / 2, 0, 0), (2 * PI, PI, 54)),
    _revolute("elbow_joint", "upper_arm_link", "forearm_link", (-0.24355, 0, 0), ZERO, (PI, PI, 28)),
    _revolute("wrist_1_joint", "forearm_link", "wrist_1_link", (-0.2132, 0, 0.13105), ZERO, (2 * PI, 2 * PI, 9)),
    _revolute("wrist_2_joint", "wrist_1_link", "wrist_2_link", (0, -0.08535, 0), (PI / 2, 0, 0), (2 * PI, 2 * PI, 9)),
    _revolute("wrist_3_joint", "wrist_2_link", "wrist_3_link", (0, 0.0921, 0), (PI / 2, PI, PI), (2 * PI, 2 * PI, 9)),
    Joint("flange_joint", "fixed", "wrist_3_link", "flange", ZERO, (0, -PI / 2, -PI / 2)),
    Joint("tool0_joint", "fixed", "flange", "tool0", ZERO, (PI / 2, 0, PI / 2)),
    Joint("ag95_joint", "fixed", "tool0", "ag95_body", ZERO, ZERO),
    Joint("tcp_joint", "fixed", "tool0", "tcp", (0, 0, TCP_HEIGHT), ZERO),
    _finger("left", 0.0),
    _finger("right", PI),
)
