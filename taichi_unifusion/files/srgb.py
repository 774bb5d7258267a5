"""sRGB as images hold it, and linear light as glTF and USD want vertex colours (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

TOE, SLOPE = 0.04045, 12.92  # below TOE sRGB is linear
SCALE, OFFSET, GAMMA = 1.055, 0.055, 2.4


def srgb_to_linear(color: NDArray) -> NDArray[np.float32]:
    """Colours in [0, 1], of any shape, as linear light in [0, 1]."""
    color = np.asarray(color, np.float64)
    curve = ((np.maximum(color, TOE) + OFFSET) / SCALE) ** GAMMA
    return np.where(color <= TOE, color / SLOPE, curve).astype(np.float32)


def linear_to_srgb(light: NDArray) -> NDArray[np.float32]:
    """Linear light in [0, 1], of any shape, as colours in [0, 1]."""
    light = np.asarray(light, np.float64)
    curve = SCALE * np.maximum(light, TOE / SLOPE) ** (1 / GAMMA) - OFFSET
    return np.where(light <= TOE / SLOPE, light * SLOPE, curve).astype(np.float32)


# of bytes: a table is fifty times as fast as the power
LINEAR_OF_BYTE = srgb_to_linear(np.arange(256) / 255)
