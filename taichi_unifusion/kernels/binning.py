"""Per-frame binning: points -> sums in the cells of the touched blocks -> samples for the
regression (Sec. IV-B).

Sums over points are 64-bit fixed-point integers, so that they do not depend on the order in which
threads add them. The kernel that reads the sums last resets them to 0; they are cleared nowhere
else.
"""

import taichi as ti

from .arrays import Floats1, Floats2, Ints1, Ints2, Masks2, Sums3, row3
from .cells import BLOCK_CELLS, CELLS, cell_bit, cell_center, cell_in_lattice, cell_of, first_cell
from .index import INDEX_HALF, in_range, touch, voxel_of

FIXED = float(1 << 24)  # fixed-point one: steps of 6e-8, room for 5e11 in sums


@ti.kernel
def bin_points(
    # in:
    points: Floats2,  # (N, 3) world [m]
    values_0: Floats2,  # (N, c_0); any array where c_0 is 0
    values_1: Floats2,  # (N, c_1)
    values_2: Floats2,  # (N, c_2)
    values_3: Floats2,  # (N, c_3)
    channels: ti.template(),  # c_i of the four
    per_meter: ti.f32,
    chunk: ti.i32,
    with_positions: ti.template(),
    index: ti.template(),
    # in and out:
    counts: Ints2,  # (B, 64) += points in the cell
    # (B, 64, sum of c_i [+ 3]) += values side by side, then position from the cell centre [voxels]
    sums: Sums3,
):
    for part in range((points.shape[0] + chunk - 1) // chunk):
        width = ti.static(sum(channels) + (3 if with_positions else 0))
        place = ti.Vector([INDEX_HALF * CELLS, 0, 0])  # of the cell in the lattice of all cells
        b, run = -1, 0
        # in floats over a run: one thread adds it, always in the same order
        total = ti.Vector([0.0] * max(width, 1))
        for n in range(part * chunk, ti.min((part + 1) * chunk, points.shape[0])):
            x = row3(points, n) * (per_meter * CELLS)
            at = ti.floor(x, ti.i32)
            if any(at != place):  # a run of points in one cell costs one write
                if run > 0:
                    add_run(width, b, place, run, total, counts, sums)
                if any((at >> 2) != (place >> 2)):
                    b = index.block[(at >> 2) + INDEX_HALF]
                place = at
                run = 0
                total.fill(0.0)
            run += 1
            for i, values in ti.static(enumerate((values_0, values_1, values_2, values_3))):
                for c in ti.static(range(channels[i])):
                    total[ti.static(sum(channels[:i])) + c] += values[n, c]
            if ti.static(with_positions):
                for d in ti.static(range(3)):
                    total[width - 3 + d] += (x[d] - at[d] - 0.5) / CELLS
        if run > 0:
            add_run(width, b, place, run, total, counts, sums)


@ti.func
def add_run(
    width: ti.template(),
    b: ti.i32,
    place: ti.template(),
    run: ti.i32,
    total: ti.template(),
    counts: ti.template(),
    sums: ti.template(),
):
    """Add the sums over a run of points to their cell."""
    cell = cell_in_lattice(place)
    ti.atomic_add(counts[b, cell], run)
    for c in ti.static(range(width)):
        ti.atomic_add(sums[b, cell, c], ti.cast(ti.round(total[c] * FIXED), ti.i64))


@ti.func
def surfel(
    b: ti.i32, cell: ti.i32, keys: ti.template(), counts: ti.template(), sums: ti.template()
):
    """Mean point [voxels] and mean unit normal of the points in a cell; a zero normal where they
    cancel.
    """
    scale = 1.0 / (ti.cast(counts[b, cell], ti.f32) * FIXED)
    normal = ti.Vector([ti.cast(sums[b, cell, d], ti.f32) * scale for d in ti.static(range(3))])
    point = ti.Vector([ti.cast(sums[b, cell, 3 + d], ti.f32) * scale for d in ti.static(range(3))])
    point += cell_center(cell) + row3(keys, b)
    length = normal.norm()
    return point, ti.select(length > 0.1, normal / ti.max(length, 1e-6), ti.Vector([0.0, 0.0, 0.0]))


@ti.kernel
def touch_surfel_samples(
    # in:
    blocks: ti.i32,
    counts: Ints2,  # (B, 64)
    sums: Sums3,  # (B, 64, 6) normals, positions
    offsets: Floats1,  # (S,) along the normal [voxels]
    frame: ti.i32,
    # in and out:
    index: ti.template(),
    keys: Ints2,  # (B, 3) voxel of each block; those of the samples are added
    counters: Ints1,  # (2,) += [blocks, 0]
):
    # cells, not blocks: enough of them to share out evenly
    for b, cell in ti.ndrange(blocks, BLOCK_CELLS):
        if counts[b, cell] > 0:
            point, normal = surfel(b, cell, keys, counts, sums)
            for s in range(offsets.shape[0]):
                ijk = voxel_of(point + offsets[s] * normal)
                if any(ijk != row3(keys, b)) and in_range(ijk):
                    touch(ijk, frame, index, keys, counters)


@ti.kernel
def bin_surfel_samples(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    offsets: Floats1,  # (S,) along the normal [voxels]
    with_normals: ti.template(),
    index: ti.template(),
    # in and out:
    counts: Ints2,  # (B, 64) read, then 0
    sums: Sums3,  # (B, 64, 6) normals, positions; read, then 0
    sample_counts: Ints2,  # (B, 64) += points behind the sample
    # (B, 64, 1 [+ 3]) += their signed distance to the surfel's plane [voxels], and its normal
    sample_sums: Sums3,
):
    # cells, not blocks: enough of them to share out evenly
    for b, cell in ti.ndrange(blocks, BLOCK_CELLS):
        if counts[b, cell] > 0:
            point, normal = surfel(b, cell, keys, counts, sums)
            for s in range(offsets.shape[0]):
                x = point + offsets[s] * normal
                ijk = voxel_of(x)
                if in_range(ijk) and normal.norm() > 0:
                    at = b
                    if any(ijk != row3(keys, b)):
                        at = index.block[ijk + INDEX_HALF]
                    target = cell_of(x, ijk)
                    distance = normal.dot(cell_center(target) + ijk - point)
                    count = counts[b, cell]
                    ti.atomic_add(sample_counts[at, target], count)
                    ti.atomic_add(
                        sample_sums[at, target, 0],
                        ti.cast(ti.round(distance * FIXED), ti.i64) * count,
                    )
                    if ti.static(with_normals):
                        for d in ti.static(range(3)):
                            along = ti.cast(ti.round(normal[d] * FIXED), ti.i64)
                            ti.atomic_add(sample_sums[at, target, 1 + d], along * count)
            counts[b, cell] = 0
            for c in ti.static(range(6)):
                sums[b, cell, c] = ti.i64(0)


@ti.kernel
def mark_cells(
    # in:
    blocks: ti.i32,
    counts: Ints2,  # (B, 64)
    minimum: ti.i32,
    # out:
    masks: Masks2,  # (B, 2) cells that hold points
    # (B, 2) the same, for at least `minimum` points, or half a sparse block's mean; 0 sets all
    support: Masks2,
    totals: Ints1,  # (B,) points
    cells: Ints1,  # (B,) cells that hold points
):
    for b in range(blocks):
        total, occupied = 0, 0
        for half in ti.static(range(2)):
            mask = ti.u32(0)
            for k in range(32):
                count = counts[b, half * 32 + k]
                if count > 0:
                    mask |= cell_bit(k)
                    total += count
                    occupied += 1
            masks[b, half] = mask
        totals[b], cells[b] = total, occupied
        for half in ti.static(range(2)):
            enough = ti.u32(0)
            if total > 0:
                for k in range(32):
                    count = counts[b, half * 32 + k]
                    if count >= minimum or 2 * count * occupied >= total:
                        enough |= cell_bit(k)
            support[b, half] = enough


@ti.kernel
def compact_cells(
    # in:
    blocks: ti.i32,
    starts: Ints1,  # (B,) first row of each block
    masks: Masks2,  # (B, 2) cells that hold points
    channels: ti.template(),
    # in and out:
    counts: Ints2,  # (B, 64) read, then 0
    sums: Sums3,  # (B, 64, c) read, then 0
    # out:
    # (M, 1 + c) for every cell with points, in order: root of its count, mean values times that
    cells: Floats2,
):
    for b in range(blocks):
        row = starts[b]
        for half in range(2):
            mask = masks[b, half]
            while mask != 0:
                k = first_cell(mask)
                mask ^= cell_bit(k)
                cell = half * 32 + k
                root = ti.sqrt(ti.cast(counts[b, cell], ti.f32))
                scale = 1.0 / (root * FIXED)
                cells[row, 0] = root
                for c in ti.static(range(channels)):
                    cells[row, 1 + c] = ti.cast(sums[b, cell, c], ti.f32) * scale
                    sums[b, cell, c] = ti.i64(0)
                counts[b, cell] = 0
                row += 1
