"""The URDF against the DH table, its masses, its meshes, and what the generator writes today."""

from __future__ import annotations

import math
from xml.etree import ElementTree

import numpy as np
import pytest
import pytorch_kinematics
import torch
import trimesh
from sapien.wrapper.pinocchio_model import PinocchioModel

from manicm_ms.paths import asset

URDF = asset("robots", "ur3e_ag95", "ur3e_ag95.urdf")
ARM = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]

# Universal Robots' DH table of the UR3e: a, d in metres, alpha in rad.
DH = [
    (0.0, 0.15185, math.pi / 2),
    (-0.24355, 0.0, 0.0),
    (-0.2132, 0.0, 0.0),
    (0.0, 0.13105, math.pi / 2),
    (0.0, 0.08535, -math.pi / 2),
    (0.0, 0.0921, 0.0),
]
# base_link is turned by pi about z against the frame of the DH table (the controller's base).
T_BASE_LINK_DH = np.diag([-1.0, -1.0, 1.0, 1.0])


def dh_forward(q: np.ndarray) -> np.ndarray:
    T = T_BASE_LINK_DH.copy()
    for angle, (a, d, alpha) in zip(q, DH, strict=True):
        c, s, ca, sa = math.cos(angle), math.sin(angle), math.cos(alpha), math.sin(alpha)
        T = T @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return T


@pytest.fixture(scope="module")
def pinocchio() -> PinocchioModel:
    model = PinocchioModel(URDF.read_text(), [0, 0, -9.81])
    model.set_joint_order([*ARM, "left_finger_joint", "right_finger_joint"])
    model.set_link_order(["tool0", "tcp", "left_finger", "right_finger"])
    return model


def link_pose(model: PinocchioModel, link: int, arm: np.ndarray, fingers: tuple[float, float] = (0, 0)) -> np.ndarray:
    model.compute_forward_kinematics(np.array([*arm, *fingers]))
    return model.get_link_pose(link).to_transformation_matrix()


def triangles(scene: trimesh.Scene) -> int:
    return sum(len(geometry.faces) for geometry in scene.geometry.values())


def test_forward_kinematics_equal_the_dh_table(pinocchio: PinocchioModel) -> None:
    rng = np.random.default_rng(0)
    worst = 0.0
    for q in rng.uniform(-math.pi, math.pi, (1000, 6)):
        worst = max(worst, np.abs(link_pose(pinocchio, 0, q) - dh_forward(q)).max())
    assert worst < 1e-6


def test_pytorch_kinematics_reads_the_same_chain() -> None:
    chain = pytorch_kinematics.build_serial_chain_from_urdf(URDF.read_bytes(), end_link_name="tool0")
    chain = chain.to(dtype=torch.float64)
    assert chain.get_joint_parameter_names() == ARM
    q = np.random.default_rng(1).uniform(-math.pi, math.pi, (200, 6))
    matrices = chain.forward_kinematics(torch.tensor(q)).get_matrix().numpy()
    np.testing.assert_allclose(matrices, np.stack([dh_forward(row) for row in q]), atol=1e-6)


@pytest.mark.parametrize(
    ("q", "xyz", "z_axis"),
    [
        ([0, 0, 0, 0, 0, 0], [0.45675, 0.22315, 0.06650], [0, 1, 0]),
        ([0, -math.pi / 2, 0, -math.pi / 2, 0, 0], [0, 0.22315, 0.69395], [0, 1, 0]),
        ([0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0], [0.29855, 0.13105, 0.30330], [0, 0, -1]),
    ],
)
def test_known_poses(pinocchio: PinocchioModel, q: list[float], xyz: list[float], z_axis: list[float]) -> None:
    T = link_pose(pinocchio, 0, np.array(q, dtype=float))
    np.testing.assert_allclose(T[:3, 3], xyz, atol=1e-5)
    np.testing.assert_allclose(T[:3, 2], z_axis, atol=1e-6)


def test_fingers_slide_apart_and_meet_at_the_tcp(pinocchio: PinocchioModel) -> None:
    q = np.array([0.3, -1.2, 0.9, -1.1, -1.4, 0.2])
    T_tcp = link_pose(pinocchio, 1, q)
    for width in (0.0, 0.04, 0.0952):
        left = np.linalg.inv(T_tcp) @ link_pose(pinocchio, 2, q, (width / 2, width / 2))
        right = np.linalg.inv(T_tcp) @ link_pose(pinocchio, 3, q, (width / 2, width / 2))
        np.testing.assert_allclose(left[:3, 3], [width / 2, 0, 0], atol=1e-6)
        np.testing.assert_allclose(right[:3, 3], [-width / 2, 0, 0], atol=1e-6)
        np.testing.assert_allclose(left[:3, 0], -right[:3, 0], atol=1e-6)  # grip faces look at each other


def test_masses() -> None:
    robot = ElementTree.parse(URDF).getroot()
    inertial = {link.get("name"): link.find("inertial/mass") for link in robot.iter("link")}
    masses = {name: float(mass.get("value")) for name, mass in inertial.items() if mass is not None}
    arm = sum(masses[name] for name in masses if name.endswith("_link") and name != "base_link_inertia")
    assert arm == pytest.approx(8.7985, abs=1e-6)
    tool = masses["ag95_body"] + masses["left_finger"] + masses["right_finger"]
    assert tool == pytest.approx(1.0, abs=0.02)  # the data sheet's kilogram


def test_inertias_are_physical() -> None:
    for element in ElementTree.parse(URDF).getroot().iter("inertia"):
        a, b, c = sorted(float(element.get(name)) for name in ("ixx", "iyy", "izz"))
        assert a > 0
        assert c <= a + b + 1e-12  # triangle inequality of principal moments


def test_plain_urdf() -> None:
    robot = ElementTree.parse(URDF).getroot()
    assert robot.tag == "robot"
    assert next(robot.iter("mimic"), None) is None
    assert not any(key.startswith("xmlns") or "}" in element.tag for element in robot.iter() for key in element.attrib)
    for mesh in robot.iter("mesh"):
        assert (URDF.parent / mesh.get("filename")).is_file()


def test_triangle_budget() -> None:
    total = 0
    for mesh in ElementTree.parse(URDF).getroot().iter("mesh"):
        total += triangles(trimesh.load(URDF.parent / mesh.get("filename")))
    assert 500 < total <= 3500


def test_meshes_cover_the_collision_shapes() -> None:
    # Not exact on purpose (tapers, bevels, cranks): a misplaced or wrongly turned part would be off by centimetres.
    for link in ElementTree.parse(URDF).getroot().iter("link"):
        mesh = link.find("visual/geometry/mesh")
        if mesh is None:
            continue
        seen = trimesh.load(URDF.parent / mesh.get("filename")).bounds
        solid = np.array([_shape_bounds(shape) for shape in link.iter("collision")])
        short = np.concatenate([seen[0] - solid[:, 0].min(axis=0), solid[:, 1].max(axis=0) - seen[1]])
        assert short.max() < 0.012, link.get("name")
        assert short.min() > -0.042, link.get("name")  # the cranks' roots are hidden inside the gripper's body


def _shape_bounds(collision: ElementTree.Element) -> np.ndarray:
    origin = collision.find("origin")
    centre, rpy = (np.array([float(x) for x in origin.get(key).split()]) for key in ("xyz", "rpy"))
    box, cylinder = collision.find("geometry/box"), collision.find("geometry/cylinder")
    if box is not None:
        half = np.array([float(x) for x in box.get("size").split()]) / 2
    else:
        radius, length = float(cylinder.get("radius")), float(cylinder.get("length"))
        half = np.array([radius, radius, length / 2])
        half = np.abs(trimesh.transformations.euler_matrix(*rpy)[:3, :3]) @ half
    return np.array([centre - half, centre + half])


def test_generator_writes_what_is_shipped(tmp_path) -> None:
    from generate_robot import write_robot

    write_robot(tmp_path)
    assert (tmp_path / "ur3e_ag95.urdf").read_text() == URDF.read_text()
    for path in sorted((URDF.parent / "meshes").iterdir()):
        fresh = trimesh.load(tmp_path / "meshes" / path.name)
        shipped = trimesh.load(path)
        np.testing.assert_allclose(fresh.bounds, shipped.bounds, atol=1e-6)
        assert sum(len(g.faces) for g in fresh.geometry.values()) == sum(
            len(g.faces) for g in shipped.geometry.values()
        )
