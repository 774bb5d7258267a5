"""Does colour fit depth? Where depth jumps, colour changes too, at the same pixel if it does."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...types import Frame
from ..plausibility import is_reading
from .finding import Finding
from .sampling import Sample

WIDTH = 320  # [pixels] that frames are shrunk to
REACH = 14  # [pixels of it] that colour may be off, in each direction
JUMP = 0.08  # relative, of depth at an edge
LEAST_EDGES = 150  # pixels of a frame
LEAST_FRAMES, MOST_FRAMES = 2, 10
LEAST_SHIFT = 2.0  # [pixels of WIDTH]
CLEARLY = 0.12  # rank by which colour must change more at the edges, shifted
MOST = 0.7  # of the frames must say so
STANDS_OUT = 0.15  # rank by which the best shift is ahead of the usual


def color_findings(sample: Sample) -> list[Finding]:
    """Whether colour lies beside depth, and by how much."""
    frames = [frame for frame in sample.frames if frame.color is not None]
    found = find_shift(frames)
    if found is None:
        return []
    (right, down), scale = found, frames[0].camera.width / WIDTH
    return [
        Finding(
            "color",
            f"colour is not registered to depth: edges of both lie {np.hypot(right, down) * scale:.0f} pixels apart "
            f"(colour {_said(right * scale, 'to the right', 'to the left')}, {_said(down * scale, 'down', 'up')})",
            "--color-camera auto, the default, finds the colour camera from posed frames; FILE or kinect gives it",
        )
    ]


def _said(pixels: float, positive: str, negative: str) -> str:
    return f"{abs(pixels):.0f} {positive if pixels >= 0 else negative}"


def find_shift(frames: Sequence[Frame]) -> tuple[float, float] | None:
    """How far colour lies right of and below depth [pixels of WIDTH]; None where it fits, or edges do
    not tell.
    """
    step = max(1, len(frames) // MOST_FRAMES)
    scores = [score for frame in frames[::step] if (score := edge_scores(frame)) is not None]
    if len(scores) < LEAST_FRAMES:
        return None
    mean = np.mean(scores, axis=0)
    v, u = np.unravel_index(int(mean.argmax()), mean.shape)
    shift = float(u - REACH), float(v - REACH)
    if np.hypot(*shift) < LEAST_SHIFT:
        return None
    here = np.array([s[REACH, REACH] for s in scores])
    there = np.array([s[v, u] for s in scores])
    stands_out = mean.max() - np.median(mean)
    gain = there - here
    if gain.mean() < CLEARLY or (gain > 0).mean() < MOST or stands_out < STANDS_OUT:
        return None
    return shift


def edge_scores(frame: Frame) -> NDArray[np.float64] | None:
    """For every shift (2 REACH + 1, 2 REACH + 1), down and right, how much colour changes where depth
    jumps, relative to its mean change; None where depth has too few edges.
    """
    if frame.color is None:
        return None
    height = max(1, round(frame.camera.height * WIDTH / frame.camera.width))
    depth = cv2.resize(
        np.where(is_reading(frame.depth), frame.depth, 0).astype(np.float32),
        (WIDTH, height),
        interpolation=cv2.INTER_NEAREST,
    )
    color = cv2.resize(frame.color, (WIDTH, height), interpolation=cv2.INTER_AREA)
    edges = _depth_edges(np.asarray(depth, np.float32))
    if edges.sum() < LEAST_EDGES:
        return None
    change = _color_change(np.asarray(color, np.uint8))
    v, u = np.nonzero(edges)
    inside = (v >= REACH) & (v < height - REACH) & (u >= REACH) & (u < WIDTH - REACH)
    v, u = v[inside], u[inside]
    if len(v) < LEAST_EDGES:
        return None
    steps = range(-REACH, REACH + 1)
    return np.array([[change[v + dv, u + du].mean() for du in steps] for dv in steps])


def _depth_edges(depth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels in front of a jump of depth."""
    edges = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        near, far = depth, np.roll(depth, -2, axis)
        both = (near > 0) & (far > 0)
        edges |= both & (far > near * (1 + JUMP))
        edges |= np.roll((near > far * (1 + JUMP)) & both, 2, axis)
    edges[:2] = edges[-2:] = edges[:, :2] = edges[:, -2:] = False
    return edges


def _color_change(color: NDArray[np.uint8]) -> NDArray[np.float32]:
    """How much colour changes at a pixel, as a rank in [-1, 1] among all pixels: strong edges of
    texture count no more than others.
    """
    smooth = cv2.GaussianBlur(color.astype(np.float32), (0, 0), 1.0)
    change = sum(
        cv2.Sobel(smooth[..., k], cv2.CV_32F, 1, 0) ** 2
        + cv2.Sobel(smooth[..., k], cv2.CV_32F, 0, 1) ** 2
        for k in range(3)
    )
    order = np.argsort(np.argsort(np.asarray(change).ravel()))
    return (2 * order / max(1, order.size - 1) - 1).reshape(color.shape[:2]).astype(np.float32)
