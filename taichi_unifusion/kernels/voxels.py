"""Voxel index and per-frame binning: points -> blocks -> cells (Sec. IV-A).

A *voxel* is addressed by its integer triple; a *block* is a voxel touched by the current frame, addressed by a number that
is valid for that frame only; a *cell* is one of the 4x4x4 parts of a block. Sums over points are kept as 64-bit fixed-point
integers, so that they do not depend on the order in which threads add them; whoever reads the sums last leaves them zero.
"""

import taichi as ti

CELLS = 4               # cells per voxel edge; shifts below rely on it
BLOCK_CELLS = CELLS**3
INDEX_HALF = 8192       # voxel indices lie in [-INDEX_HALF, INDEX_HALF): 64 * 4 * 4 * 4 * 4 = 2 * INDEX_HALF per axis
FIXED = float(1 << 24)  # fixed-point one: steps of 6e-8, room for 5e11 in sums

Floats1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
Floats2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
Floats3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
Ints1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
Ints2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
Sums3 = ti.types.ndarray(dtype=ti.i64, ndim=3)
Masks2 = ti.types.ndarray(dtype=ti.u32, ndim=2)


@ti.func
def row3(array: ti.template(), i: ti.i32):
    """Row i of an (N, 3) array as a vector."""
    return ti.Vector([array[i, 0], array[i, 1], array[i, 2]])


@ti.func
def in_range(ijk: ti.template()) -> ti.i32:
    """Whether a voxel index lies in the range that the index tree spans."""
    return ti.cast(ijk.min() >= -INDEX_HALF and ijk.max() < INDEX_HALF, ti.i32)


@ti.func
def all_within(x: ti.template(), limit: ti.f32) -> ti.i32:
    """Whether all |x_d| < limit; by bits, so that NaN and infinity are out of it also under fast math."""
    inside = True
    for d in ti.static(range(3)):
        inside = inside and (ti.bit_cast(x[d], ti.i32) & 0x7FFFFFFF) < ti.bit_cast(limit, ti.i32)
    return ti.cast(inside, ti.i32)


@ti.func
def voxel_of(x: ti.template()):
    """Voxel that contains x, in voxel units."""
    return ti.floor(x, ti.i32)


@ti.func
def cell_of(x: ti.template(), ijk: ti.template()) -> ti.i32:
    """Cell 0..63 of voxel ijk that contains x, in voxel units; x slowest."""
    cell = ti.math.clamp(ti.floor((x - ijk) * CELLS, ti.i32), 0, CELLS - 1)
    return (cell[0] * CELLS + cell[1]) * CELLS + cell[2]


@ti.func
def cell_index(cell: ti.i32):
    """Cell 0..63 as an integer triple 0..3."""
    return ti.Vector([cell // (CELLS * CELLS), cell // CELLS % CELLS, cell % CELLS])


@ti.func
def cell_center(cell: ti.i32):
    """Centre of a cell relative to its voxel's corner, in voxel units."""
    return (cell_index(cell) + 0.5) / CELLS


@ti.func
def touch(
    # in:
    ijk: ti.template(), frame: ti.i32,
    # out:
    stamp: ti.template(), block: ti.template(), keys: ti.template(), counters: ti.template(),
):
    """Give voxel ijk a block number in this frame, once; counters[0] counts blocks, also those beyond the room in `keys`."""
    at = ijk + INDEX_HALF
    if stamp[at] != frame:
        if ti.atomic_max(stamp[at], frame) != frame:
            b = ti.atomic_add(counters[0], 1)
            if b < keys.shape[0]:
                block[at] = b
                for d in ti.static(range(3)):
                    keys[b, d] = ijk[d]


@ti.kernel
def touch_points(
    # in:
    points: Floats2,   # (N, 3) world [m]
    per_meter: ti.f32,  # 1 / voxel size
    frame: ti.i32,
    chunk: ti.i32,     # consecutive points that one thread takes
    spread: ti.template(),  # touch all 8 doubled voxels that contain a point; else its own voxel
    # out:
    stamp: ti.template(), block: ti.template(),
    keys: Ints2,       # (B, 3) voxel of each block
    counters: Ints1,   # += [blocks, points outside the index range]
):
    for part in range((points.shape[0] + chunk - 1) // chunk):
        previous = ti.Vector([INDEX_HALF, 0, 0])
        for n in range(part * chunk, ti.min((part + 1) * chunk, points.shape[0])):
            x = row3(points, n) * per_meter
            if all_within(x, INDEX_HALF - 1.0):
                ijk = voxel_of(x - 0.5) if ti.static(spread) else voxel_of(x)
                if any(ijk != previous):  # neighbours in the image mostly share a voxel
                    for o in range(8 if ti.static(spread) else 1):
                        touch(ijk + ti.Vector([o // 4, o // 2 % 2, o % 2]), frame, stamp, block, keys, counters)
                    previous = ijk
            else:
                ti.atomic_add(counters[1], 1)


@ti.kernel
def bin_points(
    # in:
    points: Floats2,   # (N, 3) world [m]
    values: Floats2,   # (N, c)
    per_meter: ti.f32,
    chunk: ti.i32,
    channels: ti.template(),
    with_positions: ti.template(),
    block: ti.template(),
    # out:
    counts: Ints2,     # (B, 64) += points in the cell
    sums: Sums3,       # (B, 64, c [+ 3]) += values, then position from the cell centre [voxels]
):
    for part in range((points.shape[0] + chunk - 1) // chunk):
        width = ti.static(channels + (3 if with_positions else 0))
        place = ti.Vector([INDEX_HALF * CELLS, 0, 0])  # of the cell in the lattice of all cells
        b, run = -1, 0
        total = ti.Vector([0.0] * max(width, 1))  # in floats over a run: one thread adds it, always in the same order
        for n in range(part * chunk, ti.min((part + 1) * chunk, points.shape[0])):
            x = row3(points, n) * (per_meter * CELLS)
            at = ti.floor(x, ti.i32)
            if any(at != place):  # a run of points in one cell costs one write
                if run > 0:
                    add_run(width, b, place, run, total, counts, sums)
                if any((at >> 2) != (place >> 2)):
                    b = block[(at >> 2) + INDEX_HALF]
                place = at
                run = 0
                total.fill(0.0)
            run += 1
            for c in ti.static(range(channels)):
                total[c] += values[n, c]
            if ti.static(with_positions):
                for d in ti.static(range(3)):
                    total[channels + d] += (x[d] - at[d] - 0.5) / CELLS
        if run > 0:
            add_run(width, b, place, run, total, counts, sums)


@ti.kernel
def block_of_points(
    # in:
    points: Floats2,  # (N, 3) world [m], in touched voxels
    per_meter: ti.f32,
    block: ti.template(),
    # out:
    blocks: Ints1,    # (N,)
):
    for n in range(points.shape[0]):
        blocks[n] = block[voxel_of(row3(points, n) * per_meter) + INDEX_HALF]


@ti.func
def add_run(width: ti.template(), b: ti.i32, place: ti.template(), run: ti.i32, total: ti.template(), counts: ti.template(),
            sums: ti.template()):
    """Add the sums over a run of points to their cell."""
    cell = ((place[0] & 3) * CELLS + (place[1] & 3)) * CELLS + (place[2] & 3)
    ti.atomic_add(counts[b, cell], run)
    for c in ti.static(range(width)):
        ti.atomic_add(sums[b, cell, c], ti.cast(ti.round(total[c] * FIXED), ti.i64))


@ti.func
def surfel(b: ti.i32, cell: ti.i32, keys: ti.template(), counts: ti.template(), sums: ti.template()):
    """Mean point [voxels] and mean unit normal of the points in a cell; a zero normal where they cancel."""
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
    counts: Ints2,     # (B, 64)
    sums: Sums3,       # (B, 64, 6) normals, positions
    offsets: Floats1,  # (S,) along the normal [voxels]
    frame: ti.i32,
    # out:
    stamp: ti.template(), block: ti.template(),
    keys: Ints2,
    counters: Ints1,
):
    for b in range(blocks):
        for cell in range(BLOCK_CELLS):
            if counts[b, cell] > 0:
                point, normal = surfel(b, cell, keys, counts, sums)
                for s in range(offsets.shape[0]):
                    ijk = voxel_of(point + offsets[s] * normal)
                    if in_range(ijk):
                        touch(ijk, frame, stamp, block, keys, counters)


@ti.kernel
def bin_surfel_samples(
    # in:
    blocks: ti.i32,
    keys: Ints2,           # (B, 3)
    offsets: Floats1,      # (S,) along the normal [voxels]
    with_normals: ti.template(),
    block: ti.template(),
    # in and out:
    counts: Ints2,         # (B, 64) read, then 0
    sums: Sums3,           # (B, 64, 6) normals, positions; read, then 0
    # out:
    sample_counts: Ints2,  # (B, 64) += points behind the sample
    sample_sums: Sums3,    # (B, 64, 1 [+ 3]) += their signed distance to the surfel's plane [voxels], and its normal
):
    for b in range(blocks):
        for cell in range(BLOCK_CELLS):
            if counts[b, cell] > 0:
                point, normal = surfel(b, cell, keys, counts, sums)
                for s in range(offsets.shape[0]):
                    x = point + offsets[s] * normal
                    ijk = voxel_of(x)
                    if in_range(ijk) and normal.norm() > 0:
                        at = block[ijk + INDEX_HALF]
                        target = cell_of(x, ijk)
                        distance = normal.dot(cell_center(target) + ijk - point)
                        count = counts[b, cell]
                        ti.atomic_add(sample_counts[at, target], count)
                        ti.atomic_add(sample_sums[at, target, 0], ti.cast(ti.round(distance * FIXED), ti.i64) * count)
                        if ti.static(with_normals):
                            for d in ti.static(range(3)):
                                ti.atomic_add(sample_sums[at, target, 1 + d], ti.cast(ti.round(normal[d] * FIXED), ti.i64) * count)
                counts[b, cell] = 0
                for c in ti.static(range(6)):
                    sums[b, cell, c] = ti.i64(0)


@ti.kernel
def mark_cells(
    # in:
    blocks: ti.i32,
    counts: Ints2,    # (B, 64)
    minimum: ti.i32,
    # out:
    masks: Masks2,    # (B, 2) bit 31-k of word j: cell 32 j + k holds a point
    support: Masks2,  # (B, 2) the same, for at least `minimum` points, or half a sparse block's mean; 0 sets all
    totals: Ints1,    # (B,) points
    cells: Ints1,     # (B,) cells that hold points
):
    for b in range(blocks):
        total, occupied = 0, 0
        for half in ti.static(range(2)):
            mask = ti.u32(0)
            for k in range(32):
                count = counts[b, half * 32 + k]
                if count > 0:
                    mask |= ti.u32(1) << ti.cast(31 - k, ti.u32)
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
                        enough |= ti.u32(1) << ti.cast(31 - k, ti.u32)
            support[b, half] = enough


@ti.kernel
def compact_cells(
    # in:
    blocks: ti.i32,
    starts: Ints1,     # (B,) first row of each block
    masks: Masks2,     # (B, 2) cells that hold points
    channels: ti.template(),
    # in and out:
    counts: Ints2,     # (B, 64) read, then 0
    sums: Sums3,       # (B, 64, c) read, then 0
    # out:
    cells: Floats2,    # (M, 1 + c) for every cell with points, in order: square root of its count, mean values times that
):
    for b in range(blocks):
        row = starts[b]
        for half in range(2):
            mask = masks[b, half]
            while mask != 0:
                k = ti.math.clz(ti.cast(mask, ti.i32))
                mask ^= ti.u32(1) << ti.cast(31 - k, ti.u32)
                cell = half * 32 + k
                root = ti.sqrt(ti.cast(counts[b, cell], ti.f32))
                scale = 1.0 / (root * FIXED)
                cells[row, 0] = root
                for c in ti.static(range(channels)):
                    cells[row, 1 + c] = ti.cast(sums[b, cell, c], ti.f32) * scale
                    sums[b, cell, c] = ti.i64(0)
                counts[b, cell] = 0
                row += 1


@ti.kernel
def claim_slots(
    # in:
    blocks: ti.i32,
    keys: Ints2,       # (B, 3)
    weights: Floats1,  # (B,) 0: no voxel wanted
    # out:
    slot: ti.template(),
    slots: Ints1,      # (B,) slot of each voxel, -1 where none
    slot_keys: Ints2,  # (capacity, 3) voxel of each slot
    counters: Ints1,   # += [new slots, blocks that want a voxel]
):
    for b in range(blocks):
        found = -1
        if weights[b] > 0:
            ijk = row3(keys, b)
            at = ijk + INDEX_HALF
            found = slot[at] - 1  # slots are stored plus one: an absent voxel reads 0
            if found < 0:
                found = ti.atomic_add(counters[0], 1)
                slot[at] = found + 1
                for d in ti.static(range(3)):
                    slot_keys[found, d] = ijk[d]
            ti.atomic_add(counters[1], 1)
        slots[b] = found


@ti.kernel
def gather_voxels(
    # in:
    slots: Ints1,          # (N,) slots to take
    map_latents: Floats3,  # (S, r, c)
    map_weights: Floats1,  # (S,)
    map_masks: Masks2,     # (S, 2)
    # out:
    latents: Floats3,      # (N, r, c)
    weights: Floats1,      # (N,)
    masks: Masks2,         # (N, 2)
):
    for n in range(slots.shape[0]):
        s = slots[n]
        weights[n] = map_weights[s]
        for a in range(map_latents.shape[1]):
            for c in range(map_latents.shape[2]):
                latents[n, a, c] = map_latents[s, a, c]
        for half in ti.static(range(2)):
            masks[n, half] = map_masks[s, half]


@ti.kernel
def copy_voxels(
    # in:
    count: ti.i32,
    keys: Ints2, latents: Floats3, weights: Floats1, masks: Masks2,
    # out: the same, larger
    new_keys: Ints2, new_latents: Floats3, new_weights: Floats1, new_masks: Masks2,
):
    for s in range(count):
        new_weights[s] = weights[s]
        for d in ti.static(range(3)):
            new_keys[s, d] = keys[s, d]
        for half in ti.static(range(2)):
            new_masks[s, half] = masks[s, half]
        for a in range(latents.shape[1]):
            for c in range(latents.shape[2]):
                new_latents[s, a, c] = latents[s, a, c]


@ti.kernel
def count_leaves(leaf_parent: ti.template()) -> ti.i32:
    """Number of 4^3 leaves that an index tree has allocated."""
    leaves = 0
    for I in ti.grouped(leaf_parent):
        leaves += 1
    return leaves
