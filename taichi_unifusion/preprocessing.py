"""Frame -> PointCloud: readings in range, no flying pixels, normals towards the camera (Sec. IV-B,
V-A).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import runtime
from .errors import InputError
from .types import Frame, ImageView, PointCloud

FARTHEST = 1e4  # [m] readings beyond it are dropped


@dataclass(frozen=True)
class PreprocessSettings:
    """What makes a pixel a point."""

    depth_min: float = 0.1
    """Nearest reading that is used, in metres."""
    depth_max: float = 5.0
    """Farthest reading that is used, in metres."""
    edge_jump: float = 0.03
    """Neighbouring pixels whose depths differ by more than this share of the depth lie on different
    surfaces.
    """
    edge_support: int = 1
    """How many of a pixel's 8 neighbours must lie on its surface; fewer: a flying pixel. 0 keeps
    all.
    """
    normal_radius: int = 2
    """Radius in pixels of the window from which a normal is estimated."""
    max_angle: float = 80.0
    """Pixels seen at a more grazing angle than this, in degrees between ray and normal, are left
    out.
    """

    def __post_init__(self) -> None:
        if not 0 < self.depth_min < self.depth_max:
            raise InputError(
                f"preprocess: need 0 < depth_min < depth_max, got {self.depth_min} and {self.depth_max}"
            )
        if not 0 < self.edge_jump < 1 or not 0 <= self.edge_support <= 8:
            raise InputError(
                f"preprocess: need 0 < edge_jump < 1 and edge_support in 0..8, got {self.edge_jump} and "
                f"{self.edge_support}"
            )
        if not 1 <= self.normal_radius <= 20 or not 0 < self.max_angle <= 90:
            raise InputError(
                f"preprocess: need normal_radius in 1..20 and max_angle in (0, 90], got {self.normal_radius} "
                f"and {self.max_angle}"
            )


def preprocess(frame: Frame, settings: PreprocessSettings | None = None) -> PointCloud:
    """Points, normals, colour and property images of a frame's usable pixels, in camera
    coordinates, row by row.

    A frame without a usable pixel gives an empty cloud.
    """
    live = runtime.current()
    from .kernels import images as kernels

    settings = settings or PreprocessSettings()
    depth, inverse, normals, pixels = _scratch(live, frame.depth.shape)
    _find_normals(frame, settings, depth, inverse, normals)
    counts = np.empty(-(-frame.depth.size // kernels.PIXEL_CHUNK), np.int32)
    kernels.count_points(normals, counts)
    runtime.synchronize()
    total = int(counts.sum())
    points, point_normals = np.empty((total, 3), np.float32), np.empty((total, 3), np.float32)
    view = _view(frame, settings)
    if total == 0:
        empty = {name: np.empty((0, c), np.float32) for name, c in _channels(frame).items()}
        return PointCloud(points, point_normals, empty, view)
    kernels.unproject(
        depth,
        normals,
        frame.camera.intrinsics,
        (np.cumsum(counts) - counts).astype(np.int32),
        points,
        point_normals,
        pixels,
    )
    attributes = {name: np.empty((total, c), np.float32) for name, c in _channels(frame).items()}
    for name, values in attributes.items():
        if name == "color" and name not in frame.images:
            kernels.sample_color(pixels, np.ascontiguousarray(frame.color), values)
        else:
            kernels.sample_image(pixels, np.ascontiguousarray(frame.images[name]), values)
    return PointCloud(points, point_normals, attributes, view, frame.features)


def _view(frame: Frame, settings: PreprocessSettings) -> ImageView:
    """All readings of a frame: those too far for a point still show that the space in front of them
    is free.
    """
    from .kernels import images as kernels

    depth = np.empty_like(frame.depth)
    kernels.clip_depth(np.ascontiguousarray(frame.depth), settings.depth_min, FARTHEST, depth)
    return ImageView(depth, frame.camera)


def normal_image(frame: Frame, settings: PreprocessSettings | None = None) -> NDArray[np.float32]:
    """Unit normals (H, W, 3) towards the camera, in camera coordinates, of a frame's usable pixels;
    0 elsewhere.
    """
    depth, inverse, normals, _ = _scratch(runtime.current(), frame.depth.shape)
    _find_normals(frame, settings or PreprocessSettings(), depth, inverse, normals)
    return normals.to_numpy()


def _find_normals(frame: Frame, settings: PreprocessSettings, depth, inverse, normals) -> None:
    """Fill the scratch images from the depth image."""
    from .kernels import images as kernels

    kernels.clip_depth(
        np.ascontiguousarray(frame.depth), settings.depth_min, settings.depth_max, depth
    )
    kernels.drop_flying_pixels(depth, settings.edge_jump, settings.edge_support, inverse)
    kernels.estimate_normals(
        inverse,
        frame.camera.intrinsics,
        settings.normal_radius,
        settings.edge_jump,
        float(np.cos(np.radians(settings.max_angle))),
        normals,
    )


def _scratch(live: runtime.Runtime, shape: tuple[int, int]) -> tuple:
    """Images that only the kernels need: depth, inverse depth, normals and pixels of the points;
    kept on the device by size.
    """
    import taichi as ti

    def make() -> tuple:
        return (
            ti.ndarray(ti.f32, shape),
            ti.ndarray(ti.f32, shape),
            ti.ndarray(ti.f32, (*shape, 3)),
            ti.ndarray(ti.i32, (shape[0] * shape[1], 2)),
        )

    return live.arena.exact("images of a frame", make, shape)


def _channels(frame: Frame) -> dict[str, int]:
    """Channels of every attribute that the cloud of a frame gets."""
    channels = {name: image.shape[2] for name, image in frame.images.items()}
    return channels if frame.color is None else {"color": 3, **channels}
