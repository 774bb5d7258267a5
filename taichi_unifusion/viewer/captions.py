"""What stands on a picture of a scene: the legend of its layer, boxes and labels of what was found."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import PinholeCamera
from .scene import Box, Label, Legend

INK, PAPER = (40, 40, 40), 255
VEIL = 0.82  # how much of the paper hides what lies behind a legend
FONT = cv2.FONT_HERSHEY_SIMPLEX
MOST_NAMES = 16  # of a legend of classes
NEAR = 0.05  # [m] nothing nearer is marked
EDGES = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]  # of a box


def add_legend(picture: NDArray[np.uint8], legend: Legend) -> NDArray[np.uint8]:
    """The picture (H, W, 3) RGB with a legend at its lower left."""
    rows, columns = picture.shape[:2]  # all is sized for 1080 rows; below 0.5 decimal points vanish
    unit = max(rows / 1080, min(0.5, columns / 640), 0.35)
    strip = _classes(legend, unit) if legend.names else _scale(legend, unit)
    height, width = (min(a, b) for a, b in zip(strip.shape[:2], picture.shape[:2], strict=True))
    edge = min(round(24 * unit), picture.shape[0] - height, picture.shape[1] - width)
    place = picture[picture.shape[0] - edge - height :][:height, edge : edge + width]
    shown = picture.copy()
    veiled = VEIL * strip[:height, :width] + (1 - VEIL) * place
    shown[picture.shape[0] - edge - height :][:height, edge : edge + width] = veiled.astype(
        np.uint8
    )
    return shown


def add_marks(
    picture: NDArray[np.uint8],
    camera: PinholeCamera,
    T_world_camera: NDArray,
    boxes: Sequence[Box],
    labels: Sequence[Label],
) -> NDArray[np.uint8]:
    """The picture (H, W, 3) RGB with boxes and labels as `camera` sees them, through everything."""
    unit = max(picture.shape[0] / 1080, 0.35)
    shown, T_camera_world = picture.copy(), np.linalg.inv(T_world_camera)
    for box in boxes:
        corners = np.array([[box.corners[k >> d & 1][d] for d in range(3)] for k in range(8)])
        corners = corners @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        for i, j in EDGES:
            line = _clipped(corners[i], corners[j])
            if line is not None:
                a, b = (camera.project(line) * 16).round().clip(-(2**26), 2**26).astype(int)
                width = max(1, round(2.5 * unit))
                cv2.line(shown, tuple(a), tuple(b), box.color, width, cv2.LINE_AA, shift=4)
    for label in labels:
        point = T_camera_world[:3, :3] @ label.position + T_camera_world[:3, 3]
        if point[2] > NEAR:
            u, v = camera.project(point)
            if 0 <= u < camera.width and 0 <= v < camera.height:
                place = round(float(u)), round(float(v))
                for ink, width in (((255, 255, 255), 5), (INK, 2)):
                    cv2.putText(
                        shown, label.text, place, FONT, 0.8 * unit, ink,
                        max(1, round(width * unit)), cv2.LINE_AA,
                    )  # fmt: skip
    return shown


def _clipped(a: NDArray, b: NDArray) -> NDArray[np.float64] | None:
    """The part (2, 3) of a line that lies in front of a camera, None where there is none."""
    if max(a[2], b[2]) <= NEAR:
        return None
    ends = [a, b]
    for k in (0, 1):
        if ends[k][2] < NEAR:
            near, far = ends[k], ends[1 - k]
            ends[k] = near + (NEAR - near[2]) / (far[2] - near[2]) * (far - near)
    return np.stack(ends)


def numbers_of(legend: Legend) -> tuple[str, str, str]:
    """The values at the ends and in the middle of a legend, to three digits of its range."""
    low, high = legend.low, legend.high
    digits = max(0, 2 - math.floor(math.log10(max(high - low, 1e-9))))
    values = (round(value, digits) + 0.0 for value in (low, (low + high) / 2, high))
    low_text, middle_text, high_text = (f"{value:.{digits}f}" for value in values)
    return low_text, middle_text, high_text


def _scale(legend: Legend, unit: float) -> NDArray[np.uint8]:
    """A bar of colours with numbers below it, or a sentence where there is none."""
    width, height = round(420 * unit), round(104 * unit)
    low, middle, high = numbers_of(legend)
    text = f"{legend.label} from {low} to {high}"
    if not len(legend.colors):
        (length, _), _ = cv2.getTextSize(text, FONT, 0.6 * unit, 1)
        strip = np.full((round(48 * unit), length + round(32 * unit), 3), PAPER, np.uint8)
        return _written(strip, text, round(16 * unit), round(31 * unit), unit)
    (length, _), _ = cv2.getTextSize(legend.label, FONT, 0.6 * unit, 1)
    width = max(width, length + round(48 * unit))
    strip = np.full((height, width, 3), PAPER, np.uint8)
    left, right = round(24 * unit), width - round(24 * unit)
    strip[round(40 * unit) : round(62 * unit), left:right] = legend.colors[
        np.linspace(0, len(legend.colors) - 1, right - left).round().astype(int)
    ]
    strip = _written(strip, legend.label, left, round(27 * unit), unit)
    for share, number in ((0.0, low), (0.5, middle), (1.0, high)):
        (length, _), _ = cv2.getTextSize(number, FONT, 0.6 * unit, 1)
        x = round(left + share * (right - left) - share * length)
        strip = _written(strip, number, x, round(88 * unit), unit)
    return strip


def _classes(legend: Legend, unit: float) -> NDArray[np.uint8]:
    """Names beside their colours, the first ones if they are many."""
    names = [name[:28] for name in legend.names[:MOST_NAMES]]
    if len(legend.names) > MOST_NAMES:
        names[-1] = f"and {len(legend.names) - MOST_NAMES + 1} more"
    row = round(34 * unit)
    widest = max(cv2.getTextSize(name, FONT, 0.6 * unit, 1)[0][0] for name in names)
    strip = np.full(
        (row * len(names) + round(16 * unit), widest + round(76 * unit), 3), PAPER, np.uint8
    )
    for i, name in enumerate(names):
        top = round(8 * unit) + i * row
        if i < MOST_NAMES - 1 or len(legend.names) <= MOST_NAMES:
            swatch = slice(top + round(7 * unit), top + round(27 * unit))
            strip[swatch, round(16 * unit) : round(44 * unit)] = legend.colors[i]
        strip = _written(strip, name, round(58 * unit), top + round(23 * unit), unit)
    return strip


def _written(
    strip: NDArray[np.uint8], text: str, left: int, baseline: int, unit: float
) -> NDArray[np.uint8]:
    cv2.putText(
        strip, text, (left, baseline), FONT, 0.6 * unit, INK, max(1, round(unit)), cv2.LINE_AA
    )
    return strip
