"""Low-poly visual meshes of the UR3e and the AG-95, built from profiles; every link is one small coloured glb."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from robot_facts import (
    BODY_HALF_DEPTH,
    BODY_OUTLINE,
    CRANK,
    INNER_PIVOT,
    OUTER_PIVOT,
    PAD_HALF_HEIGHT,
    PAD_HALF_WIDTH,
    PAD_THICKNESS,
)
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

Color = tuple[int, int, int]
ALUMINIUM: Color = (196, 199, 203)
CAP_BLUE: Color = (116, 158, 188)
SEAM: Color = (38, 40, 43)
GRIPPER_DARK: Color = (52, 54, 58)
GRIPPER_STEEL: Color = (168, 171, 175)
RUBBER: Color = (24, 24, 26)

SECTIONS = 18  # facets around an axis
_CRANK_TILT = 1.22  # rad, crank angle at which the moving linkage is drawn: a gap of about 55 mm


@dataclass(frozen=True)
class Part:
    """A coloured piece of a link; pieces of one colour are merged into one mesh."""

    mesh: trimesh.Trimesh
    color: Color


def lathe(profile: Sequence[tuple[float, float]], axis: str, centre: Sequence[float]) -> trimesh.Trimesh:
    """Turn a profile of (radius, height) points in metres about an axis through `centre`; end radii > 0 stay open."""
    mesh = trimesh.creation.revolve(np.array(profile), sections=SECTIONS)
    turn = {"z": np.eye(4), "y": trimesh.transformations.rotation_matrix(-math.pi / 2, [1, 0, 0])}
    turn["x"] = trimesh.transformations.rotation_matrix(math.pi / 2, [0, 1, 0])
    mesh.apply_transform(turn[axis])
    mesh.apply_translation(centre)
    return mesh


def _rounded_end(radius: float, top: float, bevel: float) -> list[tuple[float, float]]:
    """Return profile points from the side up to the axis of a rounded end whose face is at height `top`."""
    soft = bevel * (1 - math.sqrt(0.5))
    return [(radius, top - bevel), (radius - soft, top - soft), (radius - bevel, top), (0.0, top)]


def housing(axis: str, centre: Sequence[float], radius: float, span: tuple[float, float], cap: str) -> list[Part]:
    """Build a joint housing: aluminium side, a dark seam at its open end, a rounded blue-grey cap at the other.

    Args:
        axis, centre, radius: of the cylinder, as in the facts; the span is measured along the axis from `centre`.
        span: (low, high) ends, metres.
        cap: "low" or "high", the end with the cap.
    """
    low, high = span
    flip = -1.0 if cap == "low" else 1.0
    open_end, cap_end = (low, high) if cap == "high" else (-high, -low)
    lid, seam = 0.26 * radius, 0.05 * radius
    profiles = {
        SEAM: [(radius * 0.97, open_end), (radius * 0.97, open_end + seam)],
        ALUMINIUM: [(radius * 0.97, open_end + seam), (radius, open_end + seam), (radius, cap_end - lid)],
        CAP_BLUE: [(radius, cap_end - lid), *_rounded_end(radius, cap_end, 0.16 * radius)],
    }
    parts = []
    for color, profile in profiles.items():
        points = [(r, flip * z) for r, z in profile]
        parts.append(Part(lathe(points if flip > 0 else points[::-1], axis, centre), color))
    return parts


def tube(axis: str, centre: Sequence[float], radius: float, length: float) -> list[Part]:
    """Build a plain aluminium tube; its ends are hidden in the housings it joins."""
    half = length / 2
    return [Part(lathe([(radius, -half), (radius, half)], axis, centre), ALUMINIUM)]


def stub(radius: float, low: float) -> list[Part]:
    """Build the neck of a joint housing: along z from its seam at `low` up to the axis of the housing it carries."""
    seam = 0.05 * radius
    inner = 0.97 * radius
    return [
        Part(lathe([(inner, low), (inner, low + seam)], "z", (0, 0, 0)), SEAM),
        Part(lathe([(inner, low + seam), (radius, low + seam), (radius, 0)], "z", (0, 0, 0)), ALUMINIUM),
    ]


def prism(outline: NDArray[np.float64], low: float, high: float) -> trimesh.Trimesh:
    """Extrude a convex outline (k, 2) of (x, z) points, counter-clockwise seen from -y, along y from low to high."""
    k = len(outline)
    ring = [np.column_stack([outline[:, 0], np.full(k, y), outline[:, 1]]) for y in (low, high)]
    faces = [[0, i, i + 1] for i in range(1, k - 1)] + [[k, k + i + 1, k + i] for i in range(1, k - 1)]
    for i in range(k):
        j = (i + 1) % k
        faces += [[i, k + i, k + j], [i, k + j, j]]
    return trimesh.Trimesh(np.concatenate(ring), faces, process=False)


def box(lower: Sequence[float], upper: Sequence[float]) -> trimesh.Trimesh:
    """Build a box from its corners, metres."""
    return trimesh.creation.box(bounds=[lower, upper])


def bar(start: tuple[float, float], end: tuple[float, float], half: float, low: float, high: float) -> trimesh.Trimesh:
    """Build a link of a mechanism: a bar with rounded ends between two (x, z) pivots, from y = low to y = high."""
    a, b = np.array(start), np.array(end)
    heading = math.atan2(*(b - a)[::-1])
    arc = np.linspace(-math.pi / 2, math.pi / 2, 5)
    ends = [(b, heading), (a, heading + math.pi)]
    outline = [p + half * np.array([math.cos(t + phi), math.sin(t + phi)]) for p, phi in ends for t in arc]
    return prism(np.array(outline), low, high)


def loft(levels: Sequence[tuple[float, float]], half_depth: float, chamfer: float) -> trimesh.Trimesh:
    """Join chamfered rectangles of (z, half width along x) and equal half depth along y into a closed body."""
    rings = []
    for z, w in levels:
        d, c = half_depth, chamfer
        corners = [
            (w, -d + c),
            (w, d - c),
            (w - c, d),
            (-w + c, d),
            (-w, d - c),
            (-w, -d + c),
            (-w + c, -d),
            (w - c, -d),
        ]
        rings.append([(x, y, z) for x, y in corners])
    k, last = 8, 8 * (len(levels) - 1)
    faces = [[0, i + 1, i] for i in range(1, k - 1)] + [[last, last + i, last + i + 1] for i in range(1, k - 1)]
    for ring in range(len(levels) - 1):
        for i in range(k):
            a, b = ring * k + i, ring * k + (i + 1) % k
            faces += [[a, b, b + k], [a, b + k, a + k]]
    return trimesh.Trimesh(np.array(rings).reshape(-1, 3), faces, process=False)


def _base() -> list[Part]:
    foot = [(0.064, 0.0), (0.064, 0.010), (0.0605, 0.014), (0.050, 0.020), (0.0475, 0.085)]
    ring = [(0.0475, 0.085), (0.0437, 0.085), (0.0437, 0.0955)]
    return [Part(lathe(foot, "z", (0, 0, 0)), ALUMINIUM), Part(lathe(ring, "z", (0, 0, 0)), SEAM)]


def _arm() -> dict[str, list[Part]]:
    return {
        "base_link_inertia": _base(),
        "shoulder_link": [
            *stub(0.045, -0.057),
            *housing("y", (0, 0, 0), 0.045, (-0.063, 0.045), "high"),
        ],
        "upper_arm_link": [
            *housing("z", (0, 0, 0), 0.046, (0.063, 0.178), "high"),
            *tube("x", (-0.1218, 0, 0.120), 0.033, 0.2436),
            *housing("z", (-0.24355, 0, 0), 0.039, (0.066, 0.176), "high"),
        ],
        "forearm_link": [
            *housing("z", (0, 0, 0), 0.0375, (0.001, 0.066), "low"),
            *tube("x", (-0.1066, 0, 0.0285), 0.0265, 0.2132),
            *housing("z", (-0.2132, 0, 0), 0.032, (-0.0195, 0.0775), "low"),
        ],
        "wrist_1_link": [
            *stub(0.032, -0.054),
            *housing("y", (0, 0, 0), 0.032, (-0.050, 0.046), "high"),
        ],
        "wrist_2_link": [
            *stub(0.032, -0.035),
            *housing("y", (0, 0, 0), 0.032, (-0.0465, 0.0505), "low"),
        ],
        "wrist_3_link": [
            Part(lathe([(0.0305, -0.0417), (0.0305, -0.037)], "z", (0, 0, 0)), SEAM),
            Part(lathe([(0.032, -0.037), (0.032, -0.003), (0.030, 0), (0, 0)], "z", (0, 0, 0)), ALUMINIUM),
        ],
    }


def _gripper_body() -> list[Part]:
    plate = lathe([(0, 0), (0.0325, 0), (0.0325, 0.006)], "z", (0, 0, 0))
    band = box((-0.0425, -BODY_HALF_DEPTH - 0.0006, 0.040), (0.0425, BODY_HALF_DEPTH + 0.0006, 0.052))
    return [
        Part(plate, GRIPPER_STEEL),
        Part(loft(BODY_OUTLINE, BODY_HALF_DEPTH, 0.011), GRIPPER_DARK),
        Part(band, GRIPPER_STEEL),
    ]


def _finger() -> list[Part]:
    reach = CRANK * np.array([math.cos(_CRANK_TILT), math.sin(_CRANK_TILT)])

    def root(pivot: tuple[float, float]) -> tuple[float, float]:
        return (pivot[0] - reach[0], pivot[1] - reach[1])

    w = PAD_HALF_WIDTH
    blade = np.array(
        [(0.012, -0.0359), (0.0256, -0.0359), (0.0285, -0.026), (0.0256, -0.0138), (0.0128, 0.0083), (0.012, 0.0083)]
    )
    t, h = PAD_THICKNESS, PAD_HALF_HEIGHT
    pad = np.array([(0.0, -0.016), (t, -0.016), (t, 0.008), (0.0075, h), (0.001, h), (0.0, h - 0.001)])
    knuckle = np.array([(0.0022, -0.0359), (0.012, -0.0359), (0.012, -0.016), (0.0022, -0.016)])
    return [
        Part(prism(pad, -w, w), RUBBER),
        Part(prism(blade, -w, w), GRIPPER_STEEL),
        Part(prism(knuckle, -w, w), GRIPPER_STEEL),
        Part(bar(OUTER_PIVOT, root(OUTER_PIVOT), 0.0062, -0.0062, 0.0062), GRIPPER_DARK),
        Part(bar(INNER_PIVOT, root(INNER_PIVOT), 0.0055, 0.0108, 0.0160), GRIPPER_DARK),
        Part(bar(INNER_PIVOT, root(INNER_PIVOT), 0.0055, -0.0160, -0.0108), GRIPPER_DARK),
        Part(
            lathe(
                [(0, -0.0175), (0.0034, -0.0175), (0.0034, 0.0175), (0, 0.0175)],
                "y",
                (INNER_PIVOT[0], 0, INNER_PIVOT[1]),
            ),
            GRIPPER_STEEL,
        ),
    ]


def _merge(parts: Sequence[Part], color: Color) -> trimesh.Trimesh:
    shaded = [trimesh.graph.smooth_shade(p.mesh, angle=math.radians(30)) for p in parts if p.color == color]
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate(shaded))
    vertices, normals, faces = mesh.vertices, mesh.vertex_normals, mesh.faces
    metal = 0.35 if color in (ALUMINIUM, GRIPPER_STEEL) else 0.0
    material = PBRMaterial(baseColorFactor=[*color, 255], metallicFactor=metal, roughnessFactor=0.55)
    visual = TextureVisuals(uv=np.zeros((len(vertices), 2)), material=material)
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)


def link_meshes() -> dict[str, trimesh.Scene]:
    """Return one scene of coloured meshes per link that is seen, in the link's frame, metres."""
    links = _arm() | {"ag95_body": _gripper_body(), "left_finger": _finger(), "right_finger": _finger()}
    scenes = {}
    for name, parts in links.items():
        scene = trimesh.Scene()
        for i, color in enumerate(dict.fromkeys(part.color for part in parts)):
            scene.add_geometry(_merge(parts, color), node_name=f"{name}_{i}", geom_name=f"{name}_{i}")
        scenes[name] = scene
    return scenes
