"""Temporal flicker of styles: how much a surface point changes from view to view, in a style's own
images and in the map.

Every second frame is mapped; the others are looked at. A view's style image, and the map's
rendering at its pose, are compared with those of the next such view at the same surface points,
which exact depth gives: the warping error of video stylisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import taichi_unifusion as uf
from taichi_unifusion.datasets.scene import SceneDataset
from taichi_unifusion.evaluation.rendering import render_frame
from taichi_unifusion.properties import make_property
from taichi_unifusion.rendering.raycaster import RayCaster

SAME_SURFACE = 0.01  # relative difference of depth up to which two pixels see the same point
GAIN = 4  # by which changes are drawn brighter
CELL = (288, 216)  # pixels of a picture in the sheet
PAPER = np.float32(0.85)  # where there is nothing
QUALITY = 80  # of JPEG


@dataclass(frozen=True)
class HeldOut:
    """A frame that was not mapped, its exact depth, and by name ("color" and styles) its images and
    the map's renderings.
    """

    frame: uf.Frame
    depth: NDArray[np.float32]  # (H, W) [m]
    styles: dict[str, NDArray[np.float32]]  # (H, W, 3)
    rendered: dict[str, NDArray[np.float32]]
    covered: NDArray[np.bool_]  # (H, W) where the map has surface


def look(
    recording: SceneDataset, count: int, styles: Sequence[str], voxel_size: float
) -> list[HeldOut]:
    """Map every second of the first `count` frames of a recording, and render the others."""
    properties = [
        make_property(f"style={style},name={style},voxel_size={voxel_size}") for style in styles
    ]
    pipeline = uf.Pipeline(uf.Config(), properties=properties)
    run = pipeline.run(recording[:count:2])
    if run.failure:
        raise run.failure
    caster, found = RayCaster(pipeline.extract_mesh()), []
    for i in range(1, count, 2):
        frame = recording[i]
        views = {
            name: render_frame(caster, frame, pipeline.properties[name].query)
            for name in ("color", *styles)
        }
        made = {each.name: each.image(frame) for each in properties}
        found.append(
            HeldOut(
                frame,
                recording.exact_depth(i),
                {"color": frame.color / np.float32(255), **made},
                {name: view.color for name, view in views.items()},
                np.isfinite(views["color"].depth),
            )
        )
    return found


def changes(a: HeldOut, b: HeldOut) -> tuple[dict[str, NDArray], dict[str, NDArray]]:
    """By name the change (H, W, 3) from view a to b at a's pixels, of style images and of
    renderings.

    NaN where b does not see the point, or the map has no surface.
    """
    at, seen = _places(a, b)

    def change(of_a: NDArray, of_b: NDArray) -> NDArray:
        warped = cv2.remap(of_b, at, None, cv2.INTER_LINEAR)
        return np.where(seen[..., None], warped - of_a, np.float32(np.nan))

    return tuple(
        {name: change(image, getattr(b, kind)[name]) for name, image in getattr(a, kind).items()}
        for kind in ("styles", "rendered")
    )


def _places(a: HeldOut, b: HeldOut) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where in b (H, W, 2: u, v) the points lie that a's pixels see, and where b sees them too and
    the map has both.
    """
    camera = a.frame.camera
    points = camera.rays().astype(np.float32) * a.depth[..., None]
    T = np.linalg.inv(b.frame.T_world_camera) @ a.frame.T_world_camera
    moved = points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    z = np.maximum(moved[..., 2], 1e-3)
    at = np.dstack(
        [moved[..., 0] / z * camera.fx + camera.cx, moved[..., 1] / z * camera.fy + camera.cy]
    ).astype(np.float32)
    there = cv2.remap(b.depth, at, None, cv2.INTER_LINEAR)
    covered = cv2.remap(b.covered.astype(np.float32), at, None, cv2.INTER_LINEAR) > 0.999
    return at, (a.depth > 0) & (np.abs(there - z) < SAME_SURFACE * z) & covered & a.covered


def mean_changes(views: Sequence[HeldOut]) -> dict[str, tuple[float, float]]:
    """By name the root mean square change from view to view [% of the range], of a style's images
    and of the renderings.
    """
    squares: dict[str, list[list[float]]] = {}
    for a, b in pairwise(views):
        of_images, of_renderings = changes(a, b)
        for name in of_images:
            both = of_images[name], of_renderings[name]
            squares.setdefault(name, []).append(
                [float(np.nanmean(np.square(change))) for change in both]
            )
    return {name: tuple(100 * np.sqrt(np.mean(rows, axis=0))) for name, rows in squares.items()}


def write_sheet(path: Path, views: Sequence[HeldOut], style: str) -> None:
    """A row for each view but the last: input, style, its change to the next view, the map's
    rendering, its change.
    """
    rows = []
    for a, b in pairwise(views):
        images, renderings = changes(a, b)
        rendered = np.where(a.covered[..., None], a.rendered[style], PAPER)
        cells = (
            a.styles["color"],
            a.styles[style],
            _drawn(images[style]),
            rendered,
            _drawn(renderings[style]),
        )
        rows.append(
            np.hstack([cv2.resize(cell, CELL, interpolation=cv2.INTER_AREA) for cell in cells])
        )
    picture = np.clip(255 * np.vstack(rows)[..., ::-1] + 0.5, 0, 255).astype(np.uint8)
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


def _drawn(change: NDArray) -> NDArray[np.float32]:
    """White where nothing changes, darker where it does, grey where there is nothing to compare."""
    shade = 1 - np.clip(GAIN * np.abs(change), 0, 1).max(axis=2, keepdims=True)
    return np.repeat(np.where(np.isnan(shade), PAPER, shade), 3, axis=2)
