"""The mesh of maps that lie in tiles, tile by tile: all pieces together are the mesh of the whole
maps, vertex for vertex.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry.triangles import areas
from ..types import Mesh
from .meshing import MESH_BLOCK, connected_parts, drop_small_parts
from .property_map import PropertyMap
from .surface_map import SurfaceMap
from .tile_places import TILE, code_of, tile_of, tiles_around
from .working_set import MapMemory

BLOCKS = np.array(list(product(range(TILE // MESH_BLOCK), repeat=3)), np.int32)  # of a tile
OnPiece = Callable[[int, int], None]  # is told how many pieces are done, and how many there are
TOGETHER = 2  # tiles along an edge of those that are meshed at once
# bytes of maps in memory meanwhile: whatever is there is looked through for every piece, and more than a
# slab of a floor is not needed again
IN_MEMORY = 256_000_000


def mesh_pieces(
    memory: MapMemory,
    resolution: int,
    bounds: ArrayLike | None = None,
    on_piece: OnPiece = lambda done, total: None,
) -> Iterator[tuple[int, Mesh]]:
    """The mesh of a few tiles with surface at a time, within `bounds` if given, with the values of every
    property, and the number of the slab along x that it lies in, in ascending order; vertices on the
    borders of tiles come with each piece that has them, equal to the bit.

    `on_piece` is told how many of the pieces are done. Raises FileError or MapCorrupt where a tile
    cannot be read.
    """
    surfaces = memory.sets["surface"]
    surface = surfaces.map
    assert isinstance(surface, SurfaceMap)
    surface.flush()
    # cubes of the mesh span the centres of voxels, up to those of the tiles above
    tiles = {
        code_of((i + a, j + b, k + c))
        for code in surfaces.tiles()
        for i, j, k in [tile_of(code)]
        for a, b, c in product((0, 1), repeat=3)
    }
    groups: dict[tuple[int, ...], list[int]] = {}
    for code in sorted(tiles):
        groups.setdefault(tuple(each // TOGETHER for each in tile_of(code)), []).append(code)
    if bounds is not None:
        groups = {key: each for key, each in groups.items() if _meets(key, surface, bounds)}
    for done, ((slab, *_), codes) in enumerate(sorted(groups.items()), 1):
        with memory.at_most(IN_MEMORY):
            memory.near("surface", set(tiles_around(codes)))
            firsts = np.array([tile_of(code) for code in codes], np.int32) * (TILE // MESH_BLOCK)
            blocks = (firsts[:, None] + BLOCKS).reshape(-1, 3)
            mesh = surface.extract_mesh(resolution, bounds=bounds, blocks=blocks, flush=False)
            if len(mesh.faces):
                mesh = with_properties(memory, mesh)
        if len(mesh.faces):
            yield slab, mesh
        on_piece(done, len(groups))


def _meets(group: tuple[int, ...], surface: SurfaceMap, bounds: ArrayLike) -> bool:
    """Whether tiles that are meshed together may have a part of the mesh within bounds [m]."""
    size = TOGETHER * TILE * surface.voxel_size
    low, high = np.asarray(bounds, np.float64).reshape(2, 3)
    begin = np.array(group) * size
    edge = surface.voxel_size  # cubes of the mesh begin half a voxel before
    return bool((begin - edge <= high).all() and (begin + size + edge >= low).all())


def with_properties(memory: MapMemory, mesh: Mesh) -> Mesh:
    """A small mesh with the values of every property at its vertices."""
    for name, each in memory.sets.items():
        if isinstance(each.map, PropertyMap):
            memory.near(name, each.codes(mesh.vertices))
            mesh = mesh.with_attribute(name, each.map.query(mesh.vertices, flush=False))
    return mesh


def on_border(vertices: NDArray[np.float32], voxel_size: float) -> NDArray[np.bool_]:
    """Which vertices (V, 3) lie where two tiles meet."""
    places = (vertices / voxel_size + 0.5) / TILE  # cubes of the mesh begin half a voxel before
    return np.any(np.abs(places - np.rint(places)) < 1e-5, axis=1)


def parts_with_areas(mesh: Mesh) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """The connected part (V,) that each vertex of a piece belongs to, and the areas (P,) of these [m^2]."""
    first = connected_parts(mesh.faces, len(mesh.vertices))
    _, part = np.unique(first, return_inverse=True)
    part = part.reshape(-1).astype(np.int32)
    area = np.bincount(part[mesh.faces[:, 0]], areas(mesh.vertices, mesh.faces))
    return part, np.asarray(area, np.float64)


def joined_mesh(
    memory: MapMemory,
    resolution: int,
    min_area: float,
    bounds: ArrayLike | None = None,
    on_piece: OnPiece = lambda done, total: None,
) -> Mesh:
    """The mesh of all tiles at once, welded, within `bounds` if given; parts of less than `min_area`
    square metres are left out. Otherwise as `mesh_pieces`.
    """
    pieces = [mesh for _, mesh in mesh_pieces(memory, resolution, bounds, on_piece)]
    if not pieces:
        none = np.zeros((0, 3), np.float32)
        return Mesh(none, none.astype(np.int32), none)
    vertices = np.concatenate([mesh.vertices for mesh in pieces])
    _, first, number = np.unique(
        vertices.view([("", vertices.dtype)] * 3).ravel(), return_index=True, return_inverse=True
    )
    # in order of their first coming
    order = np.argsort(first)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    rows, starts = first[order], np.cumsum([0, *(len(mesh.vertices) for mesh in pieces)])
    faces = [mesh.faces + start for mesh, start in zip(pieces, starts, strict=False)]
    attributes = {
        name: np.concatenate([mesh.attributes[name] for mesh in pieces])[rows]
        for name in pieces[0].attributes
    }
    normals = [mesh.normals for mesh in pieces if mesh.normals is not None]
    faces = rank[number.reshape(-1)][np.concatenate(faces)].astype(np.int32)
    return drop_small_parts(
        Mesh(vertices[rows], faces, np.concatenate(normals)[rows], attributes), min_area
    )
