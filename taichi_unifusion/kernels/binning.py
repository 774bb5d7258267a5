"""Binning: points -> sums in the cells of the touched blocks -> samples for the regression
(Sec. IV-B).

Sums over points are 64-bit fixed-point integers, so that they do not depend on the order in which
threads add them, or frames. The kernel that reads the sums last resets them to 0; they are cleared
nowhere else.
"""

import taichi as ti

from .arrays import Floats1, Floats2, Ints1, Ints2, Masks2, Sums3, row3
from .cells import BLOCK_CELLS, CELLS, cell_bit, cell_center, cell_in_lattice, cell_of, first_cell
from .index import INDEX_HALF, block_in, in_range, touch, voxel_of

FIXED = float(1 << 24)  # fixed-point one: steps of 6e-8, room for 5e11 in sums
# Voxels a metre, then powers of two that bring the values of three arrays to where these steps are fine.
Scales = ti.types.vector(4, ti.f32)

# Columns of `keys` after a block's voxel: bits of the frames that saw points in it, or samples.
POINT_FRAMES, SAMPLE_FRAMES = 3, 4
KEY_COLUMNS = 5


@ti.kernel
def bin_points(
    # in:
    found: Ints1,  # (R,) points in each run
    slots: ti.i32,  # places of a run
    points: Floats2,  # (R slots, 3) world [m]
    counts: Ints1,  # (R slots,) pixels behind each; 0: left out
    values_0: Floats2,  # (R slots, c_0); any array where c_0 is 0
    values_1: Floats2,  # (R slots, c_1)
    values_2: Floats2,  # (R slots, c_2)
    channels: ti.template(),  # c_i of the three
    scales: Scales,  # of the points, and of the values of the three
    frame: ti.i32,  # a bit for the frame of its window
    with_positions: ti.template(),
    index: ti.template(),
    # in and out:
    keys: Ints2,  # (B, 5) POINT_FRAMES |= frame
    # (B, 64, 1 + sum of c_i [+ 3]) += pixels, their scaled values side by side, and their position
    # from the cell centre [voxels]
    sums: Sums3,
):
    for part in range(found.shape[0]):
        width = ti.static(sum(channels) + (3 if with_positions else 0))
        place = ti.Vector([INDEX_HALF * CELLS, 0, 0])  # of the cell in the lattice of all cells
        b, run = -1, 0
        # in floats over a run: one thread adds it, always in the same order
        total = ti.Vector([0.0] * max(width, 1))
        for n in range(part * slots, part * slots + found[part]):
            count = counts[n]
            if count > 0:
                x = row3(points, n) * (scales[0] * CELLS)
                at = ti.floor(x, ti.i32)
                if any(at != place):  # a run of points in one cell costs one write
                    if run > 0:
                        add_run(width, b, cell_in_lattice(place), run, total, 1, sums)
                    if any((at >> 2) != (place >> 2)):
                        b = block_in(index, at >> 2)
                        mark_frame(b, frame, 1, keys)
                    place = at
                    run = 0
                    total.fill(0.0)
                run += count
                weight = ti.cast(count, ti.f32)
                for i, values in ti.static(enumerate((values_0, values_1, values_2))):
                    scaled = weight * scales[1 + i]
                    for c in ti.static(range(channels[i])):
                        total[ti.static(sum(channels[:i])) + c] += values[n, c] * scaled
                if ti.static(with_positions):
                    for d in ti.static(range(3)):
                        total[width - 3 + d] += (x[d] - at[d] - 0.5) / CELLS * weight
        if run > 0:
            add_run(width, b, cell_in_lattice(place), run, total, 1, sums)


@ti.func
def add_run(
    # in:
    width: ti.template(),
    b: ti.i32,
    cell: ti.i32,
    run: ti.i32,
    total: ti.template(),
    sign: ti.i32,
    # in and out:
    sums: ti.template(),
):
    """Add the sums over a run of points to their cell; with sign -1 take them back."""
    ti.atomic_add(sums[b, cell, 0], ti.cast(sign * run, ti.i64))
    for c in ti.static(range(width)):
        # rounded so: `round` is a call of a function on the CPU
        fixed = ti.cast(ti.floor(total[c] * FIXED + 0.5), ti.i64)
        ti.atomic_add(sums[b, cell, 1 + c], sign * fixed)


@ti.func
def mark_frame(b: ti.i32, frame: ti.i32, sign: ti.i32, keys: ti.template()):
    """Note that a frame saw block b, or with sign -1 that it did not."""
    if sign > 0:
        if keys[b, POINT_FRAMES] & frame == 0:
            ti.atomic_or(keys[b, POINT_FRAMES], frame)
    else:
        ti.atomic_and(keys[b, POINT_FRAMES], ~frame)


@ti.func
def surfel(b: ti.i32, cell: ti.i32, keys: ti.template(), sums: ti.template()):
    """Mean point [voxels] and mean unit normal of the points in a cell; a zero normal where they
    cancel.
    """
    scale = 1.0 / (ti.cast(sums[b, cell, 0], ti.f32) * FIXED)
    normal = ti.Vector([ti.cast(sums[b, cell, 1 + d], ti.f32) * scale for d in ti.static(range(3))])
    point = ti.Vector([ti.cast(sums[b, cell, 4 + d], ti.f32) * scale for d in ti.static(range(3))])
    point += cell_center(cell) + row3(keys, b)
    length = normal.norm()
    return point, ti.select(length > 0.1, normal / ti.max(length, 1e-6), ti.Vector([0.0, 0.0, 0.0]))


@ti.kernel
def touch_surfel_samples(
    # in:
    blocks: ti.i32,
    sums: Sums3,  # (B, 64, 7) counts, normals, positions
    offsets: Floats1,  # (S,) along the normal [voxels]
    stamp: ti.i32,
    # in and out:
    index: ti.template(),
    keys: Ints2,  # (B, 3) voxel of each block; those of the samples are added
    counters: Ints1,  # (2,) += [blocks, 0]
):
    # cells, not blocks: enough of them to share out evenly
    for b, cell in ti.ndrange(blocks, BLOCK_CELLS):
        if sums[b, cell, 0] > 0:
            point, normal = surfel(b, cell, keys, sums)
            for s in range(offsets.shape[0]):
                ijk = voxel_of(point + offsets[s] * normal)
                if any(ijk != row3(keys, b)) and in_range(ijk):
                    touch(ijk, stamp, index, keys, counters)


@ti.kernel
def bin_surfel_samples(
    # in:
    blocks: ti.i32,
    offsets: Floats1,  # (S,) along the normal [voxels]
    with_normals: ti.template(),
    index: ti.template(),
    # in and out:
    keys: Ints2,  # (B, 5) SAMPLE_FRAMES |= POINT_FRAMES of the blocks whose samples these are
    sums: Sums3,  # (B, 64, 7) counts, normals, positions; read, then 0
    # (B, 64, 2 [+ 3]) += points behind the sample, their signed distance to the surfel's plane
    # [voxels], and, of samples on the surface, its normal
    sample_sums: Sums3,
):
    # cells, not blocks: enough of them to share out evenly
    for b, cell in ti.ndrange(blocks, BLOCK_CELLS):
        count = sums[b, cell, 0]
        if count > 0:
            point, normal = surfel(b, cell, keys, sums)
            for s in range(offsets.shape[0]):
                x = point + offsets[s] * normal
                ijk = voxel_of(x)
                if in_range(ijk) and normal.norm() > 0:
                    at = b
                    if any(ijk != row3(keys, b)):
                        at = block_in(index, ijk)
                    target = cell_of(x, ijk)
                    distance = normal.dot(cell_center(target) + ijk - point)
                    ti.atomic_add(sample_sums[at, target, 0], count)
                    ti.atomic_add(
                        sample_sums[at, target, 1],
                        ti.cast(ti.round(distance * FIXED), ti.i64) * count,
                    )
                    if ti.static(with_normals):
                        if offsets[s] == 0:  # beside the surface, the distance says as much
                            for d in ti.static(range(3)):
                                along = ti.cast(ti.round(normal[d] * FIXED), ti.i64)
                                ti.atomic_add(sample_sums[at, target, 2 + d], along * count)
                    frames = keys[b, POINT_FRAMES]
                    if keys[at, SAMPLE_FRAMES] & frames != frames:
                        ti.atomic_or(keys[at, SAMPLE_FRAMES], frames)
            for c in ti.static(range(7)):
                sums[b, cell, c] = ti.i64(0)


@ti.kernel
def mark_cells(
    # in:
    blocks: ti.i32,
    sums: Sums3,  # (B, 64, 1 + c) counts first
    minimum: ti.i32,
    frames: ti.template(),  # column of `keys` with the bits of the frames that saw the block
    # in and out:
    keys: Ints2,  # (B, 5) both columns of bits become 0
    # out:
    masks: Masks2,  # (B, 2) cells that hold points
    # (B, 2) the same, for at least `minimum` points, or half a sparse block's mean; 0 sets all
    support: Masks2,
    rows: Ints2,  # (B, 3) cells that hold points, points, bits of frames
):
    for b in range(blocks):
        total, occupied = 0, 0
        for half in ti.static(range(2)):
            mask = ti.u32(0)
            for k in range(32):
                count = ti.cast(sums[b, half * 32 + k, 0], ti.i32)
                if count > 0:
                    mask |= cell_bit(k)
                    total += count
                    occupied += 1
            masks[b, half] = mask
        rows[b, 0], rows[b, 1], rows[b, 2] = occupied, total, keys[b, frames]
        keys[b, POINT_FRAMES], keys[b, SAMPLE_FRAMES] = 0, 0
        for half in ti.static(range(2)):
            enough = ti.u32(0)
            if total > 0:
                for k in range(32):
                    count = ti.cast(sums[b, half * 32 + k, 0], ti.i32)
                    if count >= minimum or 2 * count * occupied >= total:
                        enough |= cell_bit(k)
            support[b, half] = enough


@ti.kernel
def compact_cells(
    # in:
    blocks: ti.i32,
    rows: Ints2,  # (B, 3) first row of each block, points, frames
    masks: Masks2,  # (B, 2) cells that hold points
    channels: ti.template(),
    units: Floats1,  # (c,) of the sums: one over the scales
    # in and out:
    sums: Sums3,  # (B, 64, 1 + c) counts first; read, then 0
    # out:
    # (M, 1 + c) for every cell with points, in order: root of its count, mean values times that
    cells: Floats2,
):
    for b in range(blocks):
        row = rows[b, 0]
        for half in range(2):
            mask = masks[b, half]
            while mask != 0:
                k = first_cell(mask)
                mask ^= cell_bit(k)
                cell = half * 32 + k
                root = ti.sqrt(ti.cast(sums[b, cell, 0], ti.f32))
                scale = 1.0 / (root * FIXED)
                cells[row, 0] = root
                for c in ti.static(range(channels)):
                    cells[row, 1 + c] = ti.cast(sums[b, cell, 1 + c], ti.f32) * scale * units[c]
                    sums[b, cell, 1 + c] = ti.i64(0)
                sums[b, cell, 0] = ti.i64(0)
                row += 1
