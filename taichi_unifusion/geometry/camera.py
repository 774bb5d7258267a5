"""PinholeCamera: between points in front of a camera and pixels of its image."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from numbers import Integral, Real

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, shortened, strict

NUMBERS = {"width": Integral, "height": Integral, "fx": Real, "fy": Real, "cx": Real, "cy": Real}


@strict
@dataclass(frozen=True)
class PinholeCamera:
    """Pinhole intrinsics without distortion: u = fx x / z + cx, v = fy y / z + cy, pixel centres at
    integers.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        for name, kind in NUMBERS.items():
            value = getattr(self, name)
            if not isinstance(value, kind):
                wanted = "a whole number" if kind is Integral else "a number"
                raise InputError(f"camera: {name}: expected {wanted}, got {shortened(value)}")
        numbers = (self.fx, self.fy, self.cx, self.cy)
        if not all(np.isfinite(numbers)) or self.fx <= 0 or self.fy <= 0:
            raise InputError(
                f"camera: fx, fy must be positive and all intrinsics finite, got fx={self.fx} fy={self.fy} "
                f"cx={self.cx} cy={self.cy}"
            )
        if self.width < 1 or self.height < 1:
            raise InputError(f"camera: image size must be positive, got {self.width}x{self.height}")
        if not (0 <= self.cx <= self.width and 0 <= self.cy <= self.height):
            raise InputError(
                f"camera: principal point ({self.cx}, {self.cy}) lies outside the "
                f"{self.width}x{self.height} image; are these the intrinsics of another resolution?"
            )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) in pixels, as kernels take them."""
        return self.fx, self.fy, self.cx, self.cy

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The 3x3 matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def resized(self, width: int, height: int) -> PinholeCamera:
        """The same camera for the image resampled to width x height (pixel centres at integers)."""
        sx, sy = width / self.width, height / self.height
        return self._scaled((width, height), sx, sy)

    def shrunk(self, factor: int) -> PinholeCamera:
        """The camera of an image whose pixels are blocks of factor x factor; a remainder at the
        right and below is cut off.
        """
        return self._scaled((self.width // factor, self.height // factor), 1 / factor, 1 / factor)

    def _scaled(self, size: tuple[int, int], sx: float, sy: float) -> PinholeCamera:
        """The camera of the image whose columns and rows are so many times as many. A principal point at
        the very border, which was taken, may come to lie up to a pixel outside.
        """
        scaled = copy(self)
        values = (
            *size,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
        )
        for name, value in zip(NUMBERS, values, strict=True):
            object.__setattr__(scaled, name, value)
        if not (min(size) >= 1 and np.isfinite(scaled.intrinsics).all()):
            raise InputError(
                f"camera: {self.width}x{self.height} cannot become {size[0]}x{size[1]}"
            )
        return scaled

    @property
    def longest_ray(self) -> float:
        """Length of the longest ray through a pixel, with z = 1."""
        x = max(self.cx, self.width - 1 - self.cx) / self.fx
        y = max(self.cy, self.height - 1 - self.cy) / self.fy
        return float(np.sqrt(1 + x * x + y * y))

    def rays(self, u: NDArray | None = None, v: NDArray | None = None) -> NDArray[np.float64]:
        """Directions (..., 3) with z = 1 through the pixels at columns u and rows v; without them
        those of the whole image, (H, W, 3).
        """
        if u is None or v is None:
            u, v = np.arange(self.width), np.arange(self.height)[:, None]
        u, v = np.asarray(u, np.float64), np.asarray(v, np.float64)
        rays = np.ones((*np.broadcast_shapes(u.shape, v.shape), 3))
        rays[..., 0] = (u - self.cx) / self.fx
        rays[..., 1] = (v - self.cy) / self.fy
        return rays

    def project(self, points: NDArray) -> NDArray[np.float64]:
        """Columns u and rows v, (..., 2), of points (..., 3) in the camera frame; NaN for points
        that are not in front of the camera.
        """
        x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
        z = np.where(z > 0, z, np.nan)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    def look_up(
        self, image: NDArray, points: NDArray, nearest: float = 0.0
    ) -> tuple[NDArray, NDArray[np.bool_]]:
        """What an image (H, W, ...) of this camera shows at points (N, 3) in the camera frame [m]:
        values (M, ...) of the M points that are farther than `nearest` and inside it, and which
        points those are (N,).
        """
        u, v = np.rint(self.project(points)).T
        inside = (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)
        inside &= points[:, 2] > nearest
        return image[v[inside].astype(int), u[inside].astype(int)], inside
