"""Another light on pictures that were rendered under a lamp at the camera."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

AMBIENT = 0.35
"""Share of the light that reaches every surface in the cloud shader's pictures; the rest is a lamp at the camera."""
GAMMA = 2.2
_WAVELENGTHS = (611e-9, 549e-9, 464e-9)  # m: the primaries of sRGB
_SECOND_RADIATION = 1.438777e-2  # m K, h c / k
_WHITE = 6500.0  # K: what the pictures' white is


class Lamp(NamedTuple):
    """Light on n rows.

    Attributes:
        direction: (n, 3) unit vectors towards the lamp, camera axes of the position picture.
        ambient: (n,) share of full brightness that reaches every surface.
        color: (n, 3) rgb that the lamp adds on a surface that faces it.
    """

    direction: Tensor
    ambient: Tensor
    color: Tensor


def tint(temperature: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the colour (n, 3), green = 1, of black bodies of `temperature` (n,) K, where 6500 K is white.

    Planck's law at the three primaries' wavelengths: B ~ lambda^-5 / (exp(c2 / (lambda T)) - 1).
    """
    wavelength = np.array(_WAVELENGTHS)

    def radiance(kelvin: NDArray[np.float64]) -> NDArray[np.float64]:
        return wavelength**-5 / np.expm1(_SECOND_RADIATION / (wavelength * kelvin[:, None]))

    color = radiance(np.asarray(temperature, dtype=np.float64)) / radiance(np.array([_WHITE]))
    return color / color[:, 1:2]


def normals(position: Tensor) -> Tensor:
    """Return the unit normals (n, H, W, 3) of a position picture (n, H, W, 3), towards the camera at the origin.

    Each is spanned by the differences to the next pixel to the right and the next below (to the left and above at the
    last column and row); at an edge between two surfaces it belongs to neither. Nothing was hit where z is 0: there
    the normal is (0, 0, 1).
    """
    right = torch.cat([position[:, :, 1:] - position[:, :, :-1], position[:, :, -1:] - position[:, :, -2:-1]], dim=2)
    down = torch.cat([position[:, 1:] - position[:, :-1], position[:, -1:] - position[:, -2:-1]], dim=1)
    normal = torch.linalg.cross(right, down)
    normal = torch.where((normal * position).sum(dim=-1, keepdim=True) > 0, -normal, normal)
    length = normal.norm(dim=-1, keepdim=True)
    towards = position.new_tensor([0.0, 0.0, 1.0])
    return torch.where((length > 0) & (position[..., 2:] != 0), normal / length.clamp_min(1e-20), towards)


def relight(color: Tensor, position: Tensor, lamp: Lamp) -> Tensor:
    """Return the pictures as they look under another lamp.

    Takes the shader's own light out of the colour, and puts Lambert's in: albedo * (ambient + color * max(n . l, 0)).

    Args:
        color: (n, H, W, 3) uint8, of the cloud shader.
        position: (n, H, W, 3) float32, camera axes of the same pixels (OpenGL: x right, y up, z backward), any unit.
        lamp: the light.

    Returns:
        (n, H, W, 3) uint8.
    """
    normal = normals(position)
    ray = torch.nn.functional.normalize(position, dim=-1)
    facing = (normal * ray).sum(dim=-1, keepdim=True).abs()
    albedo = (color.float() / 255) ** GAMMA / (AMBIENT + (1 - AMBIENT) * facing)
    direct = (normal * lamp.direction[:, None, None]).sum(dim=-1, keepdim=True).clamp_min(0)
    lit = albedo * (lamp.ambient[:, None, None, None] + lamp.color[:, None, None] * direct)
    return (lit.clamp(0, 1) ** (1 / GAMMA) * 255).round().to(torch.uint8)
