"""The depth camera of a cell, for users: the model, its file, its images, and how its depth becomes a cloud."""

from manicm_ms.sensing.camera import CameraModel, Crop
from manicm_ms.sensing.camera_files import default_camera, read_camera, write_camera
from manicm_ms.sensing.depth_cloud import depth_to_cloud
from manicm_ms.sensing.depth_images import read_depth, write_depth

__all__ = [
    "CameraModel", "Crop", "default_camera", "depth_to_cloud", "read_camera", "read_depth", "write_camera",
    "write_depth",
]  # fmt: skip
