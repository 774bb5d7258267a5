"""Marching cubes on sparse cubes of samples, with vertices shared across cube borders (Lorensen and
Cline).
"""

import taichi as ti

from .arrays import Bytes2, Floats2, Ints1, Ints2, Masks2, row3
from .cells import CELLS
from .query import UNKNOWN


@ti.func
def sample_at(q: ti.i32, ijk: ti.template(), resolution: ti.i32, upper: ti.template()):
    """Cube and sample number of lattice sample ijk of cube q, which may lie in a cube above; cube
    -1 where there is none.
    """
    over = ti.cast(ijk >= resolution, ti.i32)
    cube = upper[q, over[0] * 4 + over[1] * 2 + over[2]]
    at = ijk - over * resolution
    return cube, (at[0] * resolution + at[1]) * resolution + at[2]


@ti.func
def corners_behind(k: ti.i32, cubes: ti.template(), samples: ti.template(), sdf: ti.template()):
    """Bit 2 m set where sample `samples[m] + k` of cube `cubes[m]`, for m = 0..3, lies behind the
    surface; -1 where one of the four is unknown.
    """
    behind, known = 0, True
    for m in ti.static(range(4)):
        value = UNKNOWN
        if cubes[m] >= 0:
            value = sdf[cubes[m], samples[m] + k]
        if value >= 0.5 * UNKNOWN:
            known = False
        if value < 0:
            behind |= 1 << 2 * m
    return behind if known else -1


@ti.func
def column_support(
    support: ti.template(), q: ti.i32, i: ti.i32, j: ti.i32, resolution: ti.i32
) -> ti.i32:
    """The four support cells, lowest first, that hold the middles of the mesh cells (i, j, k) of
    cube q.
    """
    x, y = support_cell(i, resolution), support_cell(j, resolution)
    lowest = (x * CELLS + y) * CELLS
    word = support[q, lowest >> 5]
    return ti.cast(word >> ti.cast(32 - CELLS - (lowest & 31), ti.u32), ti.i32) & (1 << CELLS) - 1


@ti.func
def support_cell(i: ti.i32, resolution: ti.i32) -> ti.i32:
    """The support cell, along an axis, that contains the middle of mesh cell i."""
    return (2 * i + 1) * CELLS // (2 * resolution)


@ti.func
def mark_edges(
    # in:
    flags: ti.i32,
    q: ti.i32,
    ijk: ti.template(),
    resolution: ti.i32,
    upper: ti.template(),
    corner_edges: ti.template(),
    # in and out:
    edges: ti.template(),
):
    """Set the bit of every edge of cell ijk that `flags` names."""
    for e in range(12):
        if flags >> e & 1:
            cube, s = sample_at(q, ijk + row3(corner_edges, e), resolution, upper)
            bit = 1 << corner_edges[e, 3]
            if edges[cube, s] & bit == 0:  # three of four times another cell was here before
                ti.atomic_or(edges[cube, s], bit)


@ti.kernel
def classify_cells(
    # in:
    resolution: ti.i32,
    upper: Ints2,  # (Q, 8) cube at step (o / 4, o / 2 % 2, o % 2), or -1
    support: Masks2,  # (Q, 2)
    sdf: Floats2,  # (Q, R^3)
    triangle_counts: Ints1,  # (256,)
    corner_edges: Ints2,  # (12, 4) lower corner (3) and axis of each cell edge
    edge_flags: Ints1,  # (256,) bit e: the case has a vertex on edge e
    # in and out:
    edges: Ints2,  # (Q, R^3) |= bit d: a vertex lies on the edge from the sample along axis d
    cases: Bytes2,  # (Q, R^3) case of each cell; stays 0 where empty or unsupported
    # out:
    counts: Ints2,  # (Q, 2) vertices on the edges from a cube's samples, triangles of its cells
):
    for q in range(sdf.shape[0]):
        total = 0
        columns = resolution * resolution if support[q, 0] | support[q, 1] else 0
        for column in range(columns):
            ijk = ti.Vector([column // resolution, column % resolution, 0])
            supported = column_support(support, q, ijk[0], ijk[1], resolution)
            layers = resolution if supported != 0 else 0
            # the columns of samples at the cell's four lower corners, and the cubes above them
            cubes, samples, above = ti.Vector([0] * 4), ti.Vector([0] * 4), ti.Vector([0] * 4)
            for m in ti.static(range(4)):
                corner = ijk + ti.Vector([m // 2, m % 2, 0])
                cubes[m], samples[m] = sample_at(q, corner, resolution, upper)
                above[m], _ = sample_at(
                    q, corner + ti.Vector([0, 0, resolution]), resolution, upper
                )
            low = corners_behind(0, cubes, samples, sdf)
            for k in range(layers):
                ijk[2] = k
                high = 0
                if k + 1 < resolution:
                    high = corners_behind(k + 1, cubes, samples, sdf)
                else:
                    high = corners_behind(0, above, samples, sdf)
                case = 0  # bit o is set where corner o (x slowest) lies behind the surface
                cell = CELLS - 1 - support_cell(k, resolution)
                if low >= 0 and high >= 0 and supported >> cell & 1:
                    case = low | high << 1
                low = high
                if case != 0:
                    cases[q, column * resolution + k] = ti.cast(case, ti.u8)
                total += triangle_counts[case]
                if triangle_counts[case] > 0:
                    mark_edges(edge_flags[case], q, ijk, resolution, upper, corner_edges, edges)
        counts[q, 1] = total
    for q in range(sdf.shape[0]):  # once all cells have marked their edges
        total = 0
        for s in range(sdf.shape[1]):
            total += ti.math.popcnt(edges[q, s])
        counts[q, 0] = total


@ti.kernel
def emit_mesh(
    # in:
    resolution: ti.i32,
    keys: Ints2,  # (Q, 3) lattice corners, in voxels; a cube spans [key - 1/2, key + 1/2)
    upper: Ints2,  # (Q, 8)
    sdf: Floats2,  # (Q, R^3)
    edges: Ints2,  # (Q, R^3)
    cases: Bytes2,  # (Q, R^3)
    starts: Ints2,  # (Q + 1, 2) first vertex and triangle of each cube; at last V and F
    triangle_counts: Ints1,  # (256,)
    triangle_edges: Ints2,  # (256, 15) cell edges, three a triangle
    corner_edges: Ints2,  # (12, 4)
    voxel_size: ti.f32,
    # in and out:
    first: Ints2,  # (Q, R^3) first vertex on the edges of a sample; as it was where there is none
    # out:
    vertices: Floats2,  # (V, 3) world [m]
    faces: Ints2,  # (F, 3)
):
    for q in range(sdf.shape[0]):
        v = starts[q, 0]
        samples = sdf.shape[1] if v < starts[q + 1, 0] else 0
        for s in range(samples):
            if edges[q, s] != 0:
                first[q, s] = v
                for axis in range(3):
                    if edges[q, s] >> axis & 1:
                        x = crossing(q, s, axis, resolution, upper, sdf)
                        for d in ti.static(range(3)):
                            vertices[v, d] = (keys[q, d] + x[d]) * voxel_size
                        v += 1
    for q in range(sdf.shape[0]):
        f = starts[q, 1]
        cells = sdf.shape[1] if f < starts[q + 1, 1] else 0
        for c in range(cells):
            case = ti.cast(cases[q, c], ti.i32)
            for t in range(triangle_counts[case]):
                for k in range(3):
                    e = triangle_edges[case, 3 * t + k]
                    corner = lattice_place(c, resolution) + row3(corner_edges, e)
                    cube, s = sample_at(q, corner, resolution, upper)
                    # vertices of a sample are numbered by axis
                    before = edges[cube, s] & (1 << corner_edges[e, 3]) - 1
                    faces[f, k] = first[cube, s] + ti.math.popcnt(before)
                f += 1


@ti.func
def crossing(
    q: ti.i32,
    s: ti.i32,
    axis: ti.i32,
    resolution: ti.i32,
    upper: ti.template(),
    sdf: ti.template(),
):
    """Where the field is zero on the edge from sample s of cube q along an axis, in voxels from the
    cube's key.
    """
    ijk, along = lattice_place(s, resolution), ti.Vector([axis == 0, axis == 1, axis == 2])
    cube, other = sample_at(q, ijk + ti.cast(along, ti.i32), resolution, upper)
    a, b = sdf[q, s], sdf[cube, other]
    return (ti.cast(ijk, ti.f32) + ti.cast(along, ti.f32) * (a / (a - b))) / resolution - 0.5


@ti.func
def lattice_place(s: ti.i32, resolution: ti.i32):
    """Sample or cell number s of a cube as an integer triple."""
    return ti.Vector([s // (resolution * resolution), s // resolution % resolution, s % resolution])


@ti.kernel
def sum_normals(
    # in:
    vertices: Floats2,  # (V, 3)
    faces: Ints2,  # (F, 3)
    per_area: ti.f32,  # scale of the cross products, so that sums fit the integers
    # in and out:
    normals: Ints2,  # (V, 3) += area-weighted face normals, fixed point: the same in any order
):
    for f in range(faces.shape[0]):
        a, b, c = (
            row3(vertices, faces[f, 0]),
            row3(vertices, faces[f, 1]),
            row3(vertices, faces[f, 2]),
        )
        n = (b - a).cross(c - a) * per_area
        for k in ti.static(range(3)):
            for d in ti.static(range(3)):
                ti.atomic_add(normals[faces[f, k], d], ti.cast(ti.round(n[d]), ti.i32))


@ti.kernel
def join_parts(
    # in:
    faces: Ints2,  # (F, 3)
    # in and out:
    part: Ints1,  # (V,) a vertex of the same connected part, in the end the first of them all
    # out:
    changed: Ints1,  # (1,) 1 unless this was the last round
):
    # the faces' corners take over the lowest number among them, also at their roots
    for f in range(faces.shape[0]):
        a, b, c = part[faces[f, 0]], part[faces[f, 1]], part[faces[f, 2]]
        lowest = ti.min(a, b, c)
        if a != lowest or b != lowest or c != lowest:
            changed[0] = 1
            ti.atomic_min(part[a], lowest)
            ti.atomic_min(part[b], lowest)
            ti.atomic_min(part[c], lowest)
    for v in range(part.shape[0]):  # then all follow their numbers to the root
        root = part[v]
        while part[root] != root:
            root = part[root]
        part[v] = root
