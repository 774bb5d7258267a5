"""Frame -> surfel images, coarse to fine: what registration works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..device_arrays import DeviceArray
from ..types import Frame, PinholeCamera

# [px] wider images are averaged to at least this width; finer ones add time and noise, no accuracy
FINEST_WIDTH = 320
SMALLEST = 24  # [px] least shorter side of a level
NORMAL_RADIUS = (3, 2, 2)  # [px] by level, finest first
# what PreprocessSettings calls edge_jump and edge_support; the jump in images of FINEST_WIDTH or more
EDGE_JUMP, EDGE_SUPPORT = 0.03, 5
MAX_ANGLE = 80.0  # [degrees] between ray and normal


@dataclass(frozen=True, eq=False)
class ReducedFrame:
    """The images of a frame's finest level, from which its pyramid can be built again."""

    inverse: NDArray[np.float32]  # (h, w) [1/m], 0: none
    intensity: NDArray[np.float16]  # (h, w) in [0, 1]; zero where the frame has no colour
    camera: PinholeCamera  # of these pixels
    colored: bool  # False: intensity says nothing


@dataclass(frozen=True, eq=False)
class SurfelImage:
    """One level: an (h, w, 8) image of surfels on the device (kernels/registration.py), and the
    camera of its pixels.
    """

    surfels: DeviceArray
    camera: PinholeCamera

    def read(self, step: int, channels: int) -> NDArray[np.float32]:
        """(h / step, w / step, channels) the first channels of every step-th pixel and row, by value."""
        from ..kernels import registration as kernels

        height, width = self.surfels.shape[:2]
        found = np.empty((-(-height // step), -(-width // step), channels), np.float32)
        kernels.read_surfels(self.surfels, step, found)
        return found


@dataclass(eq=False)
class SurfelPyramid:
    """A frame as surfel images, finest first, each half the size of the one before."""

    levels: tuple[SurfelImage, ...]
    colored: bool = True  # whether intensities may be compared
    left_out: bool = False  # whether some of its pixels are


def reduce_frame(frame: Frame, depth_min: float, depth_max: float) -> ReducedFrame:
    """Inverse depth without flying pixels and intensity, averaged over blocks of pixels."""
    runtime.current()
    from ..kernels import images
    from ..kernels import registration as kernels

    depth = np.ascontiguousarray(frame.depth)
    clipped, inverse = np.empty_like(depth), np.empty_like(depth)
    images.clip_depth(depth, depth_min, depth_max, clipped)
    jump = edge_jump(frame.camera)
    images.drop_flying_pixels(clipped, jump, EDGE_SUPPORT, inverse)
    factor = max(1, frame.camera.width // FINEST_WIDTH)
    camera = frame.camera.shrunk(factor)
    reduced, intensity = (np.zeros((camera.height, camera.width), np.float32) for _ in range(2))
    kernels.average_inverse_depth(inverse, factor, jump, reduced)
    if frame.color is not None:
        kernels.average_color(np.ascontiguousarray(frame.color), factor, intensity)
    return ReducedFrame(reduced, intensity.astype(np.float16), camera, frame.color is not None)


def build_pyramid(reduced: ReducedFrame) -> SurfelPyramid:
    """Surfel images of a frame: depth, normals, intensity and its slopes at every level."""
    from ..kernels import images, ti
    from ..kernels import registration as kernels

    inverse, intensity, camera = (
        reduced.inverse,
        reduced.intensity.astype(np.float32),
        reduced.camera,
    )
    cosine = float(np.cos(np.radians(MAX_ANGLE)))
    levels = []
    for level, radius in enumerate(NORMAL_RADIUS):
        if level:
            if min(camera.size) < 2 * SMALLEST:
                break
            camera = camera.shrunk(2)
            finer, finer_intensity = inverse, intensity
            inverse, intensity = (
                np.empty((camera.height, camera.width), np.float32) for _ in range(2)
            )
            kernels.average_inverse_depth(finer, 2, edge_jump(camera), inverse)
            kernels.average_intensity(finer_intensity, intensity)
        normals = np.empty((*inverse.shape, 3), np.float32)
        images.estimate_normals(
            inverse,
            camera.intrinsics,
            radius,
            edge_jump(camera),
            cosine,
            normals,
        )
        surfels = ti.ndarray(ti.f32, (*inverse.shape, kernels.CHANNELS))
        kernels.pack_surfels(inverse, normals, intensity, surfels)
        levels.append(SurfelImage(surfels, camera))
    return SurfelPyramid(tuple(levels), reduced.colored)


def edge_jump(camera: PinholeCamera) -> float:
    """Share of the depth by which neighbouring pixels of one surface may differ: more in a coarser
    image.
    """
    return EDGE_JUMP * max(1.0, FINEST_WIDTH / camera.width)
