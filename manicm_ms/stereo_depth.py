"""What a stereo depth camera makes of a scene: noise, shadows, fat edges and holes on a clean depth image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from manicm_ms.camera_model import CameraModel


@dataclass(frozen=True)
class StereoDepth:
    """An active stereo pair of the RealSense D400 kind, whose depth image is seen from the left imager.

    The order is that of the camera: matching (fat edges, noise, quantised disparity), the check of the match (shadows,
    holes), conversion to depth units. Every effect can be turned off by its zero.

    Attributes:
        baseline: B, metres between the imagers; disparity is d = fx B / z, pixels.
        subpixel_sigma: standard deviation of the disparity, pixels; 0 = exact.
        window: width of the matching window, pixels, odd: disparity errors are alike within it.
        subpixel_steps: disparities per pixel that the matcher tells apart; 0 = all.
        max_disparity: pixels; what is nearer than fx B / max_disparity gives no reading.
        max_distance: metres; what is farther gives no reading.
        fattening: smallest and largest width, pixels, by which a near surface grows over a farther one; (0, 0) = not.
        edge_step: difference of disparity, pixels, from which two neighbouring surfaces are an edge.
        flying: share of the grown pixels whose depth lies between the two surfaces.
        dropout: share of pixels without a reading, each by itself.
        blobs: share of the image without a reading, in patches some window wide.
        grazing: angles of incidence, degrees, from which readings are lost and from which all are; (90, 90) = never.
        dark_level: intensity in [0, 1] from which no reading is lost for lack of light; 0 = never.
        dark_dropout: share of readings lost on a black surface.
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

        A row depends on its own depth, seed, frame number and scale, never on the number of rows or their order.

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
        raise NotImplementedError  # the next commit
