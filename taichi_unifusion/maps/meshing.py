"""Surface LIM -> welded mesh: the signed distance on a grid around every supported voxel, then
marching cubes (Sec. IV-B).

The grid comes in cubes that span the centres of eight neighbouring voxels: within one, the same
eight doubled voxels blend, so that a cube of samples is one matrix product with their concatenated
latents.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..geometry.triangles import areas, fill_normals
from ..kernels import marching_cubes as kernels
from ..kernels import query
from ..kernels.cells import CELLS
from ..kernels.visibility import interpolate_evidence
from ..types import Mesh
from .cube_tables import STEPS, marching_cubes_tables
from .cut_mesh import cut_mesh, without_unused
from .encoding import PositionEncoding
from .sheets import REACH

if TYPE_CHECKING:
    from .sheets import Sheet
    from .voxel_grid import VoxelGrid

# a lattice point as one integer, of the same order: its three indices and their offset
CODE_BITS, CODE_OFFSET = 21, 1 << 20
CODE_STEPS = np.array([1 << 2 * CODE_BITS, 1 << CODE_BITS, 1])  # of one point along x, y and z
MESH_BLOCK = 16  # cubes along a block of the mesh
BESIDE = 3  # voxels beside blocks that their cubes may have a corner at, and one more
# a voxel counts in the cubes of its own number and the next; normals change in those beside them
REACHES = (-1, 2)
NORMAL_UNIT = float(1 << 18)  # fixed-point one of summed normals, in squared grid spacings


def extract_mesh(
    grid: VoxelGrid,
    encoding: PositionEncoding,
    voxel_size: float,
    resolution: int,
    support_closing: int,
    min_evidence: float,
    sheets: Sequence[Sheet],
    slots: NDArray[np.int32],
    blocks: NDArray[np.int32] | None = None,
) -> Mesh:
    """Zero level of the blended field on `resolution`^3 cells a voxel, only where cells are
    supported; all of it, or what lies in `blocks` (M, 3) of MESH_BLOCK^3 cubes; `slots` (N,) are those
    of the voxels near these.

    A cell with `support_closing` of its 26 neighbours supported counts as supported. Where the map
    holds evidence, the mesh ends on the line where evidence falls below `min_evidence`.
    """
    parts, inside, every = [], [], _codes_near(grid, slots, blocks)
    for sheet in sheets:
        codes, support = _cubes(grid, every, sheet, support_closing, resolution)
        if sheet.near is not None:
            codes, support = _near(codes, support, sheet.near, resolution)
        if not len(codes):
            continue
        keys = _keys(codes)
        sdf = np.empty((len(keys), resolution**3), np.float32)
        query.sdf_grid(
            encoding.settings.rank,
            keys,
            grid.index,
            grid["latents"],
            sheet.rows,
            sheet.latents,
            *grid_basis(encoding, resolution),
            sdf,
        )
        vertices, faces, triangles = _march(
            keys, _upper_cubes(codes), support, sdf, resolution, voxel_size
        )
        parts.append((vertices, faces))
        if blocks is not None:
            inside.append(np.repeat(_lie_in(keys, blocks), triangles))
    if not parts:
        return Mesh(
            np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32)
        )
    wanted = None if blocks is None else np.concatenate(inside)  # (F,)
    vertices, faces = parts[0]
    if len(parts) > 1:
        vertices, faces, source = welded(parts)
        wanted = None if wanted is None else wanted[source]
    if "evidence" in grid and len(faces):
        evidence = np.empty(len(vertices), np.float32)
        interpolate_evidence(
            vertices, 1.0 / voxel_size, grid.index, grid["masks"], grid["evidence"], evidence
        )
        vertices, faces, source = cut_mesh(vertices, faces, evidence - np.float32(min_evidence))
        wanted = None if wanted is None else wanted[source]
    sums = np.zeros((len(vertices), 3), np.int32)
    if len(faces):
        kernels.sum_normals(vertices, faces, NORMAL_UNIT * (resolution / voxel_size) ** 2, sums)
    mesh = Mesh(vertices, faces, fill_normals(_unit(sums), vertices, faces))
    # the cubes around a block were there for the normals on its border
    return mesh if wanted is None else mesh.part(wanted)[0]


def _near(
    codes: NDArray[np.int64],
    support: NDArray[np.uint32],
    voxels: NDArray[np.int32],
    resolution: int,
) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
    """Of the cubes those that some voxels (N, 3) reach into, closed as `_cubes` gives them."""
    reached = np.isin(codes, _with_upper(np.unique(_codes(voxels))))
    reached &= (support[:, 0] | support[:, 1]) != 0
    return _closed(codes[reached], support[reached], resolution)


def welded(
    parts: Sequence[tuple[NDArray[np.float32], NDArray[np.int32]]],
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.intp]]:
    """One mesh of two, whose vertices at the very same places are one, and which face of both each of
    its own is: those that have two corners at one place go.
    """
    (vertices, faces), (more, other) = parts
    rows = np.concatenate([vertices, more])
    _, first, number = np.unique(rows.view("V12").ravel(), return_index=True, return_inverse=True)
    kept = np.sort(first)
    at = np.searchsorted(kept, first)[number.reshape(-1)].astype(np.int32)
    faces = np.concatenate([at[faces], at[other + len(vertices)]])
    proper = np.flatnonzero((faces != faces[:, [2, 0, 1]]).all(axis=1))
    return *without_unused(rows[kept], faces[proper]), proper


def mesh_blocks(keys: NDArray[np.int32]) -> NDArray[np.int32]:
    """The blocks (M, 3), in order, whose mesh may depend on the voxels `keys` (N, 3)."""
    corners = [_codes(_blocks(keys + reach)) for reach in product(REACHES, repeat=3)]
    return _keys(np.unique(np.concatenate(corners)))


def blocks_in(keys: NDArray[np.int32], box: NDArray[np.float64]) -> NDArray[np.int32]:
    """The blocks (M, 3) of voxels (N, 3) that may hold mesh in a box (2, 3) [voxels]."""
    if not len(keys):
        return np.zeros((0, 3), np.int32)
    blocks = mesh_blocks(keys)
    # a cube of the mesh spans the centres of voxels
    low, high = np.floor((box - 0.5) / MESH_BLOCK)
    return blocks[((blocks >= low) & (blocks <= high)).all(axis=1)]


def _blocks(keys: NDArray[np.int32]) -> NDArray[np.int32]:
    """The block (N, 3) that each cube (N, 3) lies in."""
    return keys // MESH_BLOCK


def _lie_in(keys: NDArray[np.int32], blocks: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Which cubes (N, 3) lie in one of the blocks."""
    return np.isin(_codes(_blocks(keys)), _codes(blocks))


def _unit(sums: NDArray[np.int32]) -> NDArray[np.float32]:
    """Vectors (V, 3) of length 1, or 0 where there is none; by columns, which is faster."""
    x, y, z = columns = np.ascontiguousarray(sums.T, np.float64)
    lengths, unit = np.maximum(np.sqrt(x * x + y * y + z * z), 1), np.empty(sums.shape, np.float32)
    for d in range(3):
        unit[:, d] = columns[d] / lengths
    return unit


def _ranks(chosen: NDArray[np.bool_]) -> NDArray[np.int32]:
    """The number (N,) that each of the chosen (N,) has among them."""
    return np.cumsum(chosen, dtype=np.int32) - 1


def drop_small_parts(mesh: Mesh, min_area: float) -> Mesh:
    """The mesh without connected parts of less than `min_area` square metres: mostly stray
    readings.
    """
    if min_area <= 0 or not len(mesh.faces):
        return mesh
    part, a = connected_parts(mesh.faces, len(mesh.vertices)), mesh.faces[:, 0]
    kept = np.bincount(part[a], areas(mesh.vertices, mesh.faces))[part] >= min_area  # (V,)
    faces = np.compress(kept[a], mesh.faces, axis=0)
    return Mesh(
        np.compress(kept, mesh.vertices, axis=0),
        _ranks(kept).take(faces),
        None if mesh.normals is None else np.compress(kept, mesh.normals, axis=0),
        {name: np.compress(kept, values, axis=0) for name, values in mesh.attributes.items()},
    )


def connected_parts(faces: NDArray[np.int32], vertices: int) -> NDArray[np.int32]:
    """For each of so many vertices, the first vertex (V,) of the part that its faces connect it to."""
    part, changed = np.arange(vertices, dtype=np.int32), np.ones(1, np.int32)
    while changed[0]:
        changed[0] = 0
        kernels.join_parts(faces, part, changed)
        runtime.synchronize()
    return part


def slots_near(grid: VoxelGrid, blocks: NDArray[np.int32] | None) -> NDArray[np.int32]:
    """Slots (N,) of the voxels that the mesh in `blocks` may depend on, or all, and of more."""
    slots = grid.used_slots()
    if blocks is None or not len(blocks):
        return slots
    keys, reach = grid.rows("keys", slots), BESIDE + REACH
    low, high = blocks.min(axis=0) * MESH_BLOCK, (blocks.max(axis=0) + 1) * MESH_BLOCK
    near = ((keys >= low - reach) & (keys <= high + reach)).all(axis=1)
    return np.compress(near, slots)


def _codes_near(
    grid: VoxelGrid, slots: NDArray[np.int32], blocks: NDArray[np.int32] | None
) -> NDArray[np.int64]:
    """Sorted codes of the cubes that have a corner at a voxel of `slots`, in or beside `blocks`."""
    codes = _with_upper(np.sort(_codes(grid.rows("keys", slots))))
    if blocks is not None:
        keys = _keys(codes)
        beside = [_lie_in(keys + step, blocks) for step in product((-1, 1), repeat=3)]
        codes = np.compress(np.any(beside, axis=0), codes)
    return codes


def _cubes(
    grid: VoxelGrid,
    codes: NDArray[np.int64],
    sheet: Sheet,
    support_closing: int,
    resolution: int,
) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
    """Sorted codes (Q,) of those cubes among some that hold surface of a sheet, and of cubes that close
    one that does, and their support masks (Q, 2).
    """
    support = np.empty((len(codes), 2), np.uint32)
    if len(codes):
        masks = grid["masks"], sheet.rows, sheet.masks
        query.corner_support(_keys(codes), grid.index, *masks, support_closing, support)
    with_surface = (support[:, 0] | support[:, 1]) != 0
    codes, support = np.compress(with_surface, codes), np.compress(with_surface, support, axis=0)
    return _closed(codes, support, resolution)


def _closed(
    codes: NDArray[np.int64], support: NDArray[np.uint32], resolution: int
) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
    """Cubes that hold surface, and those that close one that does, without support."""
    # the last cells of a cube need the samples above
    low, high = np.ascontiguousarray(support.T)
    wanted = [
        np.compress((low & last[0] | high & last[1]) != 0, codes) + step @ CODE_STEPS
        for step, last in zip(STEPS[1:], _last_cells(resolution)[1:], strict=True)
    ]
    closed = _sorted_once(np.concatenate([codes, *wanted]))
    closed_support = np.zeros((len(closed), 2), np.uint32)
    closed_support[np.searchsorted(closed, codes)] = support
    return closed, closed_support


def _last_cells(resolution: int) -> NDArray[np.uint32]:
    """(8, 2) support cells of a cube whose mesh cells reach into the cube at each of STEPS."""
    last = (2 * resolution - 1) * CELLS // (2 * resolution)  # holds the middle of the last cell
    places = np.indices([CELLS] * 3).reshape(3, -1).T  # (64, 3)
    touching = ((places == last) | (STEPS[:, None] == 0)).all(axis=2)  # (8, 64)
    return np.packbits(touching, axis=1).view(">u4").astype(np.uint32)


def _codes(keys: NDArray[np.int32]) -> NDArray[np.int64]:
    """Lattice points (N, 3) as single integers (N,) of the same order."""
    return (keys.astype(np.int64) + CODE_OFFSET) @ CODE_STEPS


def _keys(codes: NDArray[np.int64]) -> NDArray[np.int32]:
    """Lattice points (N, 3) of codes (N,)."""
    keys = np.empty((len(codes), 3), np.int32)
    for d in range(3):
        keys[:, d] = (codes >> (2 - d) * CODE_BITS & (1 << CODE_BITS) - 1) - CODE_OFFSET
    return keys


def _with_upper(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sorted codes of lattice points, and of all that lie at one of STEPS from one of them."""
    for step in CODE_STEPS[::-1]:
        codes = _sorted_once(np.concatenate([codes, codes + step]))
    return codes


def _sorted_once(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Sorted codes of which each comes once, from stretches that are in order."""
    codes.sort(kind="stable")  # merges what is in order
    return codes[np.diff(codes, prepend=-1) != 0]


def _upper_cubes(codes: NDArray[np.int64]) -> NDArray[np.int32]:
    """(Q, 8) row of the cube at each of STEPS from every cube, -1 where there is none; `codes` (Q,)
    are sorted.
    """
    upper, ended = np.empty((len(codes), 8), np.int32), np.append(codes, -1)
    for o in range(0, 8, 2):
        wanted = codes + STEPS[o] @ CODE_STEPS
        at = np.searchsorted(codes, wanted)
        found = ended[at] == wanted
        upper[:, o] = np.where(found, at, -1)
        at += found  # the next along z follows it
        upper[:, o + 1] = np.where(ended[at] == wanted + 1, at, -1)
    return upper


@lru_cache(maxsize=8)
def grid_basis(
    encoding: PositionEncoding, resolution: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Tent weight times f_posi (R^3, 8 l), and tent weight (R^3, 8), of the eight voxels at the
    samples of a cube.
    """
    samples = np.stack(
        np.meshgrid(*[np.arange(resolution) / resolution] * 3, indexing="ij"), axis=-1
    ).reshape(-1, 3)
    basis, tents = [], []
    for step in STEPS:
        # from the centre of voxel key - 1 + step, which is corner `step` of the cube
        t = (samples - step) / 2
        tents.append(np.prod(1 - 2 * np.abs(t), axis=1))
        basis.append(tents[-1][:, None] * encoding(t))
    return np.ascontiguousarray(np.hstack(basis), np.float32), np.ascontiguousarray(
        np.stack(tents, axis=1), np.float32
    )


def _march(
    keys, upper, support, sdf, resolution, voxel_size
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Vertices (V, 3) world [m] and faces (F, 3) of the zero level, and how many faces each cube
    has (Q,).
    """
    triangle_counts, flags, table, edge_table = marching_cubes_tables()
    cases, edges = np.zeros(sdf.shape, np.uint8), np.zeros(sdf.shape, np.int32)
    counts = np.empty((len(keys), 2), np.int32)  # vertices, triangles
    kernels.classify_cells(
        resolution, upper, support, sdf, triangle_counts, edge_table, flags, edges, cases, counts
    )
    starts = np.zeros((len(keys) + 1, 2), np.int32)
    np.cumsum(counts, axis=0, out=starts[1:])
    first, (v, f) = np.zeros(sdf.shape, np.int32), starts[-1]
    vertices, faces = np.empty((v, 3), np.float32), np.empty((f, 3), np.int32)
    if f:
        kernels.emit_mesh(
            resolution,
            keys,
            upper,
            sdf,
            edges,
            cases,
            starts,
            triangle_counts,
            table,
            edge_table,
            voxel_size,
            first,
            vertices,
            faces,
        )
    return vertices, faces, counts[:, 1]
