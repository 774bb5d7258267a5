"""The l x l regression of every touched voxel (Eq. 6, 17 and 18).

`F = (P^T W P + d I)^-1 P^T W Y` is Eq. 6 in its primal form: P holds a row f_posi(t) for every
sample in the doubled voxel, W the number of points behind it. The targets Y ride along as further
rows of P^T, so that one Gram product gives both P^T W P and Y^T W P, and the forward half of the
solve falls out of the Cholesky factorisation.

Sizes stand in a `Layout`: products are summed up in vectors of 8 numbers, and the solve runs in 4x4
patches, which stay in registers. A *worker* is a thread with scratch of its own, a tile of samples
and their products, that takes a run of voxels.
"""

import taichi as ti

from .arrays import Floats1, Floats2, Floats3, Ints1, Ints2, Lanes3, Masks2, row3
from .cells import CELLS, cell_bit, cells_before, first_cell
from .encoding import position_features, position_gradient
from .gram import (
    TILE,
    add_samples,
    clear_products,
    keep_sums,
    put_number,
    solve_voxel,
    take_products,
)
from .index import INDEX_HALF, block_in, in_range
from .tasks import worker_stride

LEAST_SHARE = 1e-3  # of a cell's points that have a normal, below which it is left out


@ti.func
def neighbor_step(o: ti.i32):
    """Step (-1, 0, 1) per axis to neighbour o of 0..26."""
    return ti.Vector([o // 9 - 1, o // 3 % 3 - 1, o % 3 - 1])


@ti.kernel
def find_neighbors(
    # in:
    index: ti.template(),
    stamp: ti.i32,
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    # out:
    neighbors: Ints2,  # (B, 27) block number of each neighbour, -1 where it was not touched
):
    for b in range(blocks):
        for o in range(14, 27):
            neighbors[b, o] = -1
        neighbors[b, 13] = b
    for b in range(blocks):
        # neighbours 14..26 by symmetry: neighbour o of b has b as its neighbour 26 - o
        for o in range(13):
            ijk = row3(keys, b) + neighbor_step(o)
            found = -1
            if in_range(ijk):
                if index.stamp[ijk + INDEX_HALF] == stamp:
                    found = block_in(index, ijk)
                    neighbors[found, 26 - o] = b
            neighbors[b, o] = found


@ti.func
def cell_row(cell: ti.i32, step: ti.template()) -> ti.i32:
    """Row in the feature table of a neighbour's cell: its place among the 8^3 cells of the doubled
    voxel.
    """
    cube = ti.Vector([cell >> 4, cell >> 2 & 3, cell & 3]) + CELLS * step + CELLS // 2
    return (cube[0] << 6) + (cube[1] << 3) + cube[2]


@ti.func
def add_cell(
    # in:
    layout: ti.template(),
    worker: ti.i32,
    filled: ti.i32,
    n: ti.i32,
    at: ti.i32,
    cells: ti.template(),
    features: ti.template(),
    # in and out:
    scratch: ti.template(),
    mean: ti.template(),
) -> ti.i32:
    """Put the cell in row n, whose features stand in row `at` of the table, into a worker's tile;
    returns how many samples are in it then.
    """
    size, channels = ti.static(layout.size, layout.channels)
    root, sample = cells[n, 0], filled
    for part in ti.static(range(layout.feature_vectors)):
        scratch.tiles[worker, sample, part] = features[at, 0, part] * root
    for c in ti.static(range(channels)):
        y = cells[n, 1 + c]
        put_number(scratch, worker, sample, size + c, y)
        mean[c] += y * root
    if ti.static(layout.centered):
        put_number(scratch, worker, sample, size + channels, root)
    sample += 1
    if ti.static(layout.derivatives):
        normal = ti.Vector([cells[n, 2], cells[n, 3], cells[n, 4]])
        share = 1.0  # of the cell's points, those that have a normal and agree on it
        if ti.static(layout.some_normals):
            share = normal.norm() / root
        if share > LEAST_SHARE:
            scale = ti.sqrt(share)
            for axis in ti.static(range(3)):  # Eq. 16: one more row an axis, its target the normal
                for part in ti.static(range(layout.feature_vectors)):
                    f = features[at, 1 + axis, part]
                    scratch.tiles[worker, sample, part] = f * (root * scale)
                put_number(scratch, worker, sample, size, normal[axis] / scale)
                sample += 1
    return sample


@ti.kernel
def encode_cells(
    # in:
    layout: ti.template(),
    begin: ti.i32,  # the first block to encode...
    end: ti.i32,  # ...and the one after the last
    neighbors: Ints2,  # (B, 27)
    masks: Masks2,  # (B, 2) occupied cells
    window: Masks2,  # (27, 2) cells of each neighbour that count
    # (B, 3) first row of each block in `cells`, points in the block itself, bits of the frames that
    # saw it
    rows: Ints2,
    # (M, 1 + c [+ 3]) root of the count, then the mean targets, and normals if `derivatives`, times
    # it
    cells: Floats2,
    # (8^3, 1 or 4, V vectors) f_posi, and 1/2 df/dt if `derivatives`, at the cell centres of a
    # doubled voxel
    features: Lanes3,
    minimum: ti.i32,  # blocks with fewer points are not encoded
    noise: ti.f32,  # d of Eq. 6, of one frame, in units of the kernel's variance
    # out:
    scratch: ti.template(),  # of W workers
    weights: Floats1,  # (B,) points in the doubled voxel, 0 where not encoded
    # (B, l [+ 1], c) F, then the prior mean; (B, q, 1) the sums of `keep_sums` for fusion by
    # information
    encoded: Floats3,
):
    size, channels = ti.static(layout.size, layout.channels)
    stride, workers = ti.static(worker_stride(), scratch.workers)
    for i in range(workers * stride):
        if i % stride == 0:
            worker = i // stride
            blocks = end - begin
            first_block = begin + worker * blocks // workers
            for v in range(first_block, begin + (worker + 1) * blocks // workers):
                weights[v] = 0.0
                if rows[v, 1] >= minimum:
                    clear_products(layout, worker, scratch)
                    mean = ti.Vector([0.0] * channels)
                    filled, weight, seen = 0, 0.0, ti.u32(0)
                    for o in range(28):  # a last round adds what is left
                        last = o == 27
                        b, step = v, neighbor_step(o)
                        if not last:
                            b = neighbors[v, o]
                        if b >= 0:
                            first = rows[b, 0]
                            for half in range(2):
                                occupied = masks[b, half]
                                wanted = ti.u32(1)
                                if not last:
                                    wanted = occupied & window[o, half]
                                    if wanted != 0:
                                        seen |= ti.cast(rows[b, 2], ti.u32)
                                while wanted != 0:
                                    if last:
                                        wanted = ti.u32(0)
                                    else:
                                        k = first_cell(wanted)
                                        wanted ^= cell_bit(k)
                                        n = first + cells_before(occupied, k)
                                        at = cell_row(half * 32 + k, step)
                                        filled = add_cell(
                                            layout,
                                            worker,
                                            filled,
                                            n,
                                            at,
                                            cells,
                                            features,
                                            scratch,
                                            mean,
                                        )
                                        weight += cells[n, 0] * cells[n, 0]
                                    if filled > TILE - 4 or (last and filled > 0):
                                        add_samples(layout, worker, filled, scratch)
                                        filled = 0
                                first += ti.cast(ti.math.popcnt(occupied), ti.i32)
                    G = ti.Vector([0.0] * (layout.rows * size))
                    take_products(layout, worker, scratch, G)
                    if ti.static(layout.information):
                        keep_sums(layout, v, weight, mean, G, encoded, weights)
                    else:
                        frames = ti.cast(ti.math.popcnt(seen), ti.f32)
                        solve_voxel(layout, v, noise * frames, weight, mean, G, encoded, weights)


@ti.func
def put_features(
    layout: ti.template(), worker: ti.i32, sample: ti.i32, f: ti.template(), scratch: ti.template()
):
    """Put features into a worker's tile, with zeros up to whole patches."""
    for a in ti.static(range(layout.size)):
        put_number(scratch, worker, sample, a, f[a] if ti.static(a < layout.rank) else 0.0)


@ti.kernel
def encode_points(
    # in:
    layout: ti.template(),
    keys: Ints2,  # (B, 3)
    neighbors: Ints2,  # (B, 27)
    starts: Ints1,  # (B + 1,) first sample of each block
    samples: Floats2,  # (N, 3) [voxels], sorted by block
    targets: Floats2,  # (N, c [+ 3]) targets, and normals if `derivatives`
    anchors: Floats2,  # (3, A)
    projection: Floats2,  # (l, A)
    scale: ti.f32,
    minimum: ti.i32,  # doubled voxels with fewer samples are not encoded
    noise: ti.f32,
    # out: as encode_cells
    scratch: ti.template(),  # of W workers
    weights: Floats1,  # (B,)
    encoded: Floats3,  # (B, l [+ 1], c) or (B, q, 1)
):
    rank, size, channels = ti.static(layout.rank, layout.size, layout.channels)
    stride, workers = ti.static(worker_stride(), scratch.workers)
    blocks = starts.shape[0] - 1
    for i in range(workers * stride):
        if i % stride == 0:
            worker = i // stride
            for v in range(worker * blocks // workers, (worker + 1) * blocks // workers):
                weights[v] = 0.0
                clear_products(layout, worker, scratch)
                mean = ti.Vector([0.0] * channels)
                ijk = row3(keys, v)
                filled, weight = 0, 0.0
                for o in range(28):  # a last round adds what is left
                    last, begin, end = o == 27, 0, 1
                    if not last:
                        b = neighbors[v, o]
                        end = 0
                        if b >= 0:
                            begin, end = starts[b], starts[b + 1]
                    for n in range(begin, end):
                        t = (row3(samples, n) - ijk - 0.5) * 0.5
                        if not last and ti.abs(t).max() <= 0.5:
                            f = position_features(t, rank, anchors, projection, scale)
                            put_features(layout, worker, filled, f, scratch)
                            for c in ti.static(range(channels)):
                                put_number(scratch, worker, filled, size + c, targets[n, c])
                                mean[c] += targets[n, c]
                            if ti.static(layout.centered):
                                put_number(scratch, worker, filled, size + channels, 1.0)
                            filled += 1
                            if ti.static(layout.derivatives):
                                normal = ti.Vector([targets[n, 1], targets[n, 2], targets[n, 3]])
                                for axis in range(3 if normal.norm() > LEAST_SHARE else 0):
                                    g = position_gradient(t, axis, rank, anchors, projection, scale)
                                    put_features(layout, worker, filled, 0.5 * g, scratch)  # dt/dx
                                    put_number(scratch, worker, filled, size, targets[n, 1 + axis])
                                    filled += 1
                            weight += 1.0
                        if filled > TILE - 4 or (last and filled > 0):
                            add_samples(layout, worker, filled, scratch)
                            filled = 0
                if weight >= minimum:
                    G = ti.Vector([0.0] * (layout.rows * size))
                    take_products(layout, worker, scratch, G)
                    if ti.static(layout.information):
                        keep_sums(layout, v, weight, mean, G, encoded, weights)
                    else:
                        solve_voxel(layout, v, noise, weight, mean, G, encoded, weights)
