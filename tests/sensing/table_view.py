"""The shipped camera over a table, by pinhole geometry written out here in double precision."""

import numpy as np
import torch

from manicm_ms.sensing.camera_files import default_camera
from manicm_ms.sensing.point_cloud import Box

CAMERA = default_camera()
H, W = CAMERA.crop.height, CAMERA.crop.width
WORKSPACE = Box((0.15, -0.25, -0.01), (0.50, 0.25, 0.15))
EVERYWHERE = Box((-9.0, -9.0, -9.0), (9.0, 9.0, 9.0))


def rays(camera=CAMERA):
    """Rays (h, w, 3) with z = 1 of every pixel of the crop, in double precision."""
    left, top, width, height = camera.crop
    u, v = np.meshgrid(np.arange(left, left + width), np.arange(top, top + height))
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)


def table_depth(height=0.0):
    """Depth (H, W) of the horizontal plane at `height` m in the base frame."""
    T = CAMERA.pose
    return (height - T[2, 3]) / (rays() @ T[2, :3])


def in_base(depth):
    """Points (H, W, 3) in the base frame, in double precision."""
    return (rays() * depth[..., None]) @ CAMERA.pose[:3, :3].T + CAMERA.pose[:3, 3]


def tensor(depth, rows=1):
    return torch.from_numpy(np.broadcast_to(depth, (rows, H, W)).astype(np.float32))
