"""Frames among each other: a camera that never moves, repeats, time stamps; jumps of exposure."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...types import Frame
from .exposure import exposure_findings
from .finding import Finding
from .sampling import Sample

SAME_PLACE = 1e-3, np.radians(0.1)  # [m], [rad] between poses that count as one
LEAST_FRAMES = 4
CHANGED = 4.0  # [grey levels] mean difference of pictures that show something else
REPEATED_SHARE = 0.05  # of neighbouring frames; fewer are a camera's hiccup
SMALL = (80, 60)  # [pixels] that pictures are compared at


def frame_findings(sample: Sample) -> list[Finding]:
    """Findings on frames as pictures, and on their times."""
    found = [_still(sample), _repeated(sample), *exposure_findings(sample), *_times(sample)]
    return [finding for finding in found if finding is not None]


def _still(sample: Sample) -> Finding | None:
    known = [T for T in sample.poses if T is not None]
    if len(known) < LEAST_FRAMES:
        return None
    places = np.array([T[:3, 3] for T in known])
    chord = np.linalg.norm(np.array([T[:3, :3] for T in known]) - known[0][:3, :3], axis=(1, 2))
    turned = 2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1))
    if np.ptp(places, axis=0).max() > SAME_PLACE[0] or turned.max() > SAME_PLACE[1]:
        return None
    pictures = [_small(frame) for frame in sample.frames]
    first = pictures[0]
    changed = max(float(np.abs(each - first).mean()) for each in pictures)
    if changed < CHANGED:
        return Finding(
            "still",
            f"the camera never moves: all {len(known)} poses are equal, and so are the pictures",
            wrong=False,
        )
    return Finding(
        "still",
        f"all {len(known)} poses are equal, but the pictures change by up to {changed:.0f} grey levels: the poses are "
        "placeholders, or tracking was lost",
        "--tracking rgbd finds poses from the frames alone",
    )


def _small(frame: Frame) -> NDArray[np.float32]:
    """A frame's picture, small and grey; of its depth where it has no colour."""
    if frame.color is not None:
        grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
    else:
        grey = np.clip(frame.depth * 50, 0, 255)
    small = cv2.resize(np.asarray(grey, np.float32), SMALL, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def _repeated(sample: Sample) -> Finding | None:
    pairs = sample.neighbours()
    same = [(a, b) for a, b in pairs if _equal(a, b)]
    if len(same) < max(1, REPEATED_SHARE * len(pairs)) or len(same) == len(pairs) == 1:
        return None
    a, b = same[0]
    return Finding(
        "repeated",
        f"{len(same)} of {len(pairs)} frames are the one before once more, pixel by pixel (first: frame {b.index} is "
        f"frame {a.index})",
        "write every picture once, or take every other frame: --every 2",
    )


def _equal(a: Frame, b: Frame) -> bool:
    colors = a.color is None or b.color is None or np.array_equal(a.color, b.color)
    return bool(colors and np.array_equal(a.depth, b.depth) and (a.depth > 0).any())


def _times(sample: Sample) -> list[Finding]:
    times = sample.times
    known = np.isfinite(times)
    if known.sum() < LEAST_FRAMES or len(times) != len(sample.recording):
        return []
    steps = np.diff(times[known])
    back = np.flatnonzero(steps < 0)
    if not len(back):
        return []
    return [
        Finding(
            "time-stamps",
            f"time stamps go back {len(back)} times (first: by {-steps[back[0]]:.3g} s after frame "
            f"{np.flatnonzero(known)[back[0]]})",
            "sort the frames by time",
        )
    ]
