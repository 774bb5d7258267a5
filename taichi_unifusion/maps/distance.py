"""Distance to the zero level of a field: the field is a distance at the surface only, so points walk
down to it.

The regression's prior pulls values towards 0 away from data: a quarter of a voxel from the surface the
field is some 4 % short, a voxel away half. Its sign and direction hold farther out.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

STEPS = 12  # of a walk at most
ARRIVED = 0.01  # [voxels] from the surface, or 2 % of the way
FARTHEST = 1.0  # [voxels] that a walk may take
LEAST_COSINE = (
    0.95  # between the way and the normal where it ends: else a nearer point is elsewhere
)
STEP = 0.05  # [voxels] of finite differences
# corners of a tetrahedron: sum of f(x + h k) k is 4 h times the gradient
CORNERS = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)], np.float32)

# values (N,) [voxels] and where they are known (N,), at points (N, 3) [voxels]
Field = Callable[[NDArray[np.float32]], tuple[NDArray[np.float32], NDArray[np.bool_]]]


def distances(
    field: Field, points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Signed distance (N,) to the zero level of a field at points (N, 3), all in voxels, and where it
    is one (N,).

    A point walks along the field's gradient until the field is 0 there; the way is the distance, if
    it is short, stays where the field is known, and meets the surface at a right angle. Elsewhere the
    field's own value is returned.
    """
    values, known = field(points)
    found, at = values.copy(), points.copy()
    walking, arrived = np.flatnonzero(known), np.zeros(len(points), bool)
    sign = np.where(values < 0, np.float32(-1), np.float32(1))
    here, normals = values[walking], np.zeros_like(points)
    for _ in range(STEPS):
        normals[walking] = _normals(field, at[walking])
        way = np.linalg.norm(at[walking] - points[walking], axis=1)
        close = np.abs(here) <= np.maximum(ARRIVED, 0.02 * way)
        there = walking[close]
        offset = points[there] - at[there] + here[close, None] * normals[there]
        found[there] = sign[there] * np.linalg.norm(offset, axis=1)
        along = np.abs(np.einsum("ni,ni->n", offset, normals[there]))
        # on the surface itself there is no way to have a direction
        right = along >= LEAST_COSINE * np.linalg.norm(offset, axis=1) - ARRIVED
        arrived[there] = right & (np.abs(found[there]) <= FARTHEST)
        walking, here = walking[~close], here[~close]
        if not len(walking):
            break
        at[walking] -= here[:, None] * normals[walking]
        here, known = field(at[walking])
        near = known & (np.linalg.norm(at[walking] - points[walking], axis=1) <= FARTHEST + 0.2)
        walking, here = walking[near], here[near]
    return np.where(arrived, found, values), arrived


def _normals(field: Field, points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit gradients (N, 3) of the field; 0 where it has none."""
    total = np.zeros_like(points)
    for corner in CORNERS:
        total += field(points + np.float32(STEP) * corner)[0][:, None] * corner
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), np.float32(1e-9))
