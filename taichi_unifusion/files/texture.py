"""A texture of a mesh, and the bytes of its image as PNG or JPEG.

Nothing here imports `types`, so that `Mesh.save` can call what writes it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

ImageKind = Literal["png", "jpg"]
MIME_TYPES = {"png": "image/png", "jpg": "image/jpeg"}
JPEG_QUALITY = 92


@dataclass(frozen=True)
class Texture:
    """An image on a mesh: where in it every vertex lies."""

    coordinates: NDArray[np.float32]  # (V, 2) in [0, 1], right and down from the upper left corner
    image: NDArray[np.uint8]  # (H, W, 3) RGB, sRGB

    def __post_init__(self) -> None:
        if self.coordinates.ndim != 2 or self.coordinates.shape[1] != 2:
            raise InputError(f"texture: coordinates must be (V, 2), got {self.coordinates.shape}")
        if self.image.ndim != 3 or self.image.shape[2] != 3 or self.image.dtype != np.uint8:
            raise InputError(
                f"texture: image must be (H, W, 3) uint8, got {self.image.shape} {self.image.dtype}"
            )

    def at(self, coordinates: NDArray) -> NDArray[np.float32]:
        """Colours (N, 3) in [0, 1] at texture coordinates (N, 2), bilinear between texels' centres and
        constant beyond the outer ones.
        """
        height, width = self.image.shape[:2]
        x, y = (np.asarray(coordinates, np.float64) * (width, height) - 0.5).T
        x, y = x.clip(0, width - 1), y.clip(0, height - 1)
        column, row = x.astype(int), y.astype(int)
        right, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
        a, b = (x - column)[:, None], (y - row)[:, None]
        upper = (1 - a) * self.image[row, column] + a * self.image[row, right]
        lower = (1 - a) * self.image[below, column] + a * self.image[below, right]
        return (((1 - b) * upper + b * lower) / 255).astype(np.float32)

    def encoded(self, kind: ImageKind) -> bytes:
        """The image as the bytes of a PNG or JPEG file, colour at full resolution in both."""
        import cv2  # a tenth of a second, which meshes without a texture do not need

        full_color = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        options = {"png": [], "jpg": [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *full_color]}
        return cv2.imencode(f".{kind}", self.image[..., ::-1], options[kind])[1].tobytes()
