"""Infrared: what an active infrared camera measures, as a data set gives it, brought into [0, 1]
(Sec. V-A.2).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError
from ..rendering.look import Look
from ..types import Frame
from .base import SurfaceProperty

FULL_SCALE = 65535.0  # largest infrared value of a data set
VOXEL_SIZE = 0.02  # [m] as sharp as what is drawn on things
KNEE = 100.0  # units below which the logarithmic curve is nearly linear: about a sensor's noise


def log_infrared() -> SurfaceProperty:
    """Logarithmic brightness, because light falls with the square of the distance: a mug near the
    camera is far brighter than the room.

    The same curve for every frame and recording, so that frames agree and maps can be merged: units
    of 0..65535 are `100 (656.35^value - 1)`.
    """
    scale = 1 / np.log1p(FULL_SCALE / KNEE)

    def function(frame: Frame) -> NDArray:
        return np.log1p(_infrared_of(frame) / KNEE) * scale

    return SurfaceProperty(
        "infrared",
        1,
        function,
        Look("inferno", None, "infrared brightness (logarithmic, 0..1)"),
        voxel_size=VOXEL_SIZE,
    )


def linear_infrared(*, low: float = 0.0, high: float = FULL_SCALE) -> SurfaceProperty:
    """Brightness between `low` and `high`, in units of 0..65535, as [0, 1]; what lies outside is
    clipped.
    """
    if not low < high:
        raise InputError(f"infrared: low must be below high, got {low} and {high}")

    def function(frame: Frame) -> NDArray:
        return np.clip((_infrared_of(frame) - np.float32(low)) / np.float32(high - low), 0, 1)

    return SurfaceProperty(
        "infrared",
        1,
        function,
        Look("inferno", None, f"infrared ({low:g}..{high:g} as 0..1)"),
        voxel_size=VOXEL_SIZE,
    )


def _infrared_of(frame: Frame) -> NDArray[np.float32]:
    """The frame's infrared image (H, W) in units of 0..65535, or FrameError."""
    image = frame.images.get("infrared")
    if image is None:
        raise FrameError(
            "the recording has no infrared image for it (k4a has; folder and scannet in a folder infrared/)"
        )
    return image[..., 0]
