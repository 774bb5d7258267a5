"""Answers as meshes and pictures: relevance as heat over the grey surface, labels in colours with a
legend.
"""

from __future__ import annotations

import colorsys
import unicodedata
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..rendering.drawing import Viewpoint
from ..rendering.preview import draw_views
from ..types import Mesh, Trajectory
from .questions import UNLABELLED, Segmentation

HEAT = (
    (0.0, (0.46, 0.46, 0.50)),
    (0.35, (0.48, 0.30, 0.42)),
    (0.5, (0.78, 0.26, 0.24)),
    (0.75, (0.96, 0.60, 0.14)),
    (1.0, (1.0, 0.92, 0.35)),
)  # relevance -> RGB: grey where the query is irrelevant, bright where it wins
NOTHING = (0.35, 0.35, 0.35)  # RGB of a vertex without a label
GOLDEN = 0.618033988749895  # step of hue that keeps any number of labels apart
NEAR = 1.0  # [m] a camera nearer than this shows too little of the surroundings
LABEL_CONTRAST = 0.35  # how much of the surface's own light and dark a label's colour keeps
FONT = cv2.FONT_HERSHEY_SIMPLEX
LEGEND_WIDTH, WIDEST_LEGEND = 320, 800  # [pixels]
MARGIN = 14  # [pixels] beside a legend
SWATCHES = 18, 38  # [pixels] a row of the legend may be high


def heat_mesh(mesh: Mesh, relevance: NDArray) -> Mesh:
    """The mesh in colours of the relevance (V,), with its shades of light and dark; the numbers as
    attribute `relevance`.
    """
    levels, colors = np.array([level for level, _ in HEAT]), np.array([color for _, color in HEAT])
    heat = np.stack([np.interp(relevance, levels, colors[:, k]) for k in range(3)], axis=1)
    return _recolored(mesh, heat, 0.6).with_attribute("relevance", relevance)


def _recolored(mesh: Mesh, colors: NDArray, contrast: float) -> Mesh:
    """The mesh in other colours (V, 3), as much lighter and darker as its own were, by `contrast`."""
    shade = np.full((len(colors), 1), 0.5)
    if mesh.attributes.get("color") is not None and mesh.attributes["color"].shape[1] == 3:
        shade = mesh.attributes["color"] @ np.array([[0.299], [0.587], [0.114]])
    shaded = np.clip(colors * (0.95 + contrast * (shade - 0.5)), 0, 1)
    return Mesh(mesh.vertices, mesh.faces, mesh.normals).with_attribute("color", shaded)


def cameras_that_see(
    trajectory: Trajectory | None, point: NDArray, count: int = 3
) -> Trajectory | None:
    """The poses that have a point (3,) world [m] nearest to the middle of their picture, not too
    close.
    """
    if trajectory is None or not len(trajectory):
        return trajectory
    T_camera_world = np.linalg.inv(trajectory.T_world_camera)
    seen = T_camera_world[:, :3, :3] @ point + T_camera_world[:, :3, 3]
    distance = np.linalg.norm(seen, axis=1)
    angle = np.arccos(np.clip(seen[:, 2] / np.maximum(distance, 1e-9), -1, 1))
    best = np.sort(np.argsort(angle + (distance < NEAR), kind="stable")[:count])
    return Trajectory(trajectory.timestamps[best], trajectory.T_world_camera[best])


def label_colors(count: int) -> NDArray[np.float64]:
    """(count, 3) RGB in [0, 1] that differ."""
    return np.array(
        [
            colorsys.hsv_to_rgb(
                (0.02 + i * GOLDEN) % 1, (0.65, 0.4, 0.8)[i % 3], (0.92, 0.8, 0.62)[i // 3 % 3]
            )
            for i in range(count)
        ]
    )


def label_mesh(mesh: Mesh, found: Segmentation, labels: Sequence[int], colors: NDArray) -> Mesh:
    """The mesh in the colours of its names, with attributes `label`, -1 without one, and
    `confidence`.
    """
    known = found.labels != UNLABELLED
    shown = np.where(known[:, None], colors[found.labels], np.array(NOTHING))
    numbers = np.where(known, np.array(labels)[found.labels], UNLABELLED)
    return (
        _recolored(mesh, shown, LABEL_CONTRAST)
        .with_attribute("label", numbers)
        .with_attribute("confidence", found.confidence)
    )


def segmentation_picture(
    mesh: Mesh, found: Segmentation, colors: NDArray, views: Sequence[Viewpoint]
) -> NDArray[np.uint8]:
    """Views of a labelled mesh (H, W, 3) RGB beside the names that occur in it, the commonest
    first.
    """
    picture = draw_views(mesh, views)
    counts = np.bincount(found.labels[found.labels != UNLABELLED], minlength=len(found.names))
    present = [i for i in np.argsort(-counts, kind="stable") if counts[i]]
    names = [drawable(found.names[i]) or f"name {i + 1}" for i in present]
    return np.hstack([picture, _legend(picture.shape[0], names, colors[present])])


def _legend(height: int, names: Sequence[str], colors: NDArray) -> NDArray[np.uint8]:
    """A strip (height, W, 3) RGB of names beside their colours (n, 3), as wide as they need; where there
    are too many, the last row says how many more.
    """
    step = int(np.clip(height // (len(names) + 1), *SWATCHES))
    room, size = height // step - 1, step * 2 // 3
    if len(names) > room:
        names = [*names[: room - 1], f"and {len(names) - room + 1} more"]
        colors = np.vstack([colors[: room - 1], np.ones((1, 3))])
    scale, left = size / 32, 26 + 2 * size
    names = [_shortened(name, scale, WIDEST_LEGEND - left - MARGIN) for name in names]
    widest = max((_width(name, scale) for name in names), default=0)
    legend = np.full((height, max(LEGEND_WIDTH, left + widest + MARGIN), 3), 255, np.uint8)
    for row, (name, color) in enumerate(zip(names, colors, strict=True)):
        top = step // 2 + row * step
        legend[top : top + size, MARGIN : MARGIN + 2 * size] = (255 * color + 0.5).astype(np.uint8)
        at = (left, top + size - size // 6)
        cv2.putText(legend, name, at, FONT, scale, (40, 40, 40), 1, cv2.LINE_AA)
    return legend


def drawable(text: str) -> str:
    """A text in the letters that pictures can have; "" where it has none of these."""
    return unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().strip()


def _shortened(text: str, scale: float, room: int) -> str:
    """A text that is no wider than `room` [pixels]: cut, which three dots say, where it must be."""
    if _width(text, scale) <= room:
        return text
    while text and _width(f"{text}...", scale) > room:
        text = text[:-1]
    return f"{text.rstrip()}..."


def _width(text: str, scale: float) -> int:
    return cv2.getTextSize(text, FONT, scale, 1)[0][0]
