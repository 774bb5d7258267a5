"""A mesh of fewer triangles that keeps its shape and its borders, and how far it is from the full one.

Edges are collapsed where that moves the surface least (Garland and Heckbert 1997, by
`fast-simplification`). A mesh of a map has borders wherever nobody looked, and on flat surfaces an
edge of the border costs nothing to collapse: without care a tenth of the surface is eaten. So
every edge of the border gets a triangle that stands upright on it; what it measures keeps the
border in its place, and it goes away with the first collapses (the "boundary constraints" of the
paper's section 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, MissingDependency
from ..geometry.triangles import (
    SurfaceDistance,
    areas,
    sample_surface,
    used_vertices,
    vertex_normals,
)
from ..types import Mesh
from .mesh_checks import check_mesh

# how fast the error that is allowed grows: the first that gets there is taken; the careful one gets to
# about a tenth of the triangles
HASTE, CAREFUL_SHARE = (3.0, 5.0, 7.0), 0.12
REACHED = 1.05  # times the triangles asked for
SAMPLES = 20_000  # points that each surface is measured at
MIN_AREA = 1e-12  # [m^2] of a triangle


@dataclass(frozen=True)
class SurfaceError:
    """How far two surfaces lie apart, by distances from samples of each to the other."""

    rms_mm: float
    p99_mm: float  # 99 % of the samples are nearer
    largest_mm: float

    def __str__(self) -> str:
        return (
            f"{self.rms_mm:.2f} mm off the full mesh (RMS), 99 % within {self.p99_mm:.1f} mm, "
            f"at most {self.largest_mm:.0f} mm"
        )


def simplify(mesh: Mesh, triangles: int) -> Mesh:
    """The mesh with about so many triangles, with normals and without attributes; itself where it
    has no more.

    Raises InputError where the mesh is empty, not finite or inconsistent or nothing is to be left
    of it, MissingDependency without fast-simplification.
    """
    if triangles < 1:
        raise InputError(f"simplify: at least one triangle must be left, got {triangles}")
    mesh = check_mesh(mesh, "simplify")
    if len(mesh.faces) <= triangles:
        return mesh
    try:
        import fast_simplification as library
    except ImportError:
        raise MissingDependency(
            "fewer triangles and textures need fast-simplification and xatlas: "
            "pip install 'taichi-unifusion[texture]'"
        ) from None
    fins, tips = _fins(mesh)
    points = np.concatenate([mesh.vertices, tips])
    faces = np.concatenate([mesh.faces, fins])
    run: Any = library.simplify  # its types know float64 alone
    collapses = None
    for haste in HASTE[int(triangles < CAREFUL_SHARE * len(mesh.faces)) :]:
        _, found, collapses = run(
            points, faces, target_count=triangles, agg=haste, return_collapses=True
        )
        if len(found) <= REACHED * triangles:
            break
    vertices, faces, moved = library.replay_simplification(points, faces, collapses)
    surface = np.zeros(len(vertices), bool)
    kept = moved[: len(mesh.vertices)]
    surface[kept[kept >= 0]] = True  # vertices without a triangle are gone
    faces = faces[surface[faces].all(axis=1)]  # without the last fins
    faces = faces[areas(vertices, faces) > MIN_AREA]
    if not len(faces):
        raise InputError(f"simplify: nothing is left of the mesh at {triangles} triangles")
    used, faces = used_vertices(faces)
    vertices = vertices[used].astype(np.float32)
    return Mesh(vertices, faces, vertex_normals(vertices, faces))


def border_edges(faces: NDArray[np.int32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The edges (B, 2) that belong to one triangle only, as they run in it, and its row (B,)."""
    edges = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)]).astype(np.int64)
    code = edges.min(axis=1) * (int(faces.max()) + 1) + edges.max(axis=1)
    _, first, count = np.unique(code, return_index=True, return_counts=True)
    single = first[count == 1]
    return edges[single], single % len(faces)


def _fins(mesh: Mesh) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Triangles (B, 3) that stand on the edges of the border, and their further vertices (B, 3),
    which are numbered after those of the mesh.
    """
    edges, owner = border_edges(mesh.faces)
    a, b = mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]]
    p, q, r = (mesh.vertices[mesh.faces[owner, k]] for k in range(3))
    across = np.cross(q - p, r - p)
    across /= np.linalg.norm(across, axis=1, keepdims=True) + 1e-20
    tips = (a + b) / 2 + across * np.linalg.norm(b - a, axis=1, keepdims=True)
    fins = np.column_stack([edges[:, ::-1], len(mesh.vertices) + np.arange(len(edges))])
    return fins.astype(np.int32), tips.astype(np.float32)


def surface_error(mesh: Mesh, full: Mesh) -> SurfaceError:
    """How far the surface of a mesh lies from that of the full one, measured from both."""
    rng = np.random.default_rng(0)
    distances = np.concatenate(
        [
            SurfaceDistance(to.vertices, to.faces)(
                sample_surface(of.vertices, of.faces, SAMPLES, rng)
            )
            for of, to in ((mesh, full), (full, mesh))
        ]
    )
    millimetres = 1e3 * distances
    return SurfaceError(
        float(np.sqrt(np.mean(millimetres**2))),
        float(np.percentile(millimetres, 99)),
        float(millimetres.max()),
    )
