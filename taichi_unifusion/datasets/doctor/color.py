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
NEAR = 2  # [pixels of it] that the edges of any sensor may be off
JUMP = 0.08  # relative, of depth at an edge
LEAST_EDGES = 150  # pixels, of all frames together
LEAST_SIDE = 40  # of these that face one way, for them to count
MOST_FRAMES = 10
CLEARLY, NOISE = (
    0.06,
    5.0,
)  # rank by which colour must change more, shifted; and over the root of their number
MOST = 0.7  # of the frames must say so


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

    Edges that face left, right, up and down count alike: colour that is beside depth is so at all of
    them, while the front of a table has an edge of colour some pixels above that of its depth.
    """
    step = max(1, len(frames) // MOST_FRAMES)
    told = [scores for frame in frames[::step] if (scores := edge_scores(frame)) is not None]
    if not told:
        return None
    counts = np.sum([count for count, _ in told], axis=0)
    kept = counts >= LEAST_SIDE
    if counts.sum() < LEAST_EDGES or not kept.any():
        return None
    sides = np.sum([total for _, total in told], axis=0)[kept] / counts[kept, None, None]
    mean = sides.mean(axis=0)
    v, u = np.unravel_index(int(mean.argmax()), mean.shape)
    if np.hypot(u - REACH, v - REACH) <= NEAR:
        return None
    if max(abs(u - REACH), abs(v - REACH)) == REACH:  # still rising where the search ends: no peak
        return None
    near = slice(REACH - NEAR, REACH + NEAR + 1)
    gain = mean[v, u] - mean[near, near].max()
    frames_gain = [(total[:, v, u] - total[:, REACH, REACH]).sum() > 0 for _, total in told]
    if gain < max(CLEARLY, NOISE / np.sqrt(counts.sum())) or np.mean(frames_gain) < MOST:
        return None
    return float(u - REACH), float(v - REACH)


def edge_scores(frame: Frame) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Where depth jumps, the number of pixels (4,) in front of the jump to their right, left, below and
    above, and for every shift (4, 2 REACH + 1, 2 REACH + 1), down and right, how much colour changes
    there relative to its mean change, summed; None without colour, or if all is of one.
    """
    if frame.color is None or np.ptp(frame.color) == 0:
        return None
    height = max(1, round(frame.camera.height * WIDTH / frame.camera.width))
    depth = cv2.resize(
        np.where(is_reading(frame.depth), frame.depth, 0).astype(np.float32),
        (WIDTH, height),
        interpolation=cv2.INTER_NEAREST,
    )
    color = cv2.resize(frame.color, (WIDTH, height), interpolation=cv2.INTER_AREA)
    change = _color_change(np.asarray(color, np.uint8))
    counts, totals = [], []
    spectrum, steps = np.fft.rfft2(change), np.arange(-REACH, REACH + 1)
    for edges in _depth_edges(np.asarray(depth, np.float32)):
        edges[:REACH] = edges[-REACH:] = edges[:, :REACH] = edges[:, -REACH:] = False
        counts.append(int(edges.sum()))
        summed = np.fft.irfft2(np.conj(np.fft.rfft2(edges)) * spectrum, change.shape)
        totals.append(summed[np.ix_(steps, steps)])
    return np.array(counts), np.array(totals, np.float64)


def _depth_edges(depth: NDArray[np.float32]) -> list[NDArray[np.bool_]]:
    """Pixels in front of a jump of depth to their right, left, below and above."""
    found = []
    for axis in (1, 0):
        near, far = depth, np.roll(depth, -2, axis)
        both = (near > 0) & (far > 0)
        found += [
            both & (far > near * (1 + JUMP)),
            np.roll(both & (near > far * (1 + JUMP)), 2, axis),
        ]
    return found


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
