"""What of the image is fixed to the camera: a part of the robot, a hand, that never changes while
everything else does.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Frame

FRAMES = 30  # of the beginning in which a fixed part is looked for
STEP = 4  # [px] between compared readings
SAME_DEPTH, SAME_INTENSITY = 4.0, 10 / 255  # [standard deviations of a Kinect]; of [0, 1]
ROUNDING = 0.002  # [m]
NEIGHBORHOOD, MAJORITY = 7, 0.7  # [compared px]; share that must be unchanged
CHANGED = 0.5  # share of the rest that must have changed, in ...
TWICE = 2  # ... so many frames
NEARER = 0.6  # a fixed part is nearer than this share of the rest's median depth ...
LEAST, MOST = 0.01, 0.6  # ... and fills so much of the image


@dataclass
class FixedPart:
    """Looks for a fixed part in the first frames of a recording; `mask` (H, W) once it is found."""

    first: Frame | None = None
    unchanged: NDArray[np.bool_] | None = None  # (h, w) in all frames so far
    moved: int = 0  # frames in which the rest had changed
    count: int = 0  # frames that were looked at
    seen: list[Frame] = field(default_factory=list)  # they, as long as they may be needed again
    mask: NDArray[np.bool_] | None = None

    @property
    def looking(self) -> bool:
        """Whether more frames may still show one."""
        return self.mask is None and self.count < FRAMES

    def look(self, frame: Frame) -> bool:
        """Take the next frame into account; whether it shows the fixed part for the first time."""
        self.seen.append(frame)
        self.count += 1
        found = self._found(frame)
        if not found and not self.looking:
            self.seen.clear()
        return found

    def _found(self, frame: Frame) -> bool:
        if self.first is None or self.first.depth.shape != frame.depth.shape:
            self.first, self.unchanged = frame, None
            return False
        now = _unchanged(self.first, frame)
        self.unchanged = now if self.unchanged is None else self.unchanged & now
        part = self._near_part(frame)
        if part is None:
            return False
        self.moved += 1
        if self.moved < TWICE:
            return False
        size = frame.depth.shape[::-1]
        whole = cv2.resize(part.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        around = np.ones((4 * STEP + 1, 4 * STEP + 1), np.uint8)
        self.mask = np.asarray(cv2.dilate(whole, around) > 0)
        return True

    def _near_part(self, frame: Frame) -> NDArray[np.bool_] | None:
        """The unchanged part, if it is near and all else has changed."""
        depth = frame.depth[::STEP, ::STEP]
        known = np.isfinite(depth) & (depth > 0)
        assert self.unchanged is not None
        share = cv2.boxFilter(self.unchanged.astype(np.float32), -1, (NEIGHBORHOOD, NEIGHBORHOOD))
        still = (share > MAJORITY) & known
        rest = known & ~still
        if not rest.any():
            return None
        part = still & (depth < NEARER * np.median(depth[rest]))
        rest = known & ~part
        if not LEAST < part.mean() < MOST or (rest & ~self.unchanged).sum() < CHANGED * rest.sum():
            return None
        return part


def without(frame: Frame, mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The frame's depth with no reading in the mask; as it is where the sizes differ."""
    if mask.shape != frame.depth.shape:
        return frame.depth
    return np.where(mask, np.float32(0), frame.depth)


def _unchanged(first: Frame, frame: Frame) -> NDArray[np.bool_]:
    """(h, w) where two frames have the same depth and intensity."""
    a, b = (each.depth[::STEP, ::STEP] for each in (first, frame))
    with np.errstate(invalid="ignore", over="ignore"):
        sigma = 0.0012 + 0.0019 * (a - 0.4) ** 2  # Nguyen et al. 2012, Eq. 3
        same = (a > 0) & (b > 0) & (np.abs(a - b) < SAME_DEPTH * sigma + ROUNDING)
    if first.color is not None and frame.color is not None:
        light, dark = (_gray(each) for each in (first.color, frame.color))
        same &= np.abs(light - dark) < SAME_INTENSITY
    return np.asarray(same)


def _gray(color: NDArray[np.uint8]) -> NDArray[np.float32]:
    luma = np.array((0.299, 0.587, 0.114), np.float32) / np.float32(255)  # Rec. 601
    return np.asarray(color[::STEP, ::STEP].astype(np.float32) @ luma, np.float32)
