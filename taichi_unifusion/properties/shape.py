"""Properties that depth itself gives: the direction of the surface, and how it bends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError
from ..preprocessing import PreprocessSettings, normal_image
from ..rendering.look import Look
from ..types import Frame
from .base import SurfaceProperty

# relative depth step beyond which two pixels lie on different surfaces
FARTHEST_JUMP = 0.03
VOXEL_SIZE = 0.05  # [m] as the surface


def surface_normal() -> SurfaceProperty:
    """Unit normal in the world, towards the camera, as three channels in [-1, 1]; shown as RGB."""

    def function(frame: Frame) -> NDArray[np.float32]:
        if frame.T_world_camera is None:
            raise FrameError("a direction in the world needs the frame's pose")
        normals = _normals_of(frame)
        return normals @ frame.T_world_camera[:3, :3].T.astype(np.float32)

    return SurfaceProperty(
        "normal",
        3,
        function,
        Look(range=(-1.0, 1.0), label="normal x, y, z as red, green, blue"),
        voxel_size=VOXEL_SIZE,
    )


def mean_curvature(*, radius: int = 6) -> SurfaceProperty:
    """Mean curvature [1/m] over `radius` pixels to each side: positive on a ball, negative in a
    bowl, 0 on a plane.
    """
    if not 1 <= radius <= 50:
        raise InputError(f"curvature: radius must lie in 1..50 pixels, got {radius}")

    def function(frame: Frame) -> NDArray[np.float32]:
        normals = _normals_of(frame)
        points = frame.camera.rays().astype(np.float32) * frame.depth[..., None]
        return 0.5 * (
            _bend(points, normals, radius)
            + _bend(points.swapaxes(0, 1), normals.swapaxes(0, 1), radius).T
        )

    return SurfaceProperty(
        "curvature",
        1,
        function,
        Look("diverging", None, "mean curvature [1/m]"),
        voxel_size=VOXEL_SIZE,
    )


def _normals_of(frame: Frame) -> NDArray[np.float32]:
    """Normals (H, W, 3) in the camera frame, NaN where there is none."""
    normals = normal_image(frame, PreprocessSettings())
    return np.where((normals != 0).any(axis=2, keepdims=True), normals, np.float32(np.nan))


def _bend(points: NDArray, normals: NDArray, radius: int) -> NDArray[np.float32]:
    """Normal curvature [1/m] along image rows, (H, W), from the pixels `radius` away on both sides;
    NaN across an edge.
    """
    bend = np.full(points.shape[:2], np.nan, np.float32)
    if points.shape[1] <= 2 * radius:
        return bend
    step = points[:, 2 * radius :] - points[:, : -2 * radius]
    turn = normals[:, 2 * radius :] - normals[:, : -2 * radius]
    far = np.abs(step[..., 2]) > FARTHEST_JUMP * (1 + radius / 4) * points[:, radius:-radius, 2]
    length = np.maximum((step**2).sum(axis=2), 1e-12)
    bend[:, radius:-radius] = np.where(far, np.nan, (turn * step).sum(axis=2) / length)
    return bend
