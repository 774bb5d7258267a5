"""Registration that follows what stands still: parts of a frame that contradict a keyframe are left
out.

What moves is found before a frame is aligned, from where its motion so far would take it: after an
alignment that a near thing has dragged along, the far scene hardly contradicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from .pyramid import ReducedFrame, SurfelPyramid
from .registration import Registration, Target, register

STEP = 2  # [px] of the finest level between compared pixels
FAR_OFF = 4.0  # [standard deviations] of depth from which on surfaces are not the same
DIFFERENT = 0.12  # of intensities in [0, 1], beyond what a shift by 1.5 pixels makes
SHIFT = 1.5  # [px]
CLOSE, ALIKE = 2.5, 0.05  # [standard deviations], intensity: within both a pixel shows the same
NEIGHBORHOOD = (
    11  # [compared px] a contradiction counts where it is the majority of so many squared
)
LEAST_SEEN = 0.1  # share of them that must have something to compare with
MARGIN = 2  # [compared px] around what contradicts that is left out too
# Patches of space of which this share contradicts are left out as a whole
WHOLE_FROM, WHOLE_SHARE = 0.03, 0.35
PATCHES, SPARSE = (4, 6), 4  # rows and columns of them; [compared px] between points
LEAST_POINTS = 100  # points of a frame that can be split up
MOST_MOVING = 0.5  # share that contradicts from which on a pose is wrong
SOME_MOVING = 0.1  # share from which on a pose without anything left out is tried too ...
SURELY_MORE = 0.35  # ... and taken where that much more of the frame is the same by it
CHANGED = 0.04  # share of the image by which what moves must change to align once more


@dataclass(frozen=True, eq=False)
class Comparison:
    """Where a frame agrees with another at some pose."""

    moving: NDArray[np.uint8]  # (h, w) 1: part of what contradicts
    contradicted: float  # share of what can be compared that contradicts
    same: float  # share of it with the same depth and intensity


def compare(source: SurfelPyramid, target: SurfelPyramid, T_target_source: NDArray) -> Comparison:
    """Compare the surfaces and intensities of two frames at a pose."""
    from ..kernels import registration as kernels

    a, b = source.levels[0], target.levels[0]
    height, width = (-(-n // STEP) for n in (a.camera.height, a.camera.width))
    found = np.empty((height, width, kernels.COMPARED), np.float32)
    kernels.compare_surfels(
        a.surfels,
        b.surfels,
        a.camera.intrinsics,
        b.camera.intrinsics,
        T_target_source[:3],
        STEP,
        found,
    )
    front, darker, slope = (found[..., k] for k in range(kernels.COMPARED))
    seen = front < kernels.UNSEEN
    behind, other = seen & (front <= -FAR_OFF), seen & (front >= FAR_OFF)
    same = seen & (np.abs(front) < CLOSE)
    if source.colored and target.colored and same.any():
        difference = np.abs(darker - np.median(darker[same]))  # but for a change of exposure
        same &= difference < ALIKE
        other |= seen & ~behind & (difference > DIFFERENT + SHIFT * slope)
    share = _mean_around(other | behind) > 0.5 * _mean_around(seen)
    moving = share & (_mean_around(seen) > LEAST_SEEN)
    count = max(1, int(seen.sum()))
    # what comes into view behind a surface says nothing of who has moved
    contradicted = float((moving & seen & ~behind).sum() / count)
    if contradicted > WHOLE_FROM:
        moving |= _whole_patches(moving, seen, source)
    around = np.ones((2 * MARGIN + 1, 2 * MARGIN + 1), np.uint8)
    wide = cv2.dilate(moving.astype(np.uint8), around)
    return Comparison(np.asarray(wide, np.uint8), contradicted, float(same.sum() / count))


def leave_out(pyramid: SurfelPyramid, moving: NDArray[np.uint8]) -> None:
    """Leave out the pixels of a mask, of any size, and take all others in again."""
    from ..kernels import registration as kernels

    some = bool(moving.any())
    if some or pyramid.left_out:
        for level in pyramid.levels:
            kernels.leave_out(moving, level.surfels)
    pyramid.left_out = some


def without_left_out(reduced: ReducedFrame, pyramid: SurfelPyramid) -> ReducedFrame:
    """The images from which that pyramid can be built again."""
    if not pyramid.left_out:
        return reduced
    left_out = pyramid.levels[0].read(1, 1)[..., 0] < 0
    if not left_out.any():
        return reduced
    return replace(reduced, inverse=np.where(left_out, np.float32(0), reduced.inverse))


def register_static(
    source: SurfelPyramid,
    targets: Sequence[Target],
    T_reference_source: NDArray,
    photometric_weight: float,
    *,
    expected: bool,
) -> tuple[Registration, Comparison]:
    """As `register`, of the part that stands still, compared with the last target, which is the
    reference; the source is left without what moves. `expected`: the guess follows a motion that
    was observed, so that what contradicts it is likelier to move than all the rest.
    """
    target = targets[-1].pyramid

    def align(moving: NDArray[np.uint8], guess: NDArray) -> tuple[Registration, Comparison]:
        leave_out(source, moving)
        found = register(source, targets, guess, photometric_weight)
        return found, compare(source, target, found.T_target_source)

    before = compare(source, target, T_reference_source)
    nothing = np.zeros_like(before.moving)
    moving = before.moving if before.contradicted < MOST_MOVING else nothing
    found, after = align(moving, T_reference_source)
    if moving.any() and after.contradicted > SOME_MOVING:
        whole, with_all = align(nothing, T_reference_source)
        if with_all.same > after.same + (SURELY_MORE if expected else 0.0):
            moving, found, after = nothing, whole, with_all
        else:
            leave_out(source, moving)
    if (after.moving != moving).mean() > CHANGED:
        found, after = align(after.moving, found.T_target_source)
    return found, after


def _mean_around(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    size = NEIGHBORHOOD, NEIGHBORHOOD
    return np.asarray(cv2.boxFilter(mask.astype(np.float32), -1, size), np.float32)


def _whole_patches(
    moving: NDArray[np.bool_], seen: NDArray[np.bool_], source: SurfelPyramid
) -> NDArray[np.bool_]:
    """Patches of neighbouring points (k-means in space) of which much is `moving`: the inside of a
    smooth thing that moves contradicts nothing.
    """
    image = source.levels[0]
    apart = STEP * SPARSE
    depth = np.abs(image.read(apart, 1)[..., 0])
    (height, width), known = depth.shape, depth > 0
    if known.sum() < LEAST_POINTS:
        return np.zeros_like(moving)
    v, u = np.mgrid[:height, :width]
    points = (image.camera.rays(u * apart, v * apart) * depth[..., None]).astype(np.float32)
    rows, columns = PATCHES
    start = (v * rows // height * columns + u * columns // width)[known]
    names, labels = np.unique(start, return_inverse=True)
    once = cv2.TERM_CRITERIA_MAX_ITER, 8, 0.0
    labels = np.ascontiguousarray(labels.reshape(-1, 1), np.int32)
    _, labels, _ = cv2.kmeans(
        points[known], len(names), labels, once, 1, cv2.KMEANS_USE_INITIAL_LABELS
    )
    labels = np.ravel(labels).astype(np.int64)
    sparse = (slice(None, None, SPARSE),) * 2
    compared, contradicts = seen[sparse][known], (seen & moving)[sparse][known]
    total = np.bincount(labels[compared], minlength=len(names))
    share = np.bincount(labels[contradicts], minlength=len(names)) / np.maximum(total, SPARSE)
    mask = np.zeros(depth.shape, np.uint8)
    mask[known] = (share > WHOLE_SHARE)[labels]
    filled = cv2.resize(mask, moving.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(filled > 0)
