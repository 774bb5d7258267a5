"""KeptWindow: what a window was fused from, by value and small, so that it can be taken out again,
exactly, and be fused elsewhere.

A trajectory that a loop corrects moves whole windows: each is taken out at its old pose and fused
anew, moved as a rigid body with its keyframe.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..device_arrays import DeviceArray
from ..geometry.se3 import distance, inverse, normalized
from ..kernels.keeping import shrink_depth
from ..types import ImageView, PinholeCamera
from .kept_cells import KeptCells, Levels
from .lenses import through_lenses

DEPTH_UNITS = 1000.0  # of a metre
DEPTH_STEP = 2  # pixels from one that is kept to the next
# [m, degrees] nearer than this to where it was fused first, a window lies exactly there: its cells
# are those of the map then
SNAP = 5e-4, 0.02


@dataclass(frozen=True)
class KeptViews:
    """The depth images of a window, small and in whole millimetres; all of them vote."""

    depth: NDArray[np.uint16]  # (K, h, w) [mm] 0: no reading
    camera: PinholeCamera  # of the first of these images
    T_keyframe_camera: NDArray[np.float64]  # (K, 4, 4)
    lenses: NDArray[np.float64]  # (K, 4) as `lens_beside` has them

    @classmethod
    def of(
        cls,
        images: DeviceArray,
        camera: PinholeCamera,
        T_keyframe_camera: NDArray[np.float64],
        lenses: NDArray[np.float64],
    ) -> KeptViews:
        """The first images (K, H, W) [m] of a window; of each row and column every DEPTH_STEPth."""
        n, (height, width) = len(T_keyframe_camera), images.shape[1:]
        depth = np.empty((n, -(-height // DEPTH_STEP), -(-width // DEPTH_STEP)), np.uint16)
        shrink_depth(images, DEPTH_STEP, DEPTH_UNITS, depth)
        small = PinholeCamera(
            depth.shape[2],
            depth.shape[1],
            camera.fx / DEPTH_STEP,
            camera.fy / DEPTH_STEP,
            camera.cx / DEPTH_STEP,
            camera.cy / DEPTH_STEP,
        )
        return cls(depth, small, T_keyframe_camera, lenses)

    @property
    def meters(self) -> NDArray[np.float32]:
        """(K, h, w) [m]."""
        return self.depth.astype(np.float32) / np.float32(DEPTH_UNITS)

    def T_camera_world(self, T_world_keyframe: NDArray[np.float64]) -> NDArray[np.float32]:
        """(K, 3, 4) with the keyframe at a pose, as its camera would have to see them."""
        return through_lenses(inverse(T_world_keyframe @ self.T_keyframe_camera), self.lenses)


@dataclass(frozen=True)
class KeptFeatures:
    """What a frame brought to a map of features: the cells that it saw, and its feature pixels."""

    name: str  # of the map
    cells: KeptCells
    numbers: NDArray[np.int8]  # (h, w, c) a pixel's features by its scale
    scales: NDArray[np.float32]  # (h, w) NaN: the pixel is not finite
    camera: PinholeCamera  # of the feature image
    T_camera_world: NDArray[np.float64]  # (4, 4) where it was fused first

    @classmethod
    def of(cls, name: str, cells: KeptCells, image: ImageView) -> KeptFeatures:
        """Of features of a frame in world coordinates."""
        largest = np.abs(image.values).max(axis=2)
        scales = np.where(np.isfinite(largest), np.maximum(largest, 1e-30) / 127, np.nan)
        numbers = np.nan_to_num(np.rint(image.values / scales[..., None]))
        return cls(
            name,
            cells,
            numbers.astype(np.int8),
            scales.astype(np.float32),
            image.camera,
            image.T_camera_cloud,
        )

    def image(self, T: NDArray[np.float64] | None = None) -> ImageView:
        """The features as they were fused, of points moved by T."""
        values = self.numbers.astype(np.float32) * self.scales[..., None]
        moved = self.T_camera_world if T is None else normalized(self.T_camera_world @ inverse(T))
        return ImageView(values, self.camera, moved)

    @property
    def nbytes(self) -> int:
        """Bytes that this takes, not compressed."""
        return self.cells.nbytes + self.numbers.nbytes + self.scales.nbytes


@dataclass(frozen=True)
class KeptWindow:
    """A window that was fused: where and from what."""

    frames: tuple[int, ...]  # places in the recording; the first is the keyframe
    T_world_keyframe: NDArray[np.float64]  # (4, 4) where it was fused first
    cells: Mapping[tuple[str, ...], KeptCells]  # by the names of the maps of a part
    views: KeptViews
    features: Sequence[KeptFeatures] = field(default=())
    apart: bool = False  # fused nowhere: the place of its world in the map is not known yet

    @property
    def nbytes(self) -> int:
        """Bytes that it takes, not compressed."""
        parts = (*self.cells.values(), *self.features)
        return self.views.depth.nbytes + sum(each.nbytes for each in parts)

    def motion(self, T_world_keyframe: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """(4, 4) by which its points move when the keyframe comes to lie there; None: not at all."""
        moved, turned = distance(self.T_world_keyframe, T_world_keyframe)
        if moved <= SNAP[0] and np.degrees(turned) <= SNAP[1]:
            return None
        return normalized(T_world_keyframe @ inverse(self.T_world_keyframe))


def placed(
    frames: Sequence[int],
    T_keyframe_camera: NDArray[np.float64],
    T_world_camera: Mapping[int, NDArray[np.float64]],
) -> NDArray[np.float64] | None:
    """(4, 4) the pose of a window's keyframe that fits those of its frames best, by their places in
    the recording; None where none of them has one.
    """
    found = [
        T_world_camera[frame] @ inverse(T)
        for frame, T in zip(frames, T_keyframe_camera, strict=True)
        if frame in T_world_camera
    ]
    return mean_pose(np.array(found)) if found else None


def mean_pose(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) between poses (N, 4, 4) that differ little."""
    if (T[0] == T).all():
        return T[0]
    U, _, Vt = np.linalg.svd(T[:, :3, :3].mean(axis=0))
    mean = np.eye(4)
    mean[:3, :3], mean[:3, 3] = U @ Vt, T[:, :3, 3].mean(axis=0)
    return mean


__all__ = ["KeptCells", "KeptFeatures", "KeptViews", "KeptWindow", "Levels"]
