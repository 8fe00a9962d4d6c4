"""Bounds that keep commands executable: batched clamps of poses and joint steps, and the rotations they need.

Quaternions are wxyz and of unit length; every function works on N rows at once and never mixes them.
"""

from __future__ import annotations

import torch
from mani_skill.utils.geometry.rotation_conversions import axis_angle_to_quaternion
from torch import Tensor


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product a b of wxyz quaternions (N, 4): the rotation b followed by a."""
    aw, av = a[:, :1], a[:, 1:]
    bw, bv = b[:, :1], b[:, 1:]
    w = aw * bw - (av * bv).sum(dim=1, keepdim=True)
    return torch.cat([w, aw * bv + bw * av + torch.linalg.cross(av, bv)], dim=1)


def quat_conjugate(q: Tensor) -> Tensor:
    """Return the inverse rotation of unit wxyz quaternions (N, 4)."""
    return torch.cat([q[:, :1], -q[:, 1:]], dim=1)


def quat_from_rotvec(rotvec: Tensor) -> Tensor:
    """Return unit wxyz quaternions (N, 4) of rotation vectors (N, 3), axis times angle in radians."""
    half = 0.5 * torch.linalg.norm(rotvec, dim=1, keepdim=True)
    # sin(half) / angle without the division by zero: torch.sinc(x) = sin(pi x) / (pi x)
    return torch.cat([torch.cos(half), 0.5 * torch.sinc(half / torch.pi) * rotvec], dim=1)


def rotvec_from_quat(q: Tensor) -> Tensor:
    """Return rotation vectors (N, 3) in radians, of at most pi, of unit wxyz quaternions (N, 4)."""
    q = torch.where(q[:, :1] < 0, -q, q)
    sine = torch.linalg.norm(q[:, 1:], dim=1, keepdim=True)
    angle = 2.0 * torch.atan2(sine, q[:, :1])
    return q[:, 1:] * torch.where(sine > 1e-9, angle / sine.clamp_min(1e-9), torch.full_like(sine, 2.0))


def quat_from_yaw(yaw: Tensor) -> Tensor:
    """Return the rotations by `yaw` (N,) rad about z as quaternions (N, 4)."""
    still = torch.zeros_like(yaw)
    return axis_angle_to_quaternion(torch.stack([still, still, yaw], dim=1))


def yaw_of_quat(q: Tensor) -> Tensor:
    """Return by how much unit quaternions (N, 4) turn the x axis about z, (N,) rad in (-pi, pi]."""
    w, x, y, z = q.unbind(dim=-1)
    return torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quat_rotate(q: Tensor, vectors: Tensor) -> Tensor:
    """Turn vectors (N, 3) by unit wxyz quaternions (N, 4)."""
    axis = q[:, 1:]
    cross = 2.0 * torch.linalg.cross(axis, vectors)
    return vectors + q[:, :1] * cross + torch.linalg.cross(axis, cross)


def pose_in_frame(pose: Tensor, frame: Tensor) -> Tensor:
    """Express poses (N, 7) (xyz metres, wxyz) in the frames (N, 7) given in the same coordinates."""
    to_frame = quat_conjugate(frame[:, 3:])
    position = quat_rotate(to_frame, pose[:, :3] - frame[:, :3])
    return torch.cat([position, quat_multiply(to_frame, pose[:, 3:])], dim=1)


def clamp_norm(vectors: Tensor, most: float) -> Tensor:
    """Shorten those of the vectors (N, k) that are longer than `most`; directions stay."""
    norm = torch.linalg.norm(vectors, dim=1, keepdim=True)
    return vectors * (most / norm.clamp_min(most))


def clamp_to_workspace(position: Tensor, previous: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Keep positions (N, 3) inside the box [lower, upper] (3,), metres.

    A row whose `previous` position (N, 3) is outside already may come in or stay but not go further out; so nothing
    jumps where an episode starts outside.
    """
    return torch.maximum(torch.minimum(position, torch.maximum(upper, previous)), torch.minimum(lower, previous))


def limit_lead(target: Tensor, measured: Tensor, max_distance: float, max_angle: float) -> Tensor:
    """Keep target poses (N, 7) (xyz metres, wxyz) within a distance (m) and an angle (rad) of the measured ones (N, 7).

    Without it a target runs away from an arm that is blocked, and with it the force that the drives build up.
    """
    position = measured[:, :3] + clamp_norm(target[:, :3] - measured[:, :3], max_distance)
    ahead = rotvec_from_quat(quat_multiply(target[:, 3:], quat_conjugate(measured[:, 3:])))
    limited = quat_multiply(quat_from_rotvec(clamp_norm(ahead, max_angle)), measured[:, 3:])
    too_far = torch.linalg.norm(ahead, dim=1, keepdim=True) > max_angle
    return torch.cat([position, torch.where(too_far, limited, target[:, 3:])], dim=1)


def limit_joint_step(wanted: Tensor, previous: Tensor, max_step: Tensor) -> Tensor:
    """Scale the step from `previous` to `wanted` joint positions (N, J) so that no joint exceeds `max_step` (J,).

    All joints of a row shrink by one factor: the direction of the motion is kept.
    """
    step = wanted - previous
    ratio = (step.abs() / max_step).amax(dim=1, keepdim=True)
    return previous + step / ratio.clamp_min(1.0)
