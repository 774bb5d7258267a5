"""Which triangle each pixel of a camera sees, and how far it is: drawn in software, by kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..types import PinholeCamera

EMPTY = np.iinfo(np.int64).max  # value where no triangle is seen


@dataclass(frozen=True)
class DepthBuffer:
    """Depth and triangle of every pixel in one integer, as `kernels/raster.py` packs them."""

    nearest: NDArray[np.int64]  # (H, W) bits of the depth << 32 | triangle, or EMPTY
    projection: NDArray[np.float64]  # (3, 4) world [m] -> homogeneous image (u w, v w, w)

    @property
    def empty(self) -> NDArray[np.bool_]:
        """(H, W) where nothing is seen."""
        return self.nearest == EMPTY

    def depth(self, nothing: float) -> NDArray[np.float32]:
        """Depth (H, W) [m] along the optical axis, `nothing` where nothing is seen."""
        depth = (self.nearest >> 32).astype(np.int32).view(np.float32)
        return np.where(self.empty, np.float32(nothing), depth)

    def triangle(self) -> NDArray[np.int32]:
        """Row of the faces (H, W), -1 where nothing is seen."""
        return np.where(self.empty, -1, self.nearest & 0xFFFFFFFF).astype(np.int32)


def draw_depth_buffer(
    vertices: Any,
    faces: Any,
    camera: PinholeCamera,
    T_world_camera: NDArray[np.float64],
    near: float,
    *,
    two_sided: bool,
) -> DepthBuffer:
    """The nearest triangle at the centre of every pixel, of vertices (V, 3) world [m] and faces
    (F, 3), float32 and int32 in NumPy or on the device.

    Nothing nearer than `near` [m] is drawn, and sides whose corners run clockwise only if
    `two_sided`.
    """
    runtime.current()  # before Taichi is imported: it says what it starts
    from .kernels.raster import rasterize

    projection = np.ascontiguousarray(camera.matrix @ np.linalg.inv(T_world_camera)[:3])
    nearest = np.empty((camera.height, camera.width), np.int64)
    rasterize(vertices, faces, int(two_sided), projection, near, nearest)
    return DepthBuffer(nearest, projection)
