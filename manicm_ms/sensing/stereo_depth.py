"""What a stereo depth camera makes of a scene: noise, shadows, fat edges and holes on a clean depth image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.depth_images import MAX_RAW

_STREAM = 0xD435  # keeps the camera's draws apart from the scene's, which come from the same seed
_SHADOW_TOLERANCE = 0.01  # pixels: rounding must not let a plane hide itself
_PATCH = 3  # pixels of the image to one of the coarse picture that holes in patches are drawn in
_PATCH_WINDOW = 3  # coarse pixels over which that picture is alike: holes are some 9 pixels wide
_EDGE_CELL = 8  # pixels of an edge that grow by the same width


@dataclass(frozen=True)
class StereoDepth:
    """An active stereo pair of the RealSense D400 kind, whose depth image is seen from the left imager.

    The order is that of the camera: matching (fat edges, noise, steps of disparity), the check of the match (shadows,
    holes), conversion to depth units. Every effect can be turned off. Sources: docs/decisions/0011.

    Attributes:
        baseline: B, metres between the imagers; disparity is d = fx B / z, pixels.
        subpixel_sigma: standard deviation of the disparity, pixels; 0 = exact.
        window: width of the matching window, pixels, odd: disparity errors are alike within it.
        subpixel_steps: disparities per pixel that the matcher tells apart; 0 = all.
        max_disparity: pixels; what is nearer than fx B / max_disparity gives no reading.
        max_distance: metres; what is farther gives no reading.
        fattening: smallest and largest width, pixels, by which a near surface grows over a farther one; (0, 0) = not.
        edge_step: difference of disparity, pixels, between neighbouring pixels that makes an edge.
        flying: share of the grown pixels whose depth lies between the two surfaces.
        dropout: share of pixels without a reading, each by itself.
        blobs: share of the image without a reading, in patches some nine pixels wide.
        grazing: angles of incidence, degrees, from which readings are lost and from which all are; (90, 90) = never.
        dark_level: intensity in [0, 1] from which no reading is lost for lack of light; 0 = never.
        dark_dropout: share of readings lost on a black surface.

    Raises:
        ConfigError: a field is out of range.
    """

    baseline: float = 0.050
    subpixel_sigma: float = 0.08
    window: int = 7
    subpixel_steps: int = 32
    max_disparity: float = 126.0
    max_distance: float = 10.0
    fattening: tuple[int, int] = (2, 4)
    edge_step: float = 1.0
    flying: float = 0.1
    dropout: float = 0.01
    blobs: float = 0.01
    grazing: tuple[float, float] = (70.0, 80.0)
    dark_level: float = 0.15
    dark_dropout: float = 0.5

    def __post_init__(self) -> None:
        shares = ("flying", "dropout", "blobs", "dark_level", "dark_dropout")
        above_zero = min(self.baseline, self.max_disparity, self.max_distance, self.edge_step) > 0
        conditions = {
            "baseline, max_disparity, max_distance and edge_step must be above 0": above_zero,
            "subpixel_sigma and subpixel_steps must not be negative": min(self.subpixel_sigma, self.subpixel_steps)
            >= 0,
            "window must be odd": self.window > 0 and self.window % 2 == 1,
            "fattening must rise from 0 pixels or more": 0 <= self.fattening[0] <= self.fattening[1],
            "grazing must rise, within 0 to 90 degrees": 0 <= self.grazing[0] <= self.grazing[1] <= 90,
            f"{', '.join(shares)} must lie in [0, 1]": all(0 <= getattr(self, name) <= 1 for name in shares),
        }
        for text, holds in conditions.items():
            if not holds:
                raise ConfigError(f"{text}, got { ({f.name: getattr(self, f.name) for f in fields(self)}) }")

    def min_distance(self, camera: CameraModel) -> float:
        """Return the nearest distance that is read, metres: fx B / max_disparity."""
        return camera.fx * self.baseline / self.max_disparity

    def sigma(self, z: Tensor, camera: CameraModel) -> Tensor:
        """Return the standard deviation, metres, of readings of a surface at z metres: z^2 s / (fx B).

        First order in the noise of the matcher, s = `subpixel_sigma` (Grunnet-Jepsen, librealsense issue 3904), without
        the steps of disparity and of depth units, each of which adds a variance of step^2 / 12.
        """
        return z * z * (self.subpixel_sigma / (camera.fx * self.baseline))

    def apply(
        self,
        depth: Tensor,
        camera: CameraModel,
        seeds: Sequence[int],
        frames: Sequence[int],
        *,
        intensity: Tensor | None = None,
        scale: Tensor | None = None,
    ) -> Tensor:
        """Return what the camera would read of clean depth images.

        A row depends on its own depth, seed, frame number and scale, never on the number of rows or their order. (The
        draws are those of the device that holds `depth`: another kind of device gives other draws of the same law.)

        Args:
            depth: (N, h, w) float32, metres along the left imager's axis at the native resolution of `camera.crop`;
                0 where nothing was hit.
            camera: gives focal length, crop and depth unit.
            seeds: (N,) a seed for each row's episode, not negative.
            frames: (N,) number of the frame within the episode; the same number gives the same noise.
            intensity: (N, h, w) in [0, 1]; None where no surface is dark.
            scale: (N,) factor on all readings of a row, the camera's own scale error; None = 1.

        Returns:
            (N, h, w) float32, metres, whole multiples of `camera.depth_unit`; 0 = no reading.
        """
        focal_baseline = camera.fx * self.baseline  # px m
        clean = torch.where(depth > 0, focal_baseline / depth, 0.0)  # disparity, px
        draws = self._draw(seeds, frames, depth)
        grown = self._fatten(clean, draws.edge)
        matched = self._match(clean, grown, draws)

        left = camera.crop.left + torch.arange(depth.shape[-1], device=depth.device)
        read = (matched > 0) & (grown <= self.max_disparity)
        read &= left >= grown  # the band at the left border of the image has no partner in the right one
        read &= ~hidden_from_right(grown)
        read &= draws.pixel >= self._loss(clean, camera, intensity)
        if self.blobs > 0:
            read &= draws.patch < NormalDist().inv_cdf(1 - self.blobs) if self.blobs < 1 else torch.zeros_like(read)

        distance = focal_baseline / matched
        if scale is not None:
            distance = distance * scale[:, None, None]
        raw = torch.round(distance / camera.depth_unit)
        read &= raw <= min(self.max_distance / camera.depth_unit, MAX_RAW)
        return camera.metres(torch.where(read, raw, 0.0))

    def _draw(self, seeds: Sequence[int], frames: Sequence[int], depth: Tensor) -> _Draws:
        height, width = depth.shape[-2:]
        rows = [
            self._draw_row(seed, frame, height, width, depth.device) for seed, frame in zip(seeds, frames, strict=True)
        ]
        disparity, patch, pixel, flight, edge = (torch.stack(part) for part in zip(*rows, strict=True))
        patch = _enlarge(window_noise(patch, _PATCH_WINDOW), _PATCH, height, width)
        edge = _enlarge(edge, _EDGE_CELL, height, width)
        return _Draws(window_noise(disparity, self.window), patch, pixel, flight, edge)

    def _draw_row(self, seed: int, frame: int, height: int, width: int, device: torch.device) -> tuple[Tensor, ...]:
        state = np.random.SeedSequence([int(seed), int(frame), _STREAM]).generate_state(1, np.uint64)
        generator = torch.Generator(device).manual_seed(int(state[0] >> np.uint64(1)))
        margin, coarse = self.window - 1, [-(-n // _PATCH) + _PATCH_WINDOW - 1 for n in (height, width)]
        options: dict[str, Any] = {"generator": generator, "device": device}
        return (
            torch.randn(height + margin, width + margin, **options),
            torch.randn(*coarse, **options),
            torch.rand(height, width, **options),
            torch.rand(height, width, **options),
            torch.rand(-(-height // _EDGE_CELL), -(-width // _EDGE_CELL), **options),
        )

    def _fatten(self, disparity: Tensor, edge: Tensor) -> Tensor:
        """Return disparities where near surfaces have grown over farther ones, by a width that `edge` (0..1) draws.

        A window that reaches over an edge matches the near surface: the farther one is hidden behind it in one view.
        """
        narrow, wide = self.fattening
        if wide == 0:
            return disparity
        source = torch.where(disparity + _grown(-disparity) > self.edge_step, disparity, 0.0)
        widths = narrow + torch.floor(edge * (wide - narrow + 1))
        near = torch.zeros_like(disparity)
        for width in range(1, wide + 1):
            source = _grown(source)
            near = torch.where(widths >= width, source, near)
        return torch.where(near > disparity + self.edge_step, near, disparity)

    def _match(self, clean: Tensor, grown: Tensor, draws: _Draws) -> Tensor:
        """Return the disparities that the matcher finds: some fly between two surfaces, all are noisy, in steps."""
        matched = grown
        if self.flying > 0:
            between = clean + (grown - clean) * (draws.flight / self.flying)
            matched = torch.where(draws.flight < self.flying, between, grown)
        matched = torch.where(matched > 0, matched + self.subpixel_sigma * draws.disparity, 0.0)
        if self.subpixel_steps > 0:
            matched = torch.round(matched * self.subpixel_steps) / self.subpixel_steps
        return matched

    def _loss(self, disparity: Tensor, camera: CameraModel, intensity: Tensor | None) -> Tensor:
        """Return the probability (N, h, w) that a pixel gives no reading for its own sake."""
        kept = torch.full_like(disparity, 1 - self.dropout)
        begin, end = (math.cos(math.radians(angle)) for angle in self.grazing)
        if self.grazing[0] < 90:
            cosine = incidence_cosine(disparity, camera)
            share = ((cosine - end) / max(begin - end, 1e-6)).clamp(0, 1)
            kept *= torch.where(disparity > 0, share, 1.0)  # where nothing was hit a near surface may have grown
        if intensity is not None and self.dark_level > 0:
            kept *= 1 - self.dark_dropout * (1 - intensity / self.dark_level).clamp(0, 1)
        return 1 - kept


class _Draws(NamedTuple):
    """Random pictures (N, h, w): unit Gaussians alike within a window, and uniform ones in [0, 1)."""

    disparity: Tensor  # Gaussian
    patch: Tensor  # Gaussian, coarse
    pixel: Tensor  # uniform
    flight: Tensor  # uniform
    edge: Tensor  # uniform, coarse


def hidden_from_right(disparity: Tensor) -> Tensor:
    """Return which pixels (..., h, w) of the left view the right imager cannot see, bool.

    Column x of the left view is column x - d(x) of the right one. It is hidden where a pixel to its right falls on the
    same column or to the left of it: that one is nearer. The width of the shadow left of a near surface is the
    difference of the two disparities, fx B (1/z_near - 1/z_far) pixels.
    """
    column = torch.arange(disparity.shape[-1], device=disparity.device) - disparity
    leftmost = column.flip(-1).cummin(dim=-1).values.flip(-1)  # of this pixel and all to its right
    return column > leftmost + _SHADOW_TOLERANCE


def incidence_cosine(disparity: Tensor, camera: CameraModel) -> Tensor:
    """Return the cosine of the angle between ray and surface normal (..., h, w), from disparities of a crop.

    On a plane n.P = 1 the inverse depth is 1/z = n.(x, y, 1) with the ray (x, y, 1), so its derivatives along row and
    column are n_x / fx and n_y / fy, and cos = (1/z) / (|n| |ray|). Of the two one-sided differences the flatter one is
    taken, so that the rim of a surface is not taken for a steep one. Where nothing was hit, 0 disparity, it is 0.
    """
    nx = camera.fx * _flatter(disparity, dim=-1)
    ny = camera.fy * _flatter(disparity, dim=-2)
    x, y, length = _ray_grid(camera, disparity.device)
    nz = disparity - nx * x - ny * y
    return disparity / (torch.sqrt(nx * nx + ny * ny + nz * nz) * length).clamp(min=1e-12)


@lru_cache(maxsize=8)
def _ray_grid(camera: CameraModel, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return x (w,), y (h, 1) and length (h, w) of the crop's rays (x, y, 1), float32."""
    left, top, width, height = camera.crop
    x = ((torch.arange(width, device=device) + left - camera.cx) / camera.fx).float()
    y = ((torch.arange(height, device=device) + top - camera.cy) / camera.fy).float()[:, None]
    return x, y, torch.sqrt(x * x + y * y + 1)


def _flatter(values: Tensor, dim: int) -> Tensor:
    """Return the one-sided difference along `dim` that is smaller in size; at a border the one that exists."""
    step = values.diff(dim=dim)
    size = step.shape[dim]
    ahead = torch.cat([step, step.narrow(dim, size - 1, 1)], dim)
    behind = torch.cat([step.narrow(dim, 0, 1), step], dim)
    return torch.where(ahead.abs() < behind.abs(), ahead, behind)


def window_noise(noise: Tensor, window: int) -> Tensor:
    """Return unit Gaussians (..., h, w) alike within a square window, of independent ones (..., h + k - 1, w + k - 1).

    The sum of the k x k independent ones in the window, divided by k: exactly unit variance, correlation (1 - |i|/k)
    (1 - |j|/k) at a lag of (i, j) pixels.
    """
    for dim in (-1, -2):
        size = noise.shape[dim] - window + 1
        total = noise.narrow(dim, 0, size)
        for k in range(1, window):
            total = total + noise.narrow(dim, k, size)
        noise = total
    return noise / window


def _grown(values: Tensor) -> Tensor:
    """Return the largest value within one pixel, diagonals included, (..., h, w)."""
    values = torch.maximum(values, torch.maximum(_shifted(values, 1, -1), _shifted(values, -1, -1)))
    return torch.maximum(values, torch.maximum(_shifted(values, 1, -2), _shifted(values, -1, -2)))


def _shifted(values: Tensor, by: int, dim: int) -> Tensor:
    """Return `values` moved by one pixel along `dim`; the border repeats itself."""
    size = values.shape[dim]
    if by > 0:
        return torch.cat([values.narrow(dim, 0, 1), values.narrow(dim, 0, size - 1)], dim)
    return torch.cat([values.narrow(dim, 1, size - 1), values.narrow(dim, size - 1, 1)], dim)


def _enlarge(coarse: Tensor, cell: int, height: int, width: int) -> Tensor:
    """Return the coarse picture with each pixel as a square of `cell` pixels, cut to (..., height, width)."""
    large = coarse.repeat_interleave(cell, dim=-1).repeat_interleave(cell, dim=-2)
    return large[..., :height, :width]
