"""Batched clamps: quaternion algebra against rotation matrices, bounds kept, rows independent."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from manicm_ms.robots.limits import (
    clamp_norm,
    clamp_to_workspace,
    limit_joint_step,
    limit_lead,
    pose_in_frame,
    quat_conjugate,
    quat_from_rotvec,
    quat_multiply,
    quat_rotate,
    rotvec_from_quat,
)

N = 64


def random_quats(seed: int) -> torch.Tensor:
    q = torch.randn(N, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return q / q.norm(dim=1, keepdim=True)


def as_rotation(q: torch.Tensor) -> Rotation:
    return Rotation.from_quat(q.numpy(), scalar_first=True)


def test_quaternions_agree_with_scipy() -> None:
    a, b = random_quats(0), random_quats(1)
    vectors = torch.randn(N, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    np.testing.assert_allclose(
        as_rotation(quat_multiply(a, b)).as_matrix(), (as_rotation(a) * as_rotation(b)).as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(quat_rotate(a, vectors).numpy(), as_rotation(a).apply(vectors.numpy()), atol=1e-12)
    np.testing.assert_allclose(rotvec_from_quat(a).numpy(), as_rotation(a).as_rotvec(), atol=1e-9)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-6, 0.3, 3.0])
def test_rotation_vectors_go_there_and_back(scale: float) -> None:
    axis = torch.nn.functional.normalize(
        torch.randn(N, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    )
    rotvec = scale * axis
    q = quat_from_rotvec(rotvec)
    np.testing.assert_allclose(q.norm(dim=1).numpy(), 1.0, atol=1e-12)
    np.testing.assert_allclose(rotvec_from_quat(q).numpy(), rotvec.numpy(), atol=1e-9)


def test_pose_in_frame_undoes_the_frame() -> None:
    frame = torch.cat([torch.rand(N, 3, dtype=torch.float64), random_quats(4)], dim=1)
    pose = torch.cat([torch.rand(N, 3, dtype=torch.float64), random_quats(5)], dim=1)
    local = pose_in_frame(pose, frame)
    position = frame[:, :3] + quat_rotate(frame[:, 3:], local[:, :3])
    np.testing.assert_allclose(position.numpy(), pose[:, :3].numpy(), atol=1e-12)
    np.testing.assert_allclose(quat_multiply(frame[:, 3:], local[:, 3:]).numpy(), pose[:, 3:].numpy(), atol=1e-12)


def test_clamp_norm_keeps_directions_and_short_vectors() -> None:
    vectors = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.4, 0.0], [3.0, 4.0, 0.0]])
    clamped = clamp_norm(vectors, 1.0)
    torch.testing.assert_close(clamped, torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.4, 0.0], [0.6, 0.8, 0.0]]))


def test_workspace_lets_a_row_outside_only_come_in() -> None:
    lower, upper = torch.tensor([0.0, 0.0, 0.0]), torch.tensor([1.0, 1.0, 1.0])
    previous = torch.tensor([[0.5, 0.5, 0.5], [0.5, 0.5, 1.5], [0.5, 0.5, 1.5], [-0.5, 0.5, 0.5]])
    wanted = torch.tensor([[1.2, -0.2, 0.5], [0.5, 0.5, 1.6], [0.5, 0.5, 1.4], [-0.4, 0.5, 0.5]])
    expected = torch.tensor([[1.0, 0.0, 0.5], [0.5, 0.5, 1.5], [0.5, 0.5, 1.4], [-0.4, 0.5, 0.5]])
    torch.testing.assert_close(clamp_to_workspace(wanted, previous, lower, upper), expected)


def test_lead_is_limited_row_by_row() -> None:
    measured = torch.cat([torch.zeros(N, 3, dtype=torch.float64), random_quats(6)], dim=1)
    turn = torch.linspace(0.0, 1.0, N, dtype=torch.float64)[:, None] * torch.tensor([[0.6, 0.0, -0.8]])
    shift = torch.linspace(0.0, 0.2, N, dtype=torch.float64)[:, None] * torch.tensor([[0.0, 0.6, 0.8]])
    target = torch.cat([shift, quat_multiply(quat_from_rotvec(turn), measured[:, 3:])], dim=1)
    limited = limit_lead(target, measured, max_distance=0.08, max_angle=0.35)
    ahead = rotvec_from_quat(quat_multiply(limited[:, 3:], quat_conjugate(measured[:, 3:])))
    np.testing.assert_allclose(ahead.numpy(), clamp_norm(turn, 0.35).numpy(), atol=1e-9)
    np.testing.assert_allclose(limited[:, :3].numpy(), clamp_norm(shift, 0.08).numpy(), atol=1e-12)
    near = turn.norm(dim=1) < 0.35
    assert torch.equal(limited[near, 3:], target[near, 3:])


def test_joint_step_keeps_speeds_and_direction() -> None:
    previous = torch.randn(N, 6, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    wanted = previous + torch.randn(N, 6, generator=torch.Generator().manual_seed(8), dtype=torch.float64)
    wanted[: N // 2] = previous[: N // 2] + 1e-3
    most = torch.tensor([math.pi / 20] * 3 + [math.pi / 10] * 3, dtype=torch.float64)
    step = limit_joint_step(wanted, previous, most) - previous
    assert (step.abs() <= most + 1e-12).all()
    torch.testing.assert_close(step[: N // 2], torch.full((N // 2, 6), 1e-3, dtype=torch.float64))
    asked = wanted - previous
    cosine = (step * asked).sum(dim=1) / (step.norm(dim=1) * asked.norm(dim=1))
    torch.testing.assert_close(cosine, torch.ones(N, dtype=torch.float64))
    assert torch.isclose((step / most).abs().amax(dim=1)[N // 2 :], torch.ones(N // 2, dtype=torch.float64)).all()
