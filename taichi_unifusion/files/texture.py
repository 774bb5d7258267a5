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

    def encoded(self, kind: ImageKind) -> bytes:
        """The image as the bytes of a PNG or JPEG file, colour at full resolution in both."""
        import cv2  # a tenth of a second, which meshes without a texture do not need

        full_color = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        options = {"png": [], "jpg": [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *full_color]}
        return cv2.imencode(f".{kind}", self.image[..., ::-1], options[kind])[1].tobytes()
