"""Where on a mesh something is: connected parts of high relevance, as boxes, the strongest first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..errors import InputError
from ..geometry.triangles import vertex_areas, vertex_normals
from ..types import Mesh

THRESHOLD = 0.5  # relevance from which a vertex belongs to a region: the query beats all rivals
MIN_AREA = 0.01  # [m^2] of a region; smaller ones are noise
CERTAIN = (
    0.3  # share of a region that must be certain, where its certain part is less than MIN_AREA
)
JOIN = 0.05  # [m] between pieces of one thing, if that is what they are
PIECE = 0.2  # area of a piece over that of what it belongs to, wherever it is beside it
SAME_WAY = 0.5  # cosine of normals, mean over the borders of two pieces, from which one continues the other


@dataclass(frozen=True)
class Region:
    """A connected part of the surface that answers a query."""

    score: float  # relevance, mean over the area where that is certain
    strength: float  # [m^2] relevance above the threshold, summed over that area; regions are ranked by it
    area: float  # [m^2]
    centroid: NDArray[np.float64]  # (3,) world [m], of its area
    box: NDArray[np.float64]  # (2, 3) world [m]: lowest and highest corner
    vertices: NDArray[np.int64]  # of the mesh


def find_regions(
    mesh: Mesh,
    relevance: NDArray,
    *,
    extent: NDArray | None = None,
    threshold: float = THRESHOLD,
    min_area: float = MIN_AREA,
    join: float = JOIN,
) -> list[Region]:
    """Connected parts of a mesh where `relevance` (V,) reaches the threshold, the strongest first: those
    that exceed it by most, over most of their area.

    A region begins where the relevance is certain and goes on as far as `extent` (V,), the relevance
    without any margin for noise, reaches the threshold; without it, only what is certain counts. A
    certain part that is neither `min_area` [m^2] nor three tenths of its region is noise. Pieces that come
    as near as `join` [m] are one region where one continues the other, or is a small part beside it: a
    sofa that is seen in two pieces. Surface of something else between them keeps them apart.

    Raises InputError for a relevance of another mesh or a threshold outside 0..1.
    """
    count = len(mesh.vertices)
    extent = relevance if extent is None else extent
    for values in (relevance, extent):
        if values.shape != (count,):
            raise InputError(f"regions: relevance must be ({count},), got {values.shape}")
    if not 0 < threshold < 1 or min_area < 0:
        raise InputError(
            f"regions: need 0 < threshold < 1 and min_area >= 0, got {threshold} and {min_area}"
        )
    certain = relevance >= threshold
    inside = certain | (extent >= threshold)
    areas = vertex_areas(mesh.vertices, mesh.faces)
    vertices, part = _connected(mesh, inside)
    sure, whole = (np.bincount(part, each[vertices]) for each in (areas * certain, areas))
    kept = (sure > 0) & ((sure >= min_area) | (sure >= CERTAIN * whole))
    pieces = _split(vertices[kept[part]], part[kept[part]])
    if join > 0:
        pieces = join_pieces(mesh, pieces, areas, join)
    regions = [
        _region(mesh, relevance, areas, piece, threshold)
        for piece in pieces
        if areas[piece].sum() >= max(min_area, 1e-12)
    ]
    return sorted(regions, key=lambda region: -region.strength)


def join_pieces(
    mesh: Mesh, pieces: Sequence[NDArray[np.int64]], areas: NDArray, distance: float
) -> list[NDArray[np.int64]]:
    """Pieces (vertices each) of which those within `distance` [m] that are one thing are put together;
    `areas` (V,) [m^2] are those of the vertices.
    """
    if len(pieces) < 2:
        return list(pieces)
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    points, normals = mesh.vertices.astype(np.float64), vertex_normals(mesh.vertices, mesh.faces)
    piece_of = np.full(len(points), -1)
    for i, piece in enumerate(pieces):
        piece_of[piece] = i
    size = np.array([areas[piece].sum() for piece in pieces])
    low = np.array([points[piece].min(axis=0) for piece in pieces]) - distance / 2
    high = np.array([points[piece].max(axis=0) for piece in pieces]) + distance / 2
    trees = [KDTree(points[piece]) for piece in pieces]
    links: list[tuple[int, int]] = []
    everything: KDTree | None = None
    for a, b in _boxes_that_meet(low, high):
        away, at = trees[a].query(points[pieces[b]], distance_upper_bound=distance)
        near = np.isfinite(away)
        if not near.any():
            continue
        if size[[a, b]].min() <= PIECE * size[[a, b]].max():
            links.append((a, b))
            continue
        first, second = pieces[a][np.asarray(at)[near]], pieces[b][near]
        if (normals[first] * normals[second]).sum(axis=1).mean() < SAME_WAY:
            continue
        if everything is None:
            everything = KDTree(points)
        between = everything.query((points[first] + points[second]) / 2)[1]
        if (piece_of[between] >= 0).mean() >= 0.5:
            links.append((a, b))
    rows = np.array(links, np.int64).reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(links)), rows), shape=(len(pieces), len(pieces)))
    count, group = connected_components(graph, directed=False)
    return [
        np.sort(np.concatenate([pieces[i] for i in np.flatnonzero(group == each).tolist()]))
        for each in range(count)
    ]


def _boxes_that_meet(low: NDArray, high: NDArray) -> list[tuple[int, int]]:
    """Pairs of boxes, each once, that have a point in common; by sweeping along x."""
    order = np.argsort(low[:, 0], kind="stable")
    low, high = low[order], high[order]
    pairs: list[tuple[int, int]] = []
    for i in range(len(low)):
        end = int(np.searchsorted(low[:, 0], high[i, 0], "right"))
        later = np.arange(i + 1, end)
        meet = ((low[later] <= high[i]) & (high[later] >= low[i])).all(axis=1)
        pairs += [(int(order[i]), int(j)) for j in order[later[meet]]]
    return pairs


def _connected(
    mesh: Mesh, inside: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The vertices inside (V,), and for each the number of its connected part of the surface there."""
    runtime.current()  # before Taichi is imported: it says what it starts
    from ..maps.meshing import connected_parts

    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges = edges[inside[edges].all(axis=1)]
    count = len(mesh.vertices)
    part = np.arange(count)
    if len(edges):
        part = connected_parts(np.ascontiguousarray(edges[:, [0, 1, 1]]), count)
    vertices = np.flatnonzero(inside)
    return vertices, np.unique(part[vertices], return_inverse=True)[1]


def _split(vertices: NDArray[np.int64], part: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The vertices of each part, in ascending order."""
    if not len(vertices):
        return []
    order = np.argsort(part, kind="stable")
    return np.split(vertices[order], np.flatnonzero(np.diff(part[order])) + 1)


def _region(
    mesh: Mesh, relevance: NDArray, areas: NDArray, group: NDArray, threshold: float
) -> Region:
    points, share = mesh.vertices[group].astype(np.float64), areas[group] / areas[group].sum()
    sure = group[relevance[group] >= threshold]
    weight = areas[sure] / areas[sure].sum()
    score = float(weight @ relevance[sure])
    return Region(
        score,
        (score - threshold) * float(areas[sure].sum()),
        float(areas[group].sum()),
        share @ points,
        np.stack([points.min(axis=0), points.max(axis=0)]),
        group,
    )
