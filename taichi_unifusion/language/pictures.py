"""Answers as meshes and pictures: relevance as heat over the grey surface, labels in colours with a legend."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..preview import draw_preview
from ..types import Mesh, Trajectory
from .questions import UNLABELLED, Segmentation

HEAT = ((0.0, (0.46, 0.46, 0.50)), (0.35, (0.48, 0.30, 0.42)), (0.5, (0.78, 0.26, 0.24)), (0.75, (0.96, 0.60, 0.14)),
        (1.0, (1.0, 0.92, 0.35)))  # relevance -> RGB: grey where nothing is, bright where it wins
NOTHING = (0.35, 0.35, 0.35)  # RGB of a vertex without a label
GOLDEN = 0.618033988749895    # steps of hue that stay apart for any number of labels
NEAR = 1.0                    # [m] a camera nearer than this shows too little around
SWATCH, LEGEND_WIDTH = 26, 260  # [pixels]


def heat_mesh(mesh: Mesh, relevance: NDArray) -> Mesh:
    """The mesh in colours of the relevance (V,), with its shades of light and dark; the numbers as attribute `relevance`."""
    levels, colors = np.array([level for level, _ in HEAT]), np.array([color for _, color in HEAT])
    heat = np.stack([np.interp(relevance, levels, colors[:, k]) for k in range(3)], axis=1)
    shade = np.full((len(heat), 1), 0.5)
    if mesh.attributes.get("color") is not None and mesh.attributes["color"].shape[1] == 3:
        shade = mesh.attributes["color"] @ np.array([[0.299], [0.587], [0.114]])
    shaded = np.clip(heat * (0.65 + 0.6 * shade), 0, 1)
    plain = Mesh(mesh.vertices, mesh.faces, mesh.normals)
    return plain.with_attribute("color", shaded).with_attribute("relevance", relevance)


def cameras_that_see(trajectory: Trajectory | None, point: NDArray, count: int = 3) -> Trajectory | None:
    """The poses that have a point (3,) world [m] nearest to the middle of their picture, not too close."""
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
    return np.array([colorsys.hsv_to_rgb((0.02 + i * GOLDEN) % 1, (0.75, 0.45, 0.9)[i % 3], (0.95, 0.85, 0.65)[i // 3 % 3])
                     for i in range(count)])


def label_mesh(mesh: Mesh, found: Segmentation, labels: Sequence[int], colors: NDArray) -> Mesh:
    """The mesh in the colours of its names, with attributes `label`, -1 without one, and `confidence`."""
    known = found.labels != UNLABELLED
    plain = Mesh(mesh.vertices, mesh.faces, mesh.normals)
    shown = np.where(known[:, None], colors[found.labels], np.array(NOTHING))
    numbers = np.where(known, np.array(labels)[found.labels], UNLABELLED)
    return (plain.with_attribute("color", shown).with_attribute("label", numbers)
            .with_attribute("confidence", found.confidence))


def segmentation_picture(mesh: Mesh, found: Segmentation, colors: NDArray, trajectory: Trajectory | None) -> NDArray[np.uint8]:
    """Views of a labelled mesh (H, W, 3) RGB beside the names that occur in it, the commonest first."""
    picture = draw_preview(mesh, trajectory=trajectory)
    counts = np.bincount(found.labels[found.labels != UNLABELLED], minlength=len(found.names))
    shown = [i for i in np.argsort(-counts, kind="stable") if counts[i]][:picture.shape[0] // SWATCH - 1]
    legend = np.full((picture.shape[0], LEGEND_WIDTH, 3), 255, np.uint8)
    for row, i in enumerate(shown):
        top = 14 + row * SWATCH
        legend[top:top + SWATCH - 8, 14:44] = (255 * colors[i] + 0.5).astype(np.uint8)
        cv2.putText(legend, found.names[i][:24], (54, top + 14), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return np.hstack([picture, legend])
