"""How values become colours: colour maps in which equal steps of value look like equal steps of
colour, and the range of values that they cover.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, check_choice

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
# percentiles of the values at the ends of the colour map, if a property states no range
MOST = (1.0, 99.0)


@dataclass(frozen=True)
class Look:
    """How values become colours."""

    colormap: str = "viridis"  # one of COLORMAPS; ignored for three channels, which are RGB
    # values at its two ends; None: the percentiles MOST of a mesh
    range: tuple[float, float] | None = (0.0, 1.0)
    label: str = ""  # name and unit of the values, for the legend

    def __post_init__(self) -> None:
        check_choice("colormap", self.colormap, COLORMAPS)
        if self.range is not None and not self.range[0] < self.range[1]:
            raise InputError(f"range: must rise, got {self.range}")


@lru_cache
def color_table(name: str) -> NDArray[np.float32]:
    """The colour map as (256, 3) RGB in [0, 1]."""
    steps = np.arange(256, dtype=np.uint8)[:, None]
    number = COLORMAPS[name]
    if number is not None:
        return (cv2.applyColorMap(steps, number)[:, 0, ::-1] / 255).astype(np.float32)
    if name == "gray":
        return (np.repeat(steps, 3, axis=1) / 255).astype(np.float32)
    lab = np.stack(
        [
            np.interp(steps[:, 0], (0, 127.5, 255), ends)
            for ends in zip(BLUE, WHITE, RED, strict=True)
        ],
        axis=1,
    )
    return np.clip(cv2.cvtColor(lab.astype(np.float32)[None], cv2.COLOR_Lab2RGB)[0], 0, 1)


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


def shown_range(values: NDArray, look: Look) -> tuple[float, float]:
    """The values (N, c) at the two ends of the colour map; around 0 for the diverging one."""
    if look.range is not None:
        return look.range
    finite = values[np.isfinite(values)]
    low, high = (float(end) for end in np.percentile(finite, MOST)) if len(finite) else (0.0, 1.0)
    if look.colormap == "diverging":
        low, high = -max(abs(low), abs(high)), max(abs(low), abs(high))
    return (low, high) if high - low > 1e-6 * max(abs(low), abs(high)) else (low - 0.5, low + 0.5)
