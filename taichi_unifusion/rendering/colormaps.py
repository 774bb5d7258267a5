"""Colour maps in which equal steps of value look like equal steps of colour."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import check_choice

COLORMAPS = {  # name -> OpenCV's number of it; None: made here
    "viridis": cv2.COLORMAP_VIRIDIS,
    "inferno": cv2.COLORMAP_INFERNO,
    "magma": cv2.COLORMAP_MAGMA,
    "plasma": cv2.COLORMAP_PLASMA,
    "cividis": cv2.COLORMAP_CIVIDIS,
    "diverging": None,
    "gray": None,
}
# in L*a*b*: equal in lightness, apart in hue
BLUE, WHITE, RED = (40.0, 10.0, -50.0), (95.0, 0.0, 0.0), (40.0, 60.0, 35.0)


def check_colormap(name: str) -> None:
    """Raise InputError for an unknown colour map."""
    check_choice("colormap", name, COLORMAPS)


@lru_cache
def color_table(name: str) -> NDArray[np.float32]:
    """The colour map as (256, 3) RGB in [0, 1]."""
    steps = np.arange(256, dtype=np.uint8)[:, None]
    if COLORMAPS[name] is not None:
        return np.float32(cv2.applyColorMap(steps, COLORMAPS[name])[:, 0, ::-1] / 255)
    if name == "gray":
        return np.float32(np.repeat(steps, 3, axis=1) / 255)
    lab = np.stack(
        [
            np.interp(steps[:, 0], (0, 127.5, 255), ends)
            for ends in zip(BLUE, WHITE, RED, strict=True)
        ],
        axis=1,
    )
    return np.clip(cv2.cvtColor(np.float32(lab)[None], cv2.COLOR_Lab2RGB)[0], 0, 1)


def colorize(values: NDArray, colormap: str, low: float, high: float) -> NDArray[np.float32]:
    """Colours (N, 3) RGB in [0, 1] of values (N, c): by the colour map for one channel, as RGB for
    three; NaN counts as 0.
    """
    share = np.clip(np.nan_to_num((np.asarray(values, np.float32) - low) / (high - low)), 0, 1)
    if share.shape[1] == 3:
        return share
    place = share[:, 0] * 255
    table = color_table(colormap)
    return np.stack(
        [np.interp(place, np.arange(256), table[:, k]) for k in range(3)], axis=1
    ).astype(np.float32)
