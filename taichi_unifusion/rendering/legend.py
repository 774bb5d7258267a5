"""Meshes and pictures of a property: values as colours, and a legend that says which is which."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Mesh
from .look import Look, color_table, colorize, shown_range

HEIGHT = 88  # pixels of a legend
INK, PAPER = (40, 40, 40), 255


def property_mesh(mesh: Mesh, name: str, look: Look) -> Mesh:
    """The mesh with attribute `name`, the values, and its colours for "color"; others are left out.

    Values of two, or of more than three channels have no colours.
    """
    values = mesh.attributes[name]
    attributes: Mapping[str, NDArray] = {name: values}
    if values.shape[1] in (1, 3):
        attributes = {
            "color": colorize(values, look.colormap, *shown_range(values, look)),
            **attributes,
        }
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, attributes)


def draw_legend(
    width: int, name: str, look: Look, low: float, high: float, channels: int
) -> NDArray[np.uint8]:
    """A strip (HEIGHT, width, 3) RGB: a bar of the colours with the values at its ends and between,
    and what they are.
    """
    strip = np.full((HEIGHT, width, 3), PAPER, np.uint8)
    title = look.label or name
    left, right = int(0.25 * width), int(0.75 * width)
    if channels == 3:
        _write(
            strip,
            f"{title}: red, green and blue from {low:g} to {high:g}",
            width // 2,
            HEIGHT // 2 + 6,
        )
        return strip
    table = color_table(look.colormap)
    bar = table[np.linspace(0, 255, right - left).round().astype(int)]
    strip[38:56, left:right] = (255 * bar + 0.5).astype(np.uint8)
    _write(strip, title, width // 2, 26)
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        x = left + round(share * (right - left - 1))
        strip[56:61, max(x - 1, 0) : x + 1] = INK
        _write(strip, f"{low + share * (high - low):.3g}", x, 78)
    return strip


def _write(strip: NDArray[np.uint8], text: str, center: int, baseline: int) -> None:
    (length, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
    cv2.putText(
        strip,
        text,
        (max(center - length // 2, 2), baseline),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.55,
        INK,
        1,
        cv2.LINE_AA,
    )
