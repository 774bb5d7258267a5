"""Pictures of a reconstruction beside what it should look like: whole frames, and the regions where
depth is worst.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from quality_methods import Reconstruction
from quality_scenes import DEPTH_RANGE, Scene

from taichi_unifusion.evaluation.rendering import render_frame
from taichi_unifusion.rendering.raycaster import RayCaster
from taichi_unifusion.types import Frame

SCALE = 0.10  # [m] error that is drawn brightest
MISSING = (255, 0, 255)  # BGR where there is a reading and no surface
NO_TRUTH = (60, 60, 60)  # BGR where there is nothing to compare with
WINDOW = (120, 160)  # pixels of a region
REGIONS = 8
OVERVIEW = 3  # frames in the overview of a scene
QUALITY = 82  # of JPEG


@dataclass(frozen=True)
class Comparison:
    """One held-out frame, BGR: what was seen, what the reconstruction shows, and its error."""

    index: int
    taken: NDArray[np.uint8]  # (H, W, 3)
    rendered: NDArray[np.uint8]  # (H, W, 3)
    drawn_error: NDArray[np.uint8]  # (H, W, 3) black 0, yellow SCALE and more
    error: NDArray[np.float32]  # (H, W) [m], at most SCALE; SCALE where surface is missing


def compare(reconstruction: Reconstruction, frames: Iterable[Frame]) -> list[Comparison]:
    """These frames beside what the reconstruction shows from the same poses."""
    caster = RayCaster(reconstruction.mesh, "reconstruction")
    return [_compare_frame(caster, reconstruction, frame) for frame in frames]


def overview_frames(scene: Scene, count: int = OVERVIEW) -> list[Frame]:
    """Some held-out frames, evenly over the scene."""
    return [
        scene.held_out[i]
        for i in np.linspace(0, len(scene.held_out) - 1, count + 2).round().astype(int)[1:-1]
    ]


def _compare_frame(caster: RayCaster, reconstruction: Reconstruction, frame: Frame) -> Comparison:
    image = render_frame(caster, frame, reconstruction.color)
    read = (frame.depth >= DEPTH_RANGE[0]) & (frame.depth <= DEPTH_RANGE[1])
    missing = read & ~np.isfinite(image.depth)
    error = np.where(
        read, np.minimum(np.abs(np.where(missing, np.inf, image.depth) - frame.depth), SCALE), 0
    )
    drawn = cv2.applyColorMap(np.round(255 * error / SCALE).astype(np.uint8), cv2.COLORMAP_INFERNO)
    drawn[missing], drawn[~read] = MISSING, NO_TRUTH
    rendered = np.round(255 * image.color[..., ::-1]).astype(np.uint8)
    return Comparison(
        frame.index,
        np.ascontiguousarray(frame.color[..., ::-1]),
        rendered,
        drawn,
        error.astype(np.float32),
    )


def write_worst(path: Path, comparisons: list[Comparison]) -> None:
    """The REGIONS windows with the largest mean error, no two of them overlapping: taken, rendered,
    error; worst first.
    """
    rows = [
        np.hstack(
            [
                part[y : y + WINDOW[0], x : x + WINDOW[1]]
                for part in (c.taken, c.rendered, c.drawn_error)
            ]
        )
        for c, y, x in worst_windows(comparisons)
    ]
    half = -(-len(rows) // 2)
    gap = np.full((rows[0].shape[0], 6, 3), 255, np.uint8)
    blank = np.full_like(rows[0], 255)
    sheet = np.vstack(
        [
            np.hstack([rows[i], gap, rows[i + half] if i + half < len(rows) else blank])
            for i in range(half)
        ]
    )
    cv2.imwrite(str(path), sheet, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def worst_windows(comparisons: list[Comparison]) -> list[tuple[Comparison, int, int]]:
    """(frame, row, column) of windows: the worst of each frame, the worst of all frames first."""
    found = []
    for c in comparisons:
        mean = cv2.blur(c.error, WINDOW[::-1], anchor=(0, 0))[: 1 - WINDOW[0], : 1 - WINDOW[1]]
        y, x = np.unravel_index(int(mean.argmax()), mean.shape)
        found.append((float(mean[y, x]), c, int(y), int(x)))
    found.sort(key=lambda row: -row[0])
    return [row[1:] for row in found[:REGIONS]]


def write_overview(path: Path, named: dict[str, list[Comparison]]) -> None:
    """The same frames by several methods: what was taken, then each method's colour above its depth
    error.
    """
    rows = []
    for i, taken in enumerate(c.taken for c in next(iter(named.values()))):
        cells = [np.vstack([taken, np.full_like(taken, 255)])]
        cells += [
            np.vstack([_titled(method[i].rendered, name), method[i].drawn_error])
            for name, method in named.items()
        ]
        rows.append(
            np.hstack(
                [
                    cv2.resize(cell, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
                    for cell in cells
                ]
            )
        )
    cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def _titled(image: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    return cv2.putText(
        image.copy(), text, (10, 36), cv2.FONT_HERSHEY_SIMPLEX, 1.2, (0, 0, 255), 2, cv2.LINE_AA
    )
