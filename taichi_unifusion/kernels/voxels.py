"""Voxel index: which voxels exist, and which of them the current frame touches (Sec. IV-A).

A *voxel* is addressed by its integer triple; a *block* is a voxel touched by the current frame,
addressed by a number that is valid for that frame only; a *cell* is one of the 4x4x4 parts of a
block.
"""

import taichi as ti

CELLS = 4  # cells per voxel edge; shifts below rely on it
BLOCK_CELLS = CELLS**3
# voxel indices lie in [-INDEX_HALF, INDEX_HALF): 64 * 4 * 4 * 4 * 4 = 2 * INDEX_HALF per axis
INDEX_HALF = 8192

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
    """Whether all |x_d| < limit; by bits, so that NaN and infinity are out of it also under fast
    math.
    """
    inside = True
    for d in ti.static(range(3)):
        inside = inside and (ti.bit_cast(x[d], ti.i32) & 0x7FFFFFFF) < ti.bit_cast(limit, ti.i32)
    return ti.cast(inside, ti.i32)


@ti.func
def voxel_of(x: ti.template()):
    """Voxel that contains x, in voxel units."""
    return ti.floor(x, ti.i32)


@ti.func
def touch(
    # in:
    ijk: ti.template(),
    frame: ti.i32,
    # out:
    stamp: ti.template(),
    block: ti.template(),
    keys: ti.template(),
    counters: ti.template(),
):
    """Give voxel ijk a block number in this frame, once; counters[0] counts blocks, also those
    beyond the room in `keys`.
    """
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
    points: Floats2,  # (N, 3) world [m]
    per_meter: ti.f32,  # 1 / voxel size
    frame: ti.i32,
    chunk: ti.i32,  # consecutive points that one thread takes
    spread: ti.template(),  # touch all 8 doubled voxels that contain a point; else its own voxel
    # out:
    stamp: ti.template(),
    block: ti.template(),
    keys: Ints2,  # (B, 3) voxel of each block
    counters: Ints1,  # += [blocks, points outside the index range]
):
    for part in range((points.shape[0] + chunk - 1) // chunk):
        previous = ti.Vector([INDEX_HALF, 0, 0])
        for n in range(part * chunk, ti.min((part + 1) * chunk, points.shape[0])):
            x = row3(points, n) * per_meter
            if all_within(x, INDEX_HALF - 1.0):
                ijk = voxel_of(x - 0.5) if ti.static(spread) else voxel_of(x)
                if any(ijk != previous):  # neighbours in the image mostly share a voxel
                    for o in range(8 if ti.static(spread) else 1):
                        touch(
                            ijk + ti.Vector([o // 4, o // 2 % 2, o % 2]),
                            frame,
                            stamp,
                            block,
                            keys,
                            counters,
                        )
                    previous = ijk
            else:
                ti.atomic_add(counters[1], 1)


@ti.kernel
def block_of_points(
    # in:
    points: Floats2,  # (N, 3) world [m], in touched voxels
    per_meter: ti.f32,
    block: ti.template(),
    # out:
    blocks: Ints1,  # (N,)
):
    for n in range(points.shape[0]):
        blocks[n] = block[voxel_of(row3(points, n) * per_meter) + INDEX_HALF]


@ti.kernel
def claim_slots(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    weights: Floats1,  # (B,) 0: no voxel wanted
    # out:
    slot: ti.template(),
    slots: Ints1,  # (B,) slot of each voxel, -1 where none
    slot_keys: Ints2,  # (capacity, 3) voxel of each slot
    counters: Ints1,  # += [new slots, blocks that want a voxel]
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
def find_slots(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    weights: Floats1,  # (B,) 0: no voxel wanted
    slot: ti.template(),
    # out:
    slots: Ints1,  # (B,) slot of each voxel, -1 where none
    found: Ints1,  # += how many
):
    for b in range(blocks):
        slots[b] = slot[row3(keys, b) + INDEX_HALF] - 1 if weights[b] > 0 else -1
        if slots[b] >= 0:
            ti.atomic_add(found[0], 1)


@ti.kernel
def gather_voxels(
    # in:
    slots: Ints1,  # (N,) slots to take
    map_latents: Floats3,  # (S, r, c)
    map_weights: Floats1,  # (S,)
    map_masks: Masks2,  # (S, 2)
    # out:
    latents: Floats3,  # (N, r, c)
    weights: Floats1,  # (N,)
    masks: Masks2,  # (N, 2)
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
    keys: Ints2,
    latents: Floats3,
    weights: Floats1,
    masks: Masks2,
    # out: the same, larger
    new_keys: Ints2,
    new_latents: Floats3,
    new_weights: Floats1,
    new_masks: Masks2,
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
def copy_rows(count: ti.i32, rows: ti.types.ndarray(ndim=2), copies: ti.types.ndarray(ndim=2)):
    for s, q in ti.ndrange(count, rows.shape[1]):
        copies[s, q] = rows[s, q]


@ti.kernel
def gather_rows(
    # in:
    slots: Ints1,  # (N,) rows to take
    rows: ti.types.ndarray(ndim=2),  # (S, q)
    # out:
    gathered: ti.types.ndarray(ndim=2),  # (N, q)
):
    for n, q in ti.ndrange(slots.shape[0], rows.shape[1]):
        gathered[n, q] = rows[slots[n], q]


@ti.kernel
def release_slots(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    slots: Ints1,  # (B,) -1 where none
    map_weights: Floats1,  # (S,)
    # out:
    slot: ti.template(),  # = 0 for voxels without weight
    released: Ints1,  # += how many
):
    for b in range(blocks):
        if slots[b] >= 0 and map_weights[slots[b]] == 0:
            slot[row3(keys, b) + INDEX_HALF] = 0
            ti.atomic_add(released[0], 1)


@ti.kernel
def count_leaves(leaf_parent: ti.template()) -> ti.i32:
    """Number of 4^3 leaves that an index tree has allocated."""
    leaves = 0
    for I in ti.grouped(leaf_parent):
        leaves += 1
    return leaves
