"""Analytic solids, each a unit box, cylinder or sphere under an affine map: how to place them, and
their exact mesh.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..types import Mesh
from .kernels.solids import BOX, CYLINDER, ROOM, SPHERE

CHORD_ERROR = 1.5e-4  # [m] largest distance of the tessellated from the true surface


@dataclass(frozen=True)
class Primitive:
    """A unit solid scaled by `half_extents`, turned by `R` and moved to `center`."""

    shape: int  # ROOM, BOX, CYLINDER (along its z) or SPHERE
    material: str
    center: NDArray[np.float64]  # (3,) [m]
    half_extents: NDArray[np.float64]  # (3,) [m]
    R: NDArray[np.float64]  # (3, 3) local to world


def rotation(axis: int, degrees: float) -> NDArray[np.float64]:
    """The rotation about a coordinate axis by an angle."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R, (i, j) = np.eye(3), ((1, 2), (2, 0), (0, 1))[axis]
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def box(material: str, low: Sequence[float], high: Sequence[float]) -> Primitive:
    """The box between two corners [m]."""
    corners = np.array([low, high], dtype=float)
    half_extents = (corners[1] - corners[0]) / 2
    return Primitive(BOX, material, corners.sum(axis=0) / 2, half_extents, np.eye(3))


def cylinder(
    material: str, base: Sequence[float], radius: float, height: float, axis: int = 2
) -> Primitive:
    """The cylinder that starts at `base` [m] and extends by `height` along a coordinate axis."""
    R = (rotation(1, 90), rotation(0, -90), np.eye(3))[axis]
    return Primitive(
        CYLINDER,
        material,
        np.array(base) + R[:, 2] * height / 2,
        np.array([radius, radius, height / 2]),
        R,
    )


def ellipsoid(
    material: str,
    center: Sequence[float] | NDArray,
    radii: Sequence[float],
    R: NDArray | None = None,
) -> Primitive:
    """The ellipsoid with these half axes [m]."""
    R = np.eye(3) if R is None else R
    return Primitive(
        SPHERE, material, np.array(center, dtype=float), np.array(radii, dtype=float), R
    )


def place(
    parts: Iterable[Primitive], x: float, y: float, z: float = 0.0, turn: float = 0.0
) -> list[Primitive]:
    """The parts turned about z by `turn` degrees, then moved."""
    R = rotation(2, turn)
    return [replace(p, center=R @ p.center + (x, y, z), R=R @ p.R) for p in parts]


def tessellate(primitives: Iterable[Primitive]) -> Mesh:
    """All primitives as triangles with normals, within CHORD_ERROR of the true surface; where
    solids touch, their faces stay in the mesh.
    """
    vertices, normals, faces, count = [], [], [], 0
    for p in primitives:
        unit, unit_normals, triangles = _UNIT_SOLIDS[p.shape](p.half_extents.max())
        n = (unit_normals / p.half_extents) @ p.R.T
        vertices.append((unit * p.half_extents) @ p.R.T + p.center)
        normals.append(n / np.linalg.norm(n, axis=1, keepdims=True))
        faces.append(triangles + count)
        count += len(unit)
    return Mesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(normals).astype(np.float32),
    )


def _steps(radius: float) -> int:
    """Steps around a circle that keep a grid of triangles within CHORD_ERROR of a sphere of this
    radius [m].
    """
    return int(np.ceil(np.pi * np.sqrt(radius / CHORD_ERROR)))


def _grid(rows: int, columns: int) -> NDArray[np.int64]:
    """Triangles of a grid of vertices, row by row; counter-clockwise where columns turn left and
    rows go up.
    """
    i = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    return np.concatenate([i + (0, 1, columns), i + (1, columns + 1, columns)])


def _unit_box(radius: float):
    vertices, normals = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            face = np.empty((4, 3))
            face[:, axis] = side
            face[:, (axis + 1) % 3] = side * np.array((-1, 1, -1, 1))
            face[:, (axis + 2) % 3] = (-1, -1, 1, 1)
            vertices.append(face)
            normals.append(np.broadcast_to(np.eye(3)[axis] * side, (4, 3)))
    faces = np.concatenate([_grid(2, 2) + 4 * i for i in range(6)])
    return np.concatenate(vertices), np.concatenate(normals), faces


def _unit_room(radius: float):
    vertices, normals, faces = _unit_box(radius)
    return vertices, -normals, faces[:, ::-1]


def _unit_cylinder(radius: float):
    angle = np.linspace(0, 2 * np.pi, _steps(radius) + 1)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    up, n = np.array((0.0, 0.0, 1.0)), len(ring)
    vertices, normals, faces = [ring - up, ring + up], [ring, ring], [_grid(2, n)]
    for side in (-up, up):
        vertices += [side[None], ring + side]
        normals.append(np.broadcast_to(side, (n + 1, 3)))
        i = np.arange(1, n)
        fan = np.stack([0 * i, i, i + 1], axis=1)[:, :: int(side[2])]
        faces.append(fan + 2 * n + (n + 1) * (side[2] > 0))
    return np.concatenate(vertices), np.concatenate(normals), np.concatenate(faces)


def _unit_sphere(radius: float):
    n = _steps(radius)
    longitude, latitude = np.meshgrid(
        np.linspace(0, 2 * np.pi, n + 1), np.linspace(-np.pi / 2, np.pi / 2, n // 2 + 1)
    )
    points = np.stack(
        [
            np.cos(latitude) * np.cos(longitude),
            np.cos(latitude) * np.sin(longitude),
            np.sin(latitude),
        ],
        axis=-1,
    )
    faces = _grid(n // 2 + 1, n + 1)
    # the lower triangles of the first row and the upper ones of the last have no area
    flat = faces.reshape(2, n // 2, n, 3)
    faces = np.concatenate([flat[0, 1:].reshape(-1, 3), flat[1, :-1].reshape(-1, 3)])
    return points.reshape(-1, 3), points.reshape(-1, 3), faces


_UNIT_SOLIDS = {ROOM: _unit_room, BOX: _unit_box, CYLINDER: _unit_cylinder, SPHERE: _unit_sphere}
