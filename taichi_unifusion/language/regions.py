"""Where on a mesh something is: connected parts of high relevance, as boxes, best first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..errors import InputError
from ..geometry.triangles import vertex_areas
from ..types import Mesh

THRESHOLD = 0.5  # relevance from which a vertex belongs to a region: the query beats all rivals
JOIN = 0.0  # [m] between parts of one region: none, as 0.05 finds 14 instead of 15 of 22 boxes of the house
MIN_AREA = 0.01  # [m^2] of a region; smaller ones are noise


@dataclass(frozen=True)
class Region:
    """A connected part of the surface that answers a query."""

    score: float  # relevance, mean over its area
    area: float  # [m^2]
    centroid: NDArray[np.float64]  # (3,) world [m], of its area
    box: NDArray[np.float64]  # (2, 3) world [m]: lowest and highest corner
    vertices: NDArray[np.int64]  # of the mesh


def find_regions(
    mesh: Mesh,
    relevance: NDArray,
    *,
    threshold: float = THRESHOLD,
    min_area: float = MIN_AREA,
    join: float = JOIN,
) -> list[Region]:
    """Connected parts of a mesh where `relevance` (V,) reaches the threshold, those with the largest
    integral of relevance above it first. Parts that come as near as `join` [m] are one: a sofa that is
    seen in two pieces.

    Raises InputError for a relevance of another mesh or a threshold outside 0..1.
    """
    runtime.current()  # before Taichi is imported: it says what it starts
    from ..maps.meshing import connected_parts

    count = len(mesh.vertices)
    if relevance.shape != (count,):
        raise InputError(f"regions: relevance must be ({count},), got {relevance.shape}")
    if not 0 < threshold < 1 or min_area < 0:
        raise InputError(
            f"regions: need 0 < threshold < 1 and min_area >= 0, got {threshold} and {min_area}"
        )
    inside = relevance >= threshold
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges = edges[inside[edges].all(axis=1)]
    part = (
        connected_parts(np.ascontiguousarray(edges[:, [0, 1, 1]]), count)
        if len(edges)
        else np.arange(count)
    )
    if join > 0:
        part = join_near(mesh.vertices, part, np.flatnonzero(inside), join)
    areas = vertex_areas(mesh.vertices, mesh.faces)
    vertices = np.flatnonzero(inside)
    order = vertices[np.argsort(part[vertices], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(part[order])) + 1) if len(order) else []
    regions = [
        _region(mesh, relevance, areas, group)
        for group in groups
        if areas[group].sum() >= max(min_area, 1e-12)
    ]
    return sorted(regions, key=lambda region: -(region.score - threshold) * region.area)


def join_near(
    vertices: NDArray, part: NDArray, chosen: NDArray, distance: float
) -> NDArray[np.int64]:
    """The part (V,) of every vertex, where those of the chosen (N,) vertices within about `distance` [m]
    of another part are put together; points are rounded to half of it.
    """
    joined = np.asarray(part, np.int64).copy()
    if not len(chosen):
        return joined
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    spots = np.floor(vertices[chosen] / (distance / 2)).astype(np.int64)
    rows = np.unique(np.column_stack([spots, joined[chosen]]), axis=0)
    numbers, of = np.unique(rows[:, 3], return_inverse=True)
    pairs = of[KDTree(rows[:, :3]).query_pairs(2.0, output_type="ndarray")].reshape(-1, 2)
    pairs = np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(numbers), len(numbers)))
    _, group = connected_components(links, directed=False)
    joined[chosen] = group[np.searchsorted(numbers, joined[chosen])]
    return joined


def _region(mesh: Mesh, relevance: NDArray, areas: NDArray, group: NDArray) -> Region:
    points, share = mesh.vertices[group].astype(np.float64), areas[group] / areas[group].sum()
    return Region(
        float(share @ relevance[group]),
        float(areas[group].sum()),
        share @ points,
        np.stack([points.min(axis=0), points.max(axis=0)]),
        group,
    )
