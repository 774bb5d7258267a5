"""Jumps of exposure: the same things, found again by poses and depth or by optical flow, are suddenly
brighter or darker.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ...errors import FrameError
from ...types import Frame
from ..pose_fit import LEAST_TOLERANCE, NEAREST, TOLERANCE, View
from .finding import Finding
from .sampling import Sample

WIDTH = 160  # [pixels] that pictures are compared at
EXPOSURE = 1.25  # factor of brightness between frames
DARK, BRIGHT = 12, 243  # [grey levels] between which a camera's answer is even
RETURNS = 1.0  # [pixels] by which flow there and back may miss
LEAST_FOUND, LEAST_PLACES = 0.1, 60  # share and number of places that must be found again
HALF, FEW = 0.5, 0.02  # of them: what turns white, and what may turn from it at once
MARGIN = 8  # [grey levels] below white
ALIKE = 0.8  # correlation of brightness, of what is found again
EVEN = 0.25  # spread of the logarithm of the factor: exposure changes everything alike
LONGEST_GAP = 16  # frames between two that are compared


def exposure_findings(sample: Sample) -> list[Finding]:
    """Where brightness jumps from one frame to the next."""
    jumps = []
    for k in range(len(sample.frames) - 1):
        first, last = sample.places[k], sample.places[k + 1]
        if last - first > LONGEST_GAP or not _jumps(sample.frames[k], sample.frames[k + 1]):
            continue
        found = _between(sample, k)
        if found is not None:
            jumps.append(found)
    if not jumps:
        return []
    index, factor = jumps[0]
    said = f"at least {factor:.2f}" if factor > 1 else f"at most {factor:.2f}"
    times = f"{len(jumps)} times" if len(jumps) > 1 else "once"
    return [
        Finding(
            "exposure",
            f"brightness jumps between neighbouring frames {times} (first: {said} times as bright at frame "
            f"{index}); colours will be patchy",
            "lock exposure and white balance of the camera; --start and --end leave frames out",
        )
    ]


def _between(sample: Sample, k: int) -> tuple[int, float] | None:
    """The frame at which it jumps between two of the sample, and the factor; None where it changes
    slowly.
    """
    a, b = sample.frames[k], sample.frames[k + 1]
    first, last = sample.places[k], sample.places[k + 1]
    while last - first > 1:
        middle = (first + last) // 2
        try:
            frame = sample.recording[middle]
        except FrameError:
            return None
        if _jumps(a, frame):
            b, last = frame, middle
        elif _jumps(frame, b):
            a, first = frame, middle
        else:
            return None
    return b.index, brightening(a, b) or 1.0


def _jumps(a: Frame, b: Frame) -> bool:
    factor = brightening(a, b) or 1.0
    return max(factor, 1 / factor) > EXPOSURE


def brightening(a: Frame, b: Frame) -> float | None:
    """How many times as bright things are in frame b, at least: what turns white tells no more; None
    where too little is found again, or it does not change alike.
    """
    if a.color is None or b.color is None:
        return None
    for find in (_by_poses, _by_flow):
        found = find(a, b)
        factor = None if found is None else _factor(*found)
        if factor is not None:
            return factor
    return None


def _factor(before: NDArray[np.float32], after: NDArray[np.float32]) -> float | None:
    """The factor between the brightness of the same things."""
    lit = (before > DARK) & (after > DARK) & ((before < BRIGHT) | (after < BRIGHT))
    if lit.sum() < LEAST_PLACES:
        return None
    before, after = before[lit], after[lit]
    logs = np.log(before), np.log(after)
    change = logs[1] - logs[0]
    factor = float(np.exp(np.median(change)))
    whitened = [
        ((x < BRIGHT - MARGIN) & (y >= BRIGHT)).mean()
        for x, y in ((before, after), (after, before))
    ]
    if max(whitened) > HALF and min(whitened) < FEW:
        return (
            max(factor, EXPOSURE + 0.01) if whitened[0] > HALF else min(factor, 1 / EXPOSURE - 0.01)
        )
    even = (before < BRIGHT) & (after < BRIGHT)
    if even.sum() < LEAST_PLACES:
        return None
    low, high = np.percentile(change[even], [25, 75])
    if high - low > EVEN or np.corrcoef(logs[0][even], logs[1][even])[0, 1] < ALIKE:
        return None
    return factor


Brightness = tuple[NDArray[np.float32], NDArray[np.float32]]  # of the same things in two frames


def _by_poses(a: Frame, b: Frame) -> Brightness | None:
    """Brightness at points of frame a, and where frame b sees them at the depth that they have."""
    if a.T_world_camera is None or b.T_world_camera is None:
        return None
    view, other = View(a), View(b)
    T_b_a = np.linalg.inv(b.T_world_camera) @ a.T_world_camera
    points = view.own_points @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    seen = np.dstack([other.depth, _grey(b, blurred=True)])
    there, inside = b.camera.look_up(seen, points, NEAREST * other.median)
    wanted = points[inside, 2]
    same = np.abs(there[:, 0] - wanted) < np.maximum(TOLERANCE * wanted, LEAST_TOLERANCE)
    same &= there[:, 0] > 0
    if same.sum() < max(LEAST_PLACES, LEAST_FOUND * len(points)):
        return None
    before = _grey(a, blurred=True)[np.asarray(view.v, int), np.asarray(view.u, int)]
    return before[inside][same], there[same, 1].astype(np.float32)


def _by_flow(a: Frame, b: Frame) -> Brightness | None:
    """Brightness of pixels of frame a that optical flow finds in frame b, and back."""
    before, after = _small(a), _small(b)
    if before.shape != after.shape or min(before.std(), after.std()) < 1:
        return None
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    even = _evened(before), _evened(after)
    there = flow.calc(*even, None)  # type: ignore[call-overload]
    back = flow.calc(*even[::-1], None)  # type: ignore[call-overload]
    v, u = np.indices(before.shape, np.float32)
    x, y = u + there[..., 0], v + there[..., 1]
    returned = cv2.remap(back, x, y, cv2.INTER_LINEAR, borderValue=(1e3, 1e3))
    found = np.hypot(*np.moveaxis(there + returned, 2, 0)) < RETURNS
    if found.mean() < LEAST_FOUND:
        return None
    seen = np.asarray(cv2.remap(after, x, y, cv2.INTER_LINEAR, borderValue=0), np.float32)
    return before[found], seen[found]


def _grey(frame: Frame, blurred: bool = False) -> NDArray[np.float32]:
    grey = np.asarray(cv2.cvtColor(np.asarray(frame.color), cv2.COLOR_RGB2GRAY), np.float32)
    return np.asarray(cv2.blur(grey, (5, 5)), np.float32) if blurred else grey


def _small(frame: Frame) -> NDArray[np.float32]:
    grey = _grey(frame)
    height = max(16, round(grey.shape[0] * WIDTH / grey.shape[1]))
    small = cv2.resize(grey, (WIDTH, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def _evened(grey: NDArray[np.float32]) -> NDArray[np.uint8]:
    """With the same distribution of brightness, whatever the exposure."""
    return np.asarray(cv2.equalizeHist(grey.astype(np.uint8)), np.uint8)
