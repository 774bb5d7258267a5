"""A surface cut into charts, pieces that nearly lie in a plane, and laid flat.

A map's surface is mostly walls, floors and boards, so its triangles are sorted by the nearest of
six directions, those of the room. xatlas cuts surfaces as well, triangle by triangle with a cost
that looks ahead; that took 0.2 ms a triangle, thirty times as long as this with the packing, and gave more charts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.triangles import area_vectors
from ..types import Mesh

SMOOTHED = 2  # rounds of averaging normals over neighbours
TRIED, JUDGED = 600, 4000  # normals that may become a direction, and that they are judged by
CONE = np.cos(np.radians(40))  # normals that a direction stands for
ACROSS = 0.2  # cosine of two directions of a room, at most
# cosine between a triangle's normal and its chart's, at least: it is stretched 3 times where it is less
STEEPEST = 0.3
SMALL, ROUNDS = 10, 4  # triangles of a chart that a larger one takes in, and how often


@dataclass(frozen=True)
class FlatMesh:
    """A mesh whose vertices belong to one chart each, and their places in the plane."""

    source: NDArray[np.int64]  # (V,) the vertex of the uncut mesh
    faces: NDArray[np.int32]  # (F, 3) in the order of the uncut mesh
    places: NDArray[np.float32]  # (V, 2) [m]; charts may lie on one another


@dataclass(frozen=True)
class Charts:
    """Which chart each triangle of a mesh belongs to, and the direction that it faces."""

    mesh: Mesh
    chart: NDArray[np.int64]  # (F,) from 0
    direction: NDArray[np.float64]  # (F, 3) unit

    def flattened(self) -> FlatMesh:
        """Every chart laid into its plane."""
        mesh, count = self.mesh, int(self.chart.max()) + 1
        corners, faces = np.unique(
            mesh.faces.astype(np.int64) * count + self.chart[:, None], return_inverse=True
        )
        source, chart_of = corners // count, corners % count
        points = mesh.vertices[source].astype(np.float64)
        places = np.column_stack([(points * axis[chart_of]).sum(axis=1) for axis in self._planes()])
        return FlatMesh(source, faces.reshape(-1, 3).astype(np.int32), places.astype(np.float32))

    def split(self, apart: NDArray[np.bool_]) -> Charts:
        """The triangles of the mask (F,) in charts of their own, those of one chart and connected
        together.
        """
        label = 2 * self.chart + apart
        return replace(self, chart=_connected(label, _neighbours(self.mesh.faces)))

    def _planes(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Axes x and y (C, 3) of the plane that each chart is laid into: across to its mean normal,
        or, where that is too steep to one of its triangles, to its direction.
        """
        vectors, chart = _area_vectors(self.mesh), self.chart
        normals = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
        count = int(chart.max()) + 1
        mean = np.stack([np.bincount(chart, vectors[:, d], count) for d in range(3)], axis=1)
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
        steepest = np.ones(count)
        np.minimum.at(steepest, chart, (normals * mean[chart]).sum(axis=1))
        own = np.zeros((count, 3))
        own[chart] = self.direction
        z = np.where((steepest > STEEPEST)[:, None], mean, own)
        x = np.cross(z, np.eye(3)[np.abs(z).argmin(axis=1)])
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        return x, np.cross(z, x)


def cut_charts(mesh: Mesh) -> Charts:
    """The charts of a mesh whose triangles have an area. One that winds over itself lies on itself
    when it is flattened.
    """
    vectors = _area_vectors(mesh)
    normals = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    pairs = _neighbours(mesh.faces)
    axes = room_axes(vectors)
    label = (_smoothed(vectors, pairs) @ axes.T).argmax(axis=1)
    steep = (normals * axes[label]).sum(axis=1) < STEEPEST
    label[steep] = (normals[steep] @ axes.T).argmax(axis=1)
    chart = _take_in_small(label, normals @ axes.T, pairs)
    return Charts(mesh, chart, axes[label])


def _area_vectors(mesh: Mesh) -> NDArray[np.float64]:
    return np.asarray(area_vectors(mesh.vertices.astype(np.float64), mesh.faces), np.float64)


def room_axes(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Six directions (6, 3), unit, at right angles and opposite: the first is the one that most of
    the surface faces, the second most of what is left across to it. `vectors` (F, 3) are normals as
    long as areas.
    """
    rng, size = np.random.default_rng(0), np.linalg.norm(vectors, axis=1)
    drawn = vectors[rng.choice(len(vectors), JUDGED, p=size / size.sum())]
    drawn /= np.linalg.norm(drawn, axis=1, keepdims=True)
    tried = drawn[:TRIED]
    facing = (np.abs(tried @ drawn.T) > CONE).sum(axis=1)
    first = tried[facing.argmax()]
    across = np.abs(tried @ first) < ACROSS
    # of a single plane: any direction in it
    second = (
        tried[np.where(across, facing, -1).argmax()]
        if across.any()
        else np.eye(3)[np.abs(first).argmin()]
    )
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    three = np.stack([first, second, np.cross(first, second)])
    return np.concatenate([three, -three])


def _neighbours(faces: NDArray[np.int32]) -> NDArray[np.int64]:
    """Triangles (2, N) that share an edge."""
    edges = np.sort(np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    code = edges[:, 0].astype(np.int64) * (int(faces.max()) + 1) + edges[:, 1]
    order = np.argsort(code, kind="stable")
    same = np.flatnonzero(code[order[1:]] == code[order[:-1]])
    return np.stack([order[same], order[same + 1]]) % len(faces)


def _smoothed(vectors: NDArray[np.float64], pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """Normals (F, 3), of any length, that take in those of neighbours."""
    p, q = pairs
    for _ in range(SMOOTHED):
        sums = vectors.copy()
        for d in range(3):
            sums[:, d] += np.bincount(p, vectors[q, d], len(vectors))
            sums[:, d] += np.bincount(q, vectors[p, d], len(vectors))
        vectors = sums
    return vectors


def _take_in_small(
    label: NDArray[np.int64], cosines: NDArray[np.float64], pairs: NDArray[np.int64]
) -> NDArray[np.int64]:
    """The chart (F,) of every triangle: connected, of one label. `label` (F,) is changed where a small
    chart can join a larger one beside it; `cosines` (F, 6) are to the direction of every label.
    """
    chart = _connected(label, pairs)
    both = np.concatenate([pairs, pairs[::-1]], axis=1)
    for _ in range(ROUNDS):
        size = np.bincount(chart)[chart]
        small, large = both[:, label[both[0]] != label[both[1]]]
        joins = (size[small] < SMALL) & (size[large] > size[small])
        joins &= cosines[small, label[large]] > STEEPEST
        if not joins.any():
            break
        label[small[joins]] = label[large[joins]]
        chart = _connected(label, pairs)
    return chart


def _connected(label: NDArray[np.int64], pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Numbers (F,) of the connected parts of triangles of one label."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    p, q = pairs[:, label[pairs[0]] == label[pairs[1]]]
    graph = coo_matrix((np.ones(len(p), np.int8), (p, q)), shape=(len(label), len(label)))
    return connected_components(graph, directed=False)[1].astype(np.int64)
