"""Registration of two cameras' images: undistort one's images, and resample them as the other
camera sees them.

Distortion is the rational model of Brown and Conrady as OpenCV has it: k1 k2 p1 p2 k3 k4 k5 k6; of a
fisheye lens k1 k2 k3 k4 of its equidistant model.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import PinholeCamera

SAME_SURFACE = 0.03  # relative depth step; beyond it there is an edge, no interpolation
HIDDEN = 0.05  # relative depth behind the nearest reading around; further behind is occluded
MAX_RADIUS = 1.7  # tan of the angle off the axis up to which the distortion model holds by default


@dataclass(frozen=True)
class LensCamera:
    """A pinhole camera with lens distortion."""

    pinhole: PinholeCamera
    distortion: tuple[float, ...]  # k1 k2 p1 p2 k3 k4 k5 k6, or k1 k2 k3 k4 of a fisheye
    max_radius: float = MAX_RADIUS
    fisheye: bool = False

    def undistort(self, image: NDArray, target: PinholeCamera) -> NDArray:
        """Colours (H, W, 3) or measurements (H, W) resampled to the pinhole camera `target` with
        the same pose; 0 outside.
        """
        return cv2.remap(
            image, *_undistortion(self, target), cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )

    def sees(self, target: PinholeCamera) -> NDArray[np.bool_]:
        """The pixels (H, W) of the pinhole camera `target`, with the same pose, that this camera's
        image covers.
        """
        map_x, map_y = _undistortion(self, target)
        width, height = self.pinhole.size
        return (map_x >= 0) & (map_y >= 0) & (map_x <= width - 1) & (map_y <= height - 1)

    def undistort_depth(
        self, depth: NDArray[np.float32], target: PinholeCamera
    ) -> NDArray[np.float32]:
        """`undistort` for depth (H, W) [m], 0 no reading; it never averages across an edge."""
        map_x, map_y = _undistortion(self, target)
        left, top = np.floor(map_x), np.floor(map_y)
        a, b = map_x - left, map_y - top
        u, v = left.astype(np.int32), top.astype(np.int32)
        inside = (u >= 0) & (v >= 0) & (u < depth.shape[1] - 1) & (v < depth.shape[0] - 1)
        at = np.where(inside, v * depth.shape[1] + u, 0)
        corners = [np.take(depth, at + step) for step in (0, 1, depth.shape[1], depth.shape[1] + 1)]
        low, high = np.minimum.reduce(corners), np.maximum.reduce(corners)
        mean = (1 - b) * ((1 - a) * corners[0] + a * corners[1]) + b * (
            (1 - a) * corners[2] + a * corners[3]
        )
        nearest = np.where(
            b < 0.5, np.where(a < 0.5, *corners[:2]), np.where(a < 0.5, *corners[2:])
        )
        smooth = (low > 0) & (high - low <= SAME_SURFACE * low)
        return np.where(inside, np.where(smooth, mean, nearest), np.float32(0))


@lru_cache(maxsize=8)
def _undistortion(
    lens: LensCamera, target: PinholeCamera
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Column and row in the distorted image, both (H, W), of every pixel of `target`; -2 beyond the
    distortion model.
    """
    start = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    map_x, map_y = start(
        lens.pinhole.matrix,
        np.array(lens.distortion),
        np.eye(3),
        target.matrix,
        target.size,
        cv2.CV_32FC1,
    )
    beyond = np.hypot(*cv2.split(camera_rays(target))[:2]) >= lens.max_radius
    map_x[beyond] = map_y[beyond] = -2
    return np.asarray(map_x, np.float32), np.asarray(map_y, np.float32)


@lru_cache(maxsize=4)
def camera_rays(camera: PinholeCamera) -> NDArray[np.float32]:
    """(H, W, 3) rays with z = 1, kept: every frame of a recording asks for them."""
    return camera.rays().astype(np.float32)


def project_depth(
    depth: NDArray[np.float32],
    camera: PinholeCamera,
    target: PinholeCamera,
    T_target_camera: NDArray,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Column, row and depth [m] in `target`, each (H, W), of the readings of `camera`; far outside
    for a point behind it.
    """
    rays = cv2.transform(camera_rays(camera), T_target_camera[:3, :3])
    x, y, z = (
        part * depth + np.float32(step)
        for part, step in zip(cv2.split(rays), T_target_camera[:3, 3], strict=True)
    )
    near = z < 1e-3
    per_depth = 1 / np.where(near, np.float32(1), z)
    columns = np.where(
        near, np.float32(-1e6), np.float32(target.fx) * x * per_depth + np.float32(target.cx)
    )
    rows = np.where(
        near, np.float32(-1e6), np.float32(target.fy) * y * per_depth + np.float32(target.cy)
    )
    return columns, rows, z


def color_for_depth(
    color: NDArray[np.uint8],
    lens: LensCamera,
    depth: NDArray[np.float32],
    camera: PinholeCamera,
    T_color_camera: NDArray,
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Colour (H, W, 3) for every pixel of a depth image, and where (H, W) the colour camera sees
    the point of a reading.

    It does not where the point lies outside its image or behind something nearer. Pixels without a
    reading are coloured as if they had their neighbours', so that the picture is whole.
    """
    columns, rows, seen = places_in(lens, depth, camera, T_color_camera)
    moved = cv2.remap(color, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(moved, np.uint8), seen


def values_for_depth(
    values: NDArray[np.float32],
    lens: LensCamera,
    depth: NDArray[np.float32],
    camera: PinholeCamera,
    T_lens_camera: NDArray,
) -> NDArray[np.float32]:
    """Values (H, W, c) for every reading of a depth image, of an image (h, w, c) of another camera beside
    it; NaN where that does not see the point.
    """
    columns, rows, seen = places_in(lens, depth, camera, T_lens_camera)
    moved = [cv2.remap(each, columns, rows, cv2.INTER_LINEAR) for each in cv2.split(values)]
    return np.where(seen[..., None], np.stack(moved, axis=2), np.float32(np.nan))


def places_in(
    lens: LensCamera, depth: NDArray[np.float32], camera: PinholeCamera, T_lens_camera: NDArray
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Column and row in another camera's image of every pixel of a depth image, and whether that camera
    sees the point of a reading, each (H, W). Pixels without a reading take their neighbours'.
    """
    target = lens.pinhole
    columns, rows, z = project_depth(_filled(depth), camera, target, T_lens_camera)
    width, height = target.size
    # the outermost pixels count as outside: interpolation mixes them with black
    inside = (columns > 0.5) & (rows > 0.5) & (columns < width - 1.5) & (rows < height - 1.5)
    if any(lens.distortion):
        columns, rows = (
            np.asarray(cv2.remap(each, columns, rows, cv2.INTER_LINEAR, borderValue=-2), np.float32)
            for each in _undistortion(lens, target)
        )
        inside &= (columns > 0.5) & (rows > 0.5) & (columns < width - 1.5) & (rows < height - 1.5)
    known = inside & (depth > 0)
    return columns, rows, known & _in_front(columns, rows, z, known, camera, target)


def _in_front(
    columns: NDArray[np.float32],
    rows: NDArray[np.float32],
    z: NDArray[np.float32],
    known: NDArray[np.bool_],
    camera: PinholeCamera,
    target: PinholeCamera,
) -> NDArray[np.bool_]:
    """Which readings (H, W) of `camera` nothing hides from `target`, by a depth buffer: they land at
    these columns and rows with these depths [m]; only `known` ones count and can hide.
    """
    # [pixels of the target] three of them are so wide that there is at least one reading
    cell = np.float32(max(target.fx / camera.fx, 0.5))
    shape = int(target.height / cell) + 1, int(target.width / cell) + 1
    at = np.where(known, rows / cell, 0).astype(np.intp) * shape[1]
    at += np.where(known, columns / cell, 0).astype(np.intp)
    nearest = np.full(shape, np.inf, np.float32)
    # in one dimension, which NumPy does ten times faster
    np.minimum.at(nearest.ravel(), at[known], z[known])
    around = cv2.erode(nearest, np.ones((3, 3)))
    return z / np.float32(1 + HIDDEN) <= np.take(around, at)


def _filled(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth with the nearest pixel's reading where there is none."""
    empty = (depth <= 0).astype(np.uint8)
    if not empty.any() or empty.all():
        return depth
    _, found = cv2.distanceTransformWithLabels(
        empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(found, np.int32)  # of the nearest pixel with a reading
    readings = np.zeros(labels.max() + 1, np.float32)
    readings[labels[empty == 0]] = depth[empty == 0]
    return readings[labels]


def splat_depth(
    depth: NDArray[np.float32],
    values: NDArray[np.float32],
    camera: PinholeCamera,
    target: PinholeCamera,
    T_target_camera: NDArray,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth [m] and values of a camera as another one beside it sees them, the nearest reading of
    each pixel; 0 none.
    """
    columns, rows, z = project_depth(depth, camera, target, T_target_camera)
    columns, rows = np.rint(columns).astype(np.int32), np.rint(rows).astype(np.int32)
    inside = np.flatnonzero(
        (depth > 0)
        & (columns >= 0)
        & (rows >= 0)
        & (columns < target.width)
        & (rows < target.height)
    )
    order = inside[np.argsort(-z.ravel()[inside], kind="stable")]  # the nearest is written last
    at = rows.ravel()[order], columns.ravel()[order]
    moved, moved_values = (np.zeros((target.height, target.width), np.float32) for _ in range(2))
    moved[at], moved_values[at] = z.ravel()[order], values.ravel()[order]
    return moved, moved_values
