"""Are the poses camera to world with z forward? Two overlapping frames can tell.

Points of one frame, transformed by the poses into another, should lie where that frame measured
them. If they do not, but do under another convention of the same matrices, the recording probably
uses that convention.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import FLIP_YZ
from ..types import Frame

GRID = 48  # points along each image axis
NEAREST = 0.1  # [m] nothing nearer to a camera is compared
TOLERANCE = 0.03  # share of the depth within which two measurements agree
# least agreement under the right convention, and its lead over a wrong one
PLAUSIBLE, CLEARLY_BETTER = 0.5, 0.3
MIN_POINTS = 100  # seen by both frames; with fewer nothing is concluded
MIN_MOTION = 0.05, np.radians(3)  # [m], [rad]; with less, all conventions agree

READINGS = {
    "world-to-camera matrices: invert them": np.linalg.inv,
    "OpenGL's axes (y up, z backward): multiply them from the right by diag(1, -1, -1, 1)": lambda T: (
        T @ FLIP_YZ
    ),
    "world-to-camera matrices with OpenGL's axes: invert diag(1, -1, -1, 1) times each": lambda T: (
        np.linalg.inv(FLIP_YZ @ T)
    ),
}


def has_moved(a: Frame, b: Frame) -> bool:
    """Whether the poses of two frames differ enough to tell readings apart."""
    T_a_b = np.linalg.inv(a.require_pose()) @ b.require_pose()
    angle = np.arccos(np.clip((np.trace(T_a_b[:3, :3]) - 1) / 2, -1, 1))
    return bool(np.linalg.norm(T_a_b[:3, 3]) > MIN_MOTION[0] or angle > MIN_MOTION[1])


def agreement(a: Frame, b: Frame, T_b_a: NDArray[np.float64]) -> tuple[float, int]:
    """Share of a's points that frame b measured at the same depth, and how many of them b sees."""
    v, u = (np.linspace(0, n - 1, GRID).astype(int) for n in a.depth.shape)
    v, u = (x.ravel() for x in np.meshgrid(v, u, indexing="ij"))
    z = a.depth[v, u].astype(np.float64)
    v, u, z = (x[np.isfinite(z) & (z > 0)] for x in (v, u, z))
    points = (a.camera.rays(u, v) * z[:, None]) @ T_b_a[:3, :3].T + T_b_a[:3, 3]  # in b
    measured, inside = b.camera.look_up(b.depth, points, NEAREST)
    wanted = points[inside, 2]
    seen = np.isfinite(measured) & (measured > 0)
    if not seen.any():
        return 0.0, 0
    return float((np.abs(measured - wanted)[seen] < TOLERANCE * wanted[seen]).mean()), int(
        seen.sum()
    )


def guess_pose_convention(a: Frame, b: Frame) -> tuple[bool, str | None]:
    """Whether this pair of frames decides it, and a sentence if another reading of the poses fits
    far better.
    """
    T_world_a, T_world_b = a.require_pose(), b.require_pose()
    given, seen_as_given = agreement(a, b, np.linalg.inv(T_world_b) @ T_world_a)
    scores = {}
    for reading, read in READINGS.items():
        share, seen = agreement(a, b, np.linalg.inv(read(T_world_b)) @ read(T_world_a))
        scores[reading] = share if seen >= MIN_POINTS else 0.0
    reading, best = max(scores.items(), key=lambda item: item[1])
    if best < max(given + CLEARLY_BETTER, PLAUSIBLE):
        return given >= PLAUSIBLE and seen_as_given >= MIN_POINTS, None
    return (
        True,
        f"depth agrees with the poses on {given:.0%} of the points, but on {best:.0%} if they are {reading}",
    )
