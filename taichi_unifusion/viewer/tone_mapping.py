"""Colours that the page in the browser draws as they are.

viser draws with the filmic tone mapping of three.js (`ACESFilmicToneMapping`), which changes bright
and strong colours, and cannot be told not to. So vertices get the light that it maps to their colour.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# of three.js, after Stephen Hill: from linear sRGB to where the curve applies, and back
TO_CURVE = np.array(
    [[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]]
)
FROM_CURVE = np.array(
    [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
)
EXPOSURE = 1 / 0.6
LIGHT_OF_CURVE = (np.linalg.inv(TO_CURVE) / EXPOSURE).astype(np.float32)
CURVE_OF_COLOR = np.linalg.inv(FROM_CURVE).astype(np.float32)
# the curve: (x (x + A) - B) / (x (C x + D) + E)
A, B, C, D, E = 0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081


def light_that_shows(light: NDArray) -> NDArray[np.float32]:
    """What is drawn as linear light (N, 3) in [0, 1]: some of it lies below 0, or above 1."""
    wanted = np.asarray(light, np.float32) @ CURVE_OF_COLOR.T
    square, linear, rest = 1 - C * wanted, A - D * wanted, B + E * wanted
    on_curve = (np.sqrt(linear**2 + 4 * square * rest) - linear) / (2 * square)
    return (on_curve @ LIGHT_OF_CURVE.T).astype(np.float32)
