"""Voxel index: which voxels exist, and which of them the open window touches (Sec. IV-A).

A *voxel* is addressed by its integer triple; a *block* is a voxel touched by the frames that are
summed now, addressed by a number that is valid until these are fused; a *slot* is the place of a
voxel's data in the map's pools.
"""

from dataclasses import dataclass

import taichi as ti

from .arrays import Floats1, Floats2, Ints1, Ints2, row3

# voxel indices lie in [-INDEX_HALF, INDEX_HALF): 64 * 4 * 4 * 4 * 4 = 2 * INDEX_HALF per axis
INDEX_HALF = 8192


@dataclass(frozen=True, eq=False)
class Index:
    """The fields of one map's index tree, as one compile-time argument."""

    slot: ti.Field  # slot plus one: 0 where there is no voxel
    stamp: ti.Field  # of the last frames to touch the voxel, which were summed together
    block: ti.Field  # its block number among theirs, plus one; 0 when they are fused
    leaf_parent: ti.SNode  # the node above the leaves

    @property
    def leaves(self) -> int:
        """4^3 leaves that memory was taken for, those included that were given back."""
        return int(self.leaf_parent._num_dynamically_allocated)  # noqa: SLF001 - no kernel to compile


@ti.func
def find(index: ti.template(), ijk: ti.template()) -> ti.i32:
    """Slot of voxel ijk, which lies in the index range, or -1 where there is none."""
    return index.slot[ijk + INDEX_HALF] - 1


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
    stamp: ti.i32,
    # in and out:
    index: ti.template(),
    keys: ti.template(),
    counters: ti.template(),
):
    """Give voxel ijk a block number under this stamp, once; counters[0] counts blocks, for which
    there is room in `keys`.
    """
    at = ijk + INDEX_HALF
    if index.stamp[at] != stamp:
        if ti.atomic_max(index.stamp[at], stamp) != stamp:
            b = ti.atomic_add(counters[0], 1)
            index.block[at] = b + 1
            for d in ti.static(range(3)):
                keys[b, d] = ijk[d]


@ti.func
def block_in(index: ti.template(), ijk: ti.template()) -> ti.i32:
    """The block number of a voxel that was touched."""
    return index.block[ijk + INDEX_HALF] - 1


@ti.kernel
def touch_points(
    # in:
    found: Ints1,  # (R,) points in each run
    slots: ti.i32,  # places of a run
    points: Floats2,  # (R slots, 3) world [m]
    counts: Ints1,  # (R slots,) pixels behind each; 0: left out
    per_meter: ti.f32,  # 1 / voxel size
    stamp: ti.i32,
    spread: ti.template(),  # touch all 8 doubled voxels that contain a point; else its own voxel
    # in and out:
    index: ti.template(),
    counters: Ints1,  # (2,) += [blocks, points outside the index range]
    # out:
    keys: Ints2,  # (B, 3) voxel of each block
):
    for part in range(found.shape[0]):
        previous = ti.Vector([INDEX_HALF, 0, 0])
        for n in range(part * slots, part * slots + found[part]):
            x = row3(points, n) * per_meter
            if counts[n] > 0:
                if all_within(x, INDEX_HALF - 1.0):
                    ijk = voxel_of(x - 0.5) if ti.static(spread) else voxel_of(x)
                    if any(ijk != previous):  # neighbours in the image mostly share a voxel
                        for o in range(8 if ti.static(spread) else 1):
                            corner = ti.Vector([o // 4, o // 2 % 2, o % 2])
                            touch(ijk + corner, stamp, index, keys, counters)
                        previous = ijk
                else:
                    ti.atomic_add(counters[1], 1)


@ti.kernel
def forget_blocks(
    # in:
    first: ti.i32,
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    # in and out:
    index: ti.template(),  # from block `first` on they were not touched
):
    for b in range(first, blocks):
        at = row3(keys, b) + INDEX_HALF
        index.stamp[at] = 0
        index.block[at] = 0


@ti.kernel
def block_of_points(
    # in:
    points: Floats2,  # (N, 3) world [m], in touched voxels
    per_meter: ti.f32,
    index: ti.template(),
    # out:
    blocks: Ints1,  # (N,)
):
    for n in range(points.shape[0]):
        blocks[n] = block_in(index, voxel_of(row3(points, n) * per_meter))


@ti.kernel
def claim_slots(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    weights: Floats1,  # (B,) 0: no voxel wanted
    # in and out:
    index: ti.template(),
    counters: Ints1,  # (2,) += [new slots, blocks that want a voxel]
    # out:
    slots: Ints1,  # (B,) slot of each voxel, -1 where none
    slot_keys: Ints2,  # (S, 3) voxel of each slot
):
    for b in range(blocks):
        found = -1
        if weights[b] > 0:
            ijk = row3(keys, b)
            found = find(index, ijk)
            if found < 0:
                found = ti.atomic_add(counters[0], 1)
                index.slot[ijk + INDEX_HALF] = found + 1
                for d in ti.static(range(3)):
                    slot_keys[found, d] = ijk[d]
            ti.atomic_add(counters[1], 1)
        slots[b] = found


@ti.kernel
def assign_slots(
    # in:
    keys: Ints2,  # (N, 3) voxels that have no slot
    first: ti.i32,
    # in and out:
    index: ti.template(),  # the voxels have slots `first`, `first` + 1, ...
):
    for n in range(keys.shape[0]):
        index.slot[row3(keys, n) + INDEX_HALF] = first + n + 1


@ti.kernel
def clear_index(
    # in and out:
    index: ti.template(),  # no voxel has a slot, or was touched; leaves stay
):
    for ijk in ti.grouped(index.slot):
        index.slot[ijk] = 0
        index.stamp[ijk] = 0
        index.block[ijk] = 0


@ti.kernel
def remove_slots(
    # in:
    keys: Ints2,  # (N, 3) voxels that have a slot
    # in and out:
    index: ti.template(),  # they have none
):
    for n in range(keys.shape[0]):
        index.slot[row3(keys, n) + INDEX_HALF] = 0


@ti.kernel
def find_slots(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    weights: Floats1,  # (B,) 0: no voxel wanted
    index: ti.template(),
    # in and out:
    found: Ints1,  # (1,) += how many
    # out:
    slots: Ints1,  # (B,) slot of each voxel, -1 where none
):
    for b in range(blocks):
        slots[b] = find(index, row3(keys, b)) if weights[b] > 0 else -1
        if slots[b] >= 0:
            ti.atomic_add(found[0], 1)


@ti.kernel
def release_slots(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    slots: Ints1,  # (B,) -1 where none
    map_weights: Floats1,  # (S,)
    # in and out:
    index: ti.template(),  # slots become 0 for voxels without weight
    released: Ints1,  # (1,) += how many
):
    for b in range(blocks):
        if slots[b] >= 0 and map_weights[slots[b]] == 0:
            index.slot[row3(keys, b) + INDEX_HALF] = 0
            ti.atomic_add(released[0], 1)


@ti.kernel
def count_leaves(
    # in:
    index: ti.template(),
) -> ti.i32:
    """Number of 4^3 leaves that are in use."""
    leaves = 0
    for _ in ti.grouped(index.leaf_parent):
        leaves += 1
    return leaves
