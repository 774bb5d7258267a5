"""Triangles as arrays: areas, normals, even samples, and how far points lie from their surface.

Arrays are `vertices` (V, 3) [m] and `faces` (F, 3), three rows of `vertices` each.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# [m] longest edge of the pieces that triangles are cut into; the nearest are found by their centres
PIECE_M = 0.04
MAX_PIECES = 2_000_000  # 0.3 GB of search tree; larger surfaces get larger pieces
CANDIDATES = (24, 96)  # pieces tried for a point; the second number if the first may not suffice
# [m] exact up to here; beyond, at most one piece's radius too long
EXACT_M = 0.1
FACE_CHUNK = 32_768  # areas computed at once: intermediate numbers stay in the cache
POINT_CHUNK = 5_000  # points measured at once: some 150 MB of intermediate numbers at most


def used_vertices(faces: NDArray) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """The vertices (V',) that faces (F, 3) have, in order, and the faces numbered by these."""
    used = np.bincount(faces.reshape(-1)) > 0
    numbers = np.cumsum(used, dtype=np.int32) - 1
    return np.flatnonzero(used), numbers.take(faces)


def area_vectors(vertices: NDArray, faces: NDArray) -> NDArray[np.floating]:
    """Half the cross product of two edges, (F, 3), in the precision of the vertices (V, 3): as long
    as the triangle's area [m^2], towards the side from which its corners (F, 3) run
    counter-clockwise.
    """
    return np.stack(_cross_products(vertices, faces), axis=1) / 2


def areas(vertices: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """Areas (F,) [m^2]."""
    vertices, found = np.asfortranarray(vertices, np.float64), np.empty(len(faces))
    for start in range(0, len(faces), FACE_CHUNK):
        part = slice(start, start + FACE_CHUNK)
        x, y, z = _cross_products(vertices, faces[part])
        found[part] = np.sqrt(x * x + y * y + z * z) / 2
    return found


def _cross_products(vertices: NDArray, faces: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """x, y and z, (F,) each, of the cross product of two edges of every triangle.

    Coordinate by coordinate: several times faster than `np.cross` of rows.
    """
    (ux, vx), (uy, vy), (uz, vz) = (_edges(vertices[:, d], faces) for d in range(3))
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def _edges(coordinate: NDArray, faces: NDArray) -> tuple[NDArray, NDArray]:
    """From the first corner of every triangle to the two others, along one coordinate (V,)."""
    coordinate = np.ascontiguousarray(coordinate)
    a, b, c = (coordinate.take(faces[:, k]) for k in range(3))
    return b - a, c - a


def vertex_areas(vertices: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """Area (V,) [m^2] that each vertex stands for: a third of its triangles'."""
    thirds = np.repeat(areas(vertices, faces) / 3, 3)
    return np.asarray(np.bincount(faces.ravel(), thirds, len(vertices)), np.float64)


def vertex_normals(vertices: NDArray, faces: NDArray) -> NDArray[np.float32]:
    """Unit normals (V, 3): the mean of the adjacent faces', weighted by area; 0 without a face.

    Where that has no direction, since all of them are too small, see `fill_normals`.
    """
    weighted = np.repeat(area_vectors(vertices, faces), 3, axis=0)
    sums = np.stack(
        [np.bincount(faces.ravel(), weighted[:, k], len(vertices)) for k in range(3)], axis=1
    )
    lengths = np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-30)
    return fill_normals((sums / lengths).astype(np.float32), vertices, faces)


def fill_normals(normals: NDArray[np.float32], vertices: NDArray, faces: NDArray) -> NDArray:
    """Unit normals (V, 3) also at the vertices of faces that are too small to have had a say: the mean
    of these faces', whatever their size, else of the vertices beside, else z.

    Those that have a length stay as they are; without a face a normal is 0.
    """
    lacking = np.zeros(len(normals), np.bool_)
    lacking[faces.ravel()] = True
    lacking &= np.abs(normals).max(axis=1, initial=0) < 0.1  # a unit vector has a part of 0.57
    if not lacking.any():
        return normals
    around = faces[lacking[faces].any(axis=1)]
    filled = normals.astype(np.float64)
    own = area_vectors(vertices.astype(np.float64), around)
    own /= np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-300)
    for by_face in (own, normals[around].sum(axis=1, dtype=np.float64), np.array([0.0, 0.0, 1.0])):
        sums = np.zeros(filled.shape)
        np.add.at(sums, around, np.broadcast_to(by_face, (len(around), 3))[:, None])
        lengths = np.linalg.norm(sums, axis=1)
        found = lacking & (lengths > 1e-6)
        filled[found] = sums[found] / lengths[found, None]
        lacking &= ~found
    return filled.astype(np.float32)


def sample_surface(
    vertices: NDArray, faces: NDArray, count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """`count` points (N, 3) drawn evenly over the area of the triangles, which must not be 0.

    Stratified along the list of triangles: each of `count` equal shares of the area gives one
    point, so that the sample varies less than independent draws would.
    """
    return sample_patches(vertices, faces, count, rng)[0]


def sample_patches(
    vertices: NDArray, faces: NDArray, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points as `sample_surface` draws them, and the unit normals of their triangles: (N, 3) each."""
    total = np.cumsum(areas(vertices, faces))
    picked = np.searchsorted(
        total, (np.arange(count) + rng.random(count)) * (total[-1] / count), side="right"
    )
    picked = faces[np.minimum(picked, len(faces) - 1)]
    a, b, c = vertices[picked].astype(np.float64).swapaxes(0, 1)
    root, share = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return (1 - root) * a + root * (1 - share) * b + root * share * c, normals


class SurfaceDistance:
    """Distances from points to the surface of finite triangles, of which there is at least one.

    A point is measured exactly against the triangles whose pieces have the nearest centres. Within
    10 cm no triangle that could be nearer is left out, unless more than 96 pieces crowd there;
    farther off a distance may come out millimetres too long.
    """

    def __init__(self, vertices: NDArray, faces: NDArray) -> None:
        from scipy.spatial import KDTree

        area = float(areas(vertices, faces).sum())
        self.corners = vertices[faces].astype(np.float64)  # (F, 3, 3)
        centers, self.owner, self.radius = _pieces(self.corners, area)
        self.tree = KDTree(centers, balanced_tree=False, compact_nodes=False)

    def __call__(self, points: NDArray) -> NDArray[np.float64]:
        """Distances (N,) [m] of points (N, 3)."""
        points, distances = np.asarray(points, np.float64), np.empty(len(points))
        for start in range(0, len(points), POINT_CHUNK):
            part, left = (
                points[start : start + POINT_CHUNK],
                np.arange(min(POINT_CHUNK, len(points) - start)),
            )
            for candidates in CANDIDATES:
                measured, horizon = self._measure(part[left], min(candidates, self.tree.n))
                distances[start + left] = measured
                # a piece beyond the horizon may reach nearer than was measured
                in_doubt = measured + self.radius > horizon
                left = left[in_doubt & (measured < EXACT_M)]
                if not len(left) or candidates >= self.tree.n:
                    break
        return distances

    def _measure(
        self, points: NDArray, candidates: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distances (N,) to the triangles of the `candidates` nearest pieces, and to the centre of
        the last of these pieces.
        """
        reach, pieces = self.tree.query(points, k=candidates)
        reach = np.reshape(np.asarray(reach, np.float64), (len(points), candidates))
        triangles = np.sort(self.owner[np.reshape(pieces, reach.shape)], axis=1)
        row, column = np.nonzero(np.diff(triangles, axis=1, prepend=-1))  # each triangle once
        squared = squared_distance_to_triangles(points[row], self.corners[triangles[row, column]])
        starts = np.searchsorted(row, np.arange(len(points)))
        return np.sqrt(np.minimum.reduceat(squared, starts)), reach[:, -1]


def _pieces(corners: NDArray, area: float) -> tuple[NDArray[np.float64], NDArray[np.int64], float]:
    """Centres (P, 3) of the pieces of triangles (F, 3, 3) of this total area [m^2], cut in half
    until short; the triangle (P,) of each; and the largest radius [m].
    """
    # cutting in half leaves pieces with a mean area of edge^2 / 16
    edge = max(PIECE_M, 4 * np.sqrt(area / MAX_PIECES))
    centers, owners, radius, owner = [], [], 0.0, np.arange(len(corners))
    while len(corners):
        along = corners[:, [1, 2, 0]] - corners  # the edges from corner k to k + 1
        squared = np.einsum("nkd,nkd->nk", along, along)
        whole = squared.max(axis=1) <= edge**2
        center = corners[whole].mean(axis=1)
        centers.append(center)
        owners.append(owner[whole])
        radius = max(
            radius, np.linalg.norm(corners[whole] - center[:, None], axis=2).max(initial=0.0)
        )
        corners, owner, first = corners[~whole], owner[~whole], squared[~whole].argmax(axis=1)
        a, b, c = (corners[np.arange(len(corners)), (first + k) % 3] for k in range(3))
        middle = (a + b) / 2
        corners = np.concatenate(
            [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        )
        owner = np.concatenate([owner, owner])
    return np.concatenate(centers), np.concatenate(owners), radius


def squared_distance_to_triangles(points: NDArray, corners: NDArray) -> NDArray[np.float64]:
    """Squared distance (N,) of each point (N, 3) to its own triangle (N, 3, 3); a triangle may be a
    segment or a point.
    """
    a, b, c = corners.swapaxes(0, 1)
    ab, ac, ap = b - a, c - a, points - a
    normal = np.cross(ab, ac)
    twice_area = np.einsum("nd,nd->n", normal, normal)
    flat = np.maximum(twice_area, 1e-300)
    w_b = np.einsum("nd,nd->n", np.cross(ap, ac), normal) / flat
    w_c = np.einsum("nd,nd->n", np.cross(ab, ap), normal) / flat
    # the foot of the perpendicular lies in the triangle
    within = (w_b >= 0) & (w_c >= 0) & (w_b + w_c <= 1) & (twice_area > 0)
    to_plane = np.einsum("nd,nd->n", ap, normal) ** 2 / flat
    to_edges = np.minimum(
        np.minimum(_squared_to_segment(points, a, b), _squared_to_segment(points, b, c)),
        _squared_to_segment(points, c, a),
    )
    return np.where(within, to_plane, to_edges)


def _squared_to_segment(points: NDArray, a: NDArray, b: NDArray) -> NDArray[np.float64]:
    along, to_point = b - a, points - a
    length = np.maximum(np.einsum("nd,nd->n", along, along), 1e-300)
    share = np.clip(np.einsum("nd,nd->n", to_point, along) / length, 0, 1)
    off = to_point - share[:, None] * along
    return np.einsum("nd,nd->n", off, off)
