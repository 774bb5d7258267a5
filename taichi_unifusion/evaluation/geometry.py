"""Triangle meshes as evaluation takes them: checked, sampled evenly, and how far points lie from their surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..types import Mesh

PIECE_M = 0.02       # [m] triangles are cut into pieces of about this edge to find the nearest ones
MAX_PIECES = 8_000_000  # some 1 GB of search tree; for a larger surface pieces grow, and the search takes as much longer
CANDIDATES = 12      # pieces by which a point's nearest triangle is looked for
POINT_CHUNK = 50_000  # points measured at once: 150 MB of intermediate numbers


def check_mesh(mesh: Mesh, name: str) -> Mesh:
    """The mesh with arrays as kernels take them; raises InputError where it is empty, not finite or inconsistent.

    `name` says which mesh it is, in messages.
    """
    vertices = np.ascontiguousarray(mesh.vertices, np.float32)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    if not len(faces):
        raise InputError(f"{name}: has no triangles" + (f", only {len(vertices)} points" if len(vertices) else ""))
    if not 0 <= faces.min() <= faces.max() < len(vertices):
        raise InputError(f"{name}: its triangles name vertices {faces.min()}..{faces.max()}, but it has {len(vertices)}")
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    if bad:
        raise InputError(f"{name}: {bad} of {len(vertices)} vertices are not finite numbers")
    if not triangle_areas(vertices, faces).sum() > 0:
        raise InputError(f"{name}: its triangles have no area")
    return Mesh(vertices, faces, mesh.normals, mesh.attributes)


def triangle_areas(vertices: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """Areas (F,) [m^2]."""
    corners = vertices[faces].astype(np.float64)
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """`count` points (N, 3) drawn evenly over the area of a checked mesh.

    Stratified along the list of triangles: each of `count` equal shares of the area gives one point, so that the sample varies
    less than independent draws would.
    """
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    total = np.cumsum(triangle_areas(mesh.vertices, mesh.faces))
    picked = np.searchsorted(total, (np.arange(count) + rng.random(count)) * (total[-1] / count), side="right")
    a, b, c = corners[np.minimum(picked, len(corners) - 1)].swapaxes(0, 1)
    root, share = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return (1 - root) * a + root * (1 - share) * b + root * share * c


class SurfaceDistance:
    """Distances from points to the surface of a checked mesh.

    Every triangle is cut into pieces no longer than about 2 cm; a point is measured exactly against the triangles of its nearest
    dozen pieces. The result is an upper bound, and exact unless more than a dozen pieces crowd around a point.
    """

    def __init__(self, mesh: Mesh) -> None:
        from scipy.spatial import cKDTree

        self.corners = mesh.vertices[mesh.faces].astype(np.float64)  # (F, 3, 3)
        centers, self.owner = _pieces(self.corners)
        self.tree = cKDTree(centers, balanced_tree=False, compact_nodes=False)

    def __call__(self, points: NDArray) -> NDArray[np.float64]:
        """Distances (N,) [m] of points (N, 3)."""
        points = np.asarray(points, np.float64)
        distances = np.empty(len(points))
        for start in range(0, len(points), POINT_CHUNK):
            part = points[start:start + POINT_CHUNK]
            nearest = self.tree.query(part, k=min(CANDIDATES, self.tree.n))[1].reshape(len(part), -1)
            triangles = np.sort(self.owner[nearest], axis=1)
            row, column = np.nonzero(np.diff(triangles, axis=1, prepend=-1))  # each triangle once
            squared = squared_distance_to_triangles(part[row], self.corners[triangles[row, column]])
            starts = np.searchsorted(row, np.arange(len(part)))
            distances[start:start + POINT_CHUNK] = np.sqrt(np.minimum.reduceat(squared, starts))
        return distances


def _pieces(corners: NDArray) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Centres (P, 3) of the pieces of triangles, and the triangle (P,) of each."""
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    edge = PIECE_M
    while (steps := np.maximum(np.ceil(longest / edge), 1)) @ steps > MAX_PIECES:
        edge *= 1.5
    centers, owner = [], []
    for n in np.unique(steps).astype(int):  # n^2 pieces a triangle
        chosen = np.nonzero(steps == n)[0]
        i, j = (grid.ravel() for grid in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        upright, inverted = i + j < n, i + j < n - 1
        barycentric = np.concatenate([np.stack([i, j], axis=1)[upright] + 1 / 3, np.stack([i, j], axis=1)[inverted] + 2 / 3]) / n
        a, b, c = (corners[chosen, k][:, None] for k in range(3))
        u, v = barycentric[:, :1], barycentric[:, 1:]
        centers.append(((1 - u - v) * a + u * b + v * c).reshape(-1, 3))
        owner.append(np.repeat(chosen, len(barycentric)))
    return np.concatenate(centers), np.concatenate(owner)


def squared_distance_to_triangles(points: NDArray, corners: NDArray) -> NDArray[np.float64]:
    """Squared distance (N,) of each point (N, 3) to its own triangle (N, 3, 3); a triangle may be a segment or a point."""
    a, b, c = corners.swapaxes(0, 1)
    ab, ac, ap = b - a, c - a, points - a
    normal = np.cross(ab, ac)
    twice_area = np.einsum("nd,nd->n", normal, normal)
    flat = np.maximum(twice_area, 1e-300)
    w_b = np.einsum("nd,nd->n", np.cross(ap, ac), normal) / flat
    w_c = np.einsum("nd,nd->n", np.cross(ab, ap), normal) / flat
    within = (w_b >= 0) & (w_c >= 0) & (w_b + w_c <= 1) & (twice_area > 0)  # the foot of the perpendicular lies in the triangle
    to_plane = np.einsum("nd,nd->n", ap, normal) ** 2 / flat
    to_edges = np.minimum(np.minimum(_squared_to_segment(points, a, b), _squared_to_segment(points, b, c)),
                          _squared_to_segment(points, c, a))
    return np.where(within, to_plane, to_edges)


def _squared_to_segment(points: NDArray, a: NDArray, b: NDArray) -> NDArray[np.float64]:
    along, to_point = b - a, points - a
    length = np.maximum(np.einsum("nd,nd->n", along, along), 1e-300)
    share = np.clip(np.einsum("nd,nd->n", to_point, along) / length, 0, 1)
    off = to_point - share[:, None] * along
    return np.einsum("nd,nd->n", off, off)
