"""Sparse voxel storage: a Taichi pointer tree as the index, pools addressed by slot as the data
(Sec. IV-A).

The tree spans 16,384 voxels an axis around the origin (819 m at 5 cm) and holds, per voxel, its
slot and which block of which frame it is. Latents, weights and support masks lie in dense pools
that double when they are full.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from .. import runtime
from ..errors import CapacityError
from ..kernels import voxels as kernels

# bytes of sparse nodes: Taichi's CPU pool fails silently somewhat above 1.6 GB
SPARSE_LIMIT = 1 << 30
# a 4^3 leaf with three i32 fields and its share of the nodes above it
BYTES_PER_LEAF = 64 * 12 + 16 + 64 * 16
# touched voxels between two counts of the leaves, at least: 0.2 GB of sparse nodes at worst
CHECK_EVERY = 100_000
FIRST_CAPACITY = 4096


def _build_tree() -> tuple:
    """Fields slot, stamp and block of a new index tree, and the node above its leaves."""
    fields = tuple(ti.field(ti.i32) for _ in range(3))
    builder = ti.FieldsBuilder()
    node = builder.pointer(ti.ijk, 64)
    for _ in range(3):
        node = node.pointer(ti.ijk, 4)
    node.bitmasked(ti.ijk, 4).place(*fields)
    builder.finalize()
    return *fields, node


@dataclass(frozen=True)
class VoxelData:
    """Voxels by value, sorted by index: what maps save, load and merge."""

    keys: NDArray[np.int32]  # (N, 3) voxel index
    latents: NDArray[np.float32]  # (N, r, c)
    weights: NDArray[np.float32]  # (N,)
    masks: NDArray[np.uint32]  # (N, 2) support
    evidence: NDArray[np.int8] | None = None  # (N, 64) frames for a cell minus frames against it
    sums: NDArray[np.float32] | None = None  # (N, q) of the regression, with `fusion: information`


class VoxelGrid:
    """Voxels of one map: index tree and pools; `evidence` and `sums` are pools that only some maps
    have.
    """

    def __init__(self, rows: int, channels: int, *, evidence: bool = False, sums: int = 0) -> None:
        self.runtime = runtime.current()
        self.rows, self.channels = rows, channels
        self.with_evidence, self.sum_count = evidence, sums
        self.count = 0  # slots given out
        self.empty = 0  # of them, those whose voxel was removed
        self.frame = 0
        self._tree = self._borrow_tree()
        self.slot, self.stamp, self.block, self.leaf_parent = self._tree
        self._allocate(FIRST_CAPACITY)
        self._leaves, self._touched = 0, 0

    def _borrow_tree(self) -> tuple:
        """An empty index tree: one that a map no longer uses, else a new one. Taichi never frees
        the memory of a tree.
        """
        free = self.runtime.free_trees
        if free:
            tree = free.pop()
            tree[-1].parent(2).deactivate_all()  # the topmost pointer node
        else:
            self.runtime.count_tree()
            tree = _build_tree()
        weakref.finalize(self, free.append, tree)
        return tree

    def _allocate(self, capacity: int) -> None:
        self.capacity = capacity
        self.keys = ti.ndarray(ti.i32, (capacity, 3))
        self.latents = ti.ndarray(ti.f32, (capacity, self.rows, self.channels))
        self.weights = ti.ndarray(ti.f32, (capacity,))
        self.masks = ti.ndarray(ti.u32, (capacity, 2))
        self.evidence = ti.ndarray(
            ti.i8, (capacity if self.with_evidence else 1, kernels.BLOCK_CELLS)
        )
        self.sums = ti.ndarray(ti.f32, (capacity, self.sum_count) if self.sum_count else (1, 1))

    def next_frame(self) -> int:
        """A new frame stamp, which makes every block number of earlier frames void."""
        runtime.check_alive(self.runtime)
        self.frame += 1
        return self.frame

    def note_touched(self, voxels: int) -> None:
        """Count the index's leaves now and then: touching a voxel takes sparse memory also if it is
        never encoded.

        Raises CapacityError before that memory becomes unsafe.
        """
        self._touched += voxels
        if self._touched > max(CHECK_EVERY, self._leaves):
            self._leaves, self._touched = int(kernels.count_leaves(self.leaf_parent)), 0
        if self._leaves * BYTES_PER_LEAF > SPARSE_LIMIT:
            raise CapacityError(
                f"the map holds {self.count:,} voxels and its index would pass 1 GB, where Taichi is no longer "
                "safe: use larger voxels or save the map and start a new one"
            )

    def reserve(self, extra: int) -> None:
        """Make room for `extra` more voxels; raises CapacityError before sparse memory becomes
        unsafe.
        """
        self.note_touched(extra)
        if self.count + extra <= self.capacity:
            return
        old, evidence, sums = (
            (self.keys, self.latents, self.weights, self.masks),
            self.evidence,
            self.sums,
        )
        self._allocate(max(2 * self.capacity, self.count + extra))
        if self.count:
            kernels.copy_voxels(self.count, *old, self.keys, self.latents, self.weights, self.masks)
            if self.with_evidence:
                kernels.copy_rows(self.count, evidence, self.evidence)
            if self.sum_count:
                kernels.copy_rows(self.count, sums, self.sums)

    def claim(self, blocks: int, keys, weights, slots) -> int:
        """Fill `slots` (B,) with the slot of every block of positive weight, new or known, and -1
        elsewhere; counts those.
        """
        self.reserve(blocks)
        counters = np.array([self.count, 0], np.int32)
        kernels.claim_slots(blocks, keys, weights, self.slot, slots, self.keys, counters)
        runtime.synchronize()
        self.count = int(counters[0])
        return int(counters[1])

    def find(self, blocks: int, keys, weights, slots) -> int:
        """Fill `slots` (B,) with the slot of every block of positive weight, -1 where the map has
        none; counts them.
        """
        found = np.zeros(1, np.int32)
        kernels.find_slots(blocks, keys, weights, self.slot, slots, found)
        runtime.synchronize()
        return int(found[0])

    def release(self, blocks: int, keys, slots) -> None:
        """Give up the voxels of `slots` that have no weight left."""
        released = np.zeros(1, np.int32)
        kernels.release_slots(blocks, keys, slots, self.weights, self.slot, released)
        runtime.synchronize()
        self.empty += int(released[0])

    def __len__(self) -> int:
        return self.count - self.empty

    def _used(self) -> NDArray[np.int32]:
        """Slots that hold a voxel."""
        if not self.empty:
            return np.arange(self.count, dtype=np.int32)
        return np.flatnonzero(self.weights.to_numpy()[: self.count] > 0).astype(np.int32)

    def voxel_keys(self) -> NDArray[np.int32]:
        """(N, 3) voxel indices, in no order."""
        return self.keys.to_numpy()[self._used()]

    def export(self) -> VoxelData:
        """All voxels by value, sorted by index (i, then j, then k)."""
        runtime.check_alive(self.runtime)
        n = len(self)
        keys, used = self.voxel_keys(), self._used()
        order = np.lexsort(keys.T[::-1])
        slots = np.ascontiguousarray(used[order])
        data = VoxelData(
            np.ascontiguousarray(keys[order]),
            np.empty((n, self.rows, self.channels), np.float32),
            np.empty(n, np.float32),
            np.empty((n, 2), np.uint32),
            np.empty((n, kernels.BLOCK_CELLS), np.int8) if self.with_evidence else None,
            np.empty((n, self.sum_count), np.float32) if self.sum_count else None,
        )
        if n:
            kernels.gather_voxels(
                slots,
                self.latents,
                self.weights,
                self.masks,
                data.latents,
                data.weights,
                data.masks,
            )
            if data.evidence is not None:
                kernels.gather_rows(slots, self.evidence, data.evidence)
            if data.sums is not None:
                kernels.gather_rows(slots, self.sums, data.sums)
        return data

    @property
    def memory_bytes(self) -> int:
        """Bytes that the voxels need: pools as far as they are used, and the index tree."""
        leaves = int(kernels.count_leaves(self.leaf_parent)) if self.count else 0
        extra = kernels.BLOCK_CELLS * self.with_evidence + 4 * self.sum_count
        return (
            self.count * (12 + 4 + 8 + 4 * self.rows * self.channels + extra)
            + leaves * BYTES_PER_LEAF
        )
