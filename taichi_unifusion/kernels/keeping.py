"""What a window is kept by: the means of its cells, taken from their sums and put back as sums; and
its depth images in millimetres.
"""

import taichi as ti

from .arrays import Floats1, Floats2, Floats3, Ints1, Ints2, Longs2, Shorts3, Sums3, row3
from .binning import FIXED, POINT_FRAMES
from .cells import BLOCK_CELLS
from .index import block_in, voxel_of

MOST_UNITS = 65535  # of a depth image in 16 bits


@ti.kernel
def count_cells(
    # in:
    blocks: ti.i32,
    sums: Sums3,  # (B, 64, 1 + c) counts first
    # out:
    occupied: Ints1,  # (B,) cells that hold points
):
    for b in range(blocks):
        n = 0
        for cell in range(BLOCK_CELLS):
            n += ti.cast(sums[b, cell, 0] > 0, ti.i32)
        occupied[b] = n


@ti.kernel
def gather_cells(
    # in:
    blocks: ti.i32,
    starts: Ints1,  # (B,) first row of each block
    sums: Sums3,  # (B, 64, 1 + c) counts first
    # out:
    places: Ints1,  # (M,) cell 0..63 of each that holds points, block by block
    counts: Ints1,  # (M,)
    means: Floats2,  # (M, c)
):
    for b in range(blocks):
        n = starts[b]
        for cell in range(BLOCK_CELLS):
            count = sums[b, cell, 0]
            if count > 0:
                places[n] = cell
                counts[n] = ti.cast(count, ti.i32)
                scale = 1.0 / (ti.cast(count, ti.f32) * FIXED)
                for c in range(means.shape[1]):
                    means[n, c] = ti.cast(sums[b, cell, 1 + c], ti.f32) * scale
                n += 1


@ti.kernel
def scatter_cells(
    # in:
    blocks: Ints1,  # (M,) block of each cell
    places: Ints1,  # (M,) cell 0..63
    rows: Longs2,  # (M, 1 + c) counts, then fixed-point sums
    # out:
    sums: Sums3,  # (B, 64, 1 + c)
):
    for n in range(places.shape[0]):
        for c in range(rows.shape[1]):
            sums[blocks[n], places[n], c] = rows[n, c]


@ti.kernel
def mark_points(
    # in:
    blocks: ti.i32,
    points: Floats2,  # (N, 3) world [m], in touched voxels
    bits: Ints1,  # (N,) frames that saw each
    per_meter: ti.f32,
    index: ti.template(),
    # in and out:
    keys: Ints2,  # (B, 5) POINT_FRAMES becomes the frames that saw any point of the block
):
    for b in range(blocks):
        keys[b, POINT_FRAMES] = 0
    for n in range(points.shape[0]):
        b = block_in(index, voxel_of(row3(points, n) * per_meter))
        if keys[b, POINT_FRAMES] & bits[n] != bits[n]:
            ti.atomic_or(keys[b, POINT_FRAMES], bits[n])


@ti.kernel
def shrink_depth(
    # in:
    images: Floats3,  # (K or more, H, W) [m] 0: no reading
    step: ti.i32,  # pixels from one that is kept to the next
    per_meter: ti.f32,  # units
    # out:
    small: Shorts3,  # (K, h, w) [units] 0: no reading; readings beyond 16 bits are the largest
):
    for k, v, u in small:
        z = images[k, v * step, u * step]
        units = ti.math.clamp(ti.floor(z * per_meter + 0.5), 1.0, float(MOST_UNITS))
        small[k, v, u] = ti.cast(units, ti.u16) if z > 0 else ti.cast(0, ti.u16)


@ti.kernel
def round_rows(
    # in:
    voxels: ti.i32,
    per_unit: ti.f32,  # steps of one, a power of two
    # in and out:
    rows: Floats3,  # (B, r, c) become whole numbers of steps, where float32 tells them apart
    weights: Floats1,  # (B,) become whole numbers, which they are but for rounding
):
    for v in range(voxels):
        weights[v] = ti.round(weights[v])
        for a in range(rows.shape[1]):
            for c in range(rows.shape[2]):
                rows[v, a, c] = ti.round(rows[v, a, c] * per_unit) / per_unit
