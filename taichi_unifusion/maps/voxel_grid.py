"""Sparse voxel storage: a Taichi pointer tree as the index, pools addressed by slot as the data
(Sec. IV-A).

The tree spans 16,384 voxels an axis around the origin (819 m at 5 cm) and holds, per voxel, its
slot and which block of which frame it is. What a voxel holds lies in pools, one a field.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..device_arrays import DeviceArray, grown
from ..errors import CapacityError
from ..kernels import index as kernels
from ..kernels import ti
from .pool import Pool
from .voxel_data import KEYS, VoxelData, VoxelField

# Bytes of sparse nodes, of one map and of all that the process ever had: Taichi's pool on the CPU
# fails silently somewhat above 1.6 GB, and gives nothing back.
SPARSE_LIMIT, SPARSE_POOL = 1 << 30, 1_450_000_000
CROWDED = 300_000_000  # bytes of an index from which on it is emptied by giving nodes back
BYTES_PER_TREE = 80_000_000  # what an empty index tree takes of the pool
# a 4^3 leaf with three i32 fields and its share of the nodes above it
BYTES_PER_LEAF = 64 * 12 + 16 + 64 * 16
LEAF_CODE = np.array([1 << 24, 1 << 12, 1])  # tells leaves, 4,096 an axis, apart
# On CUDA one pool of fixed size serves all trees, and running over it ends CUDA for the process. It is
# taken in chunks of 16,384 nodes: a tree begins with a chunk a level, and with lists; at worst every
# leaf has three nodes of its own above it. Kept free: what the runtime takes, and four chunks, since
# the voxels of a frame are there before they are counted.
CUDA_TREE, CUDA_CHUNK, CUDA_RESERVE = 90_000_000, 66_000_000, 330_000_000
NODES_PER_CHUNK = 16_384
# room to begin with: what a room needs, so that hardly any video waits, but little memory
FIRST_CAPACITY, LEAST_CAPACITY, FIRST_BYTES, LEAST_BYTES = 131_072, 4096, 16 << 20, 64 << 20
MAPS_OF_A_RUN = 2  # at least: while there are fewer trees, none is left over from an earlier run
LARGE = 1 << 20  # voxels from which on room grows by a quarter at a time: it takes memory at once


class VoxelGrid:
    """Voxels of one map: an index tree, and a pool for each of `fields` beside their keys."""

    def __init__(self, fields: Sequence[VoxelField]) -> None:
        self.runtime = runtime.current()
        self.fields = tuple(fields)
        self.count = 0  # slots given out
        self.empty = 0  # of them, those whose voxel was removed
        self.packed = 0  # how often `retain` gave voxels other slots
        self.frame = 0
        self.unclosed: Any = None  # `CellArrays` with the keys of the voxels that are touched now
        self.index = self._borrow_tree()
        largest = max(field.bytes for field in self.fields)
        least = min(LEAST_CAPACITY, max(LEAST_BYTES // largest, 1))
        capacity = min(max(FIRST_BYTES // largest, least), FIRST_CAPACITY)
        self._pools = {field.name: Pool(field, capacity) for field in (KEYS, *self.fields)}
        self.recount()
        self.runtime.grids.add(self)

    def __getitem__(self, name: str) -> DeviceArray:
        """The array of a pool, (S, ...) by slot; another one after the grid has grown."""
        return self._pools[name].array

    def __contains__(self, name: str) -> bool:
        return name in self._pools

    def __len__(self) -> int:
        return self.count - self.empty

    @property
    def capacity(self) -> int:
        """Voxels that there is room for."""
        return self._pools["keys"].capacity

    def _borrow_tree(self) -> kernels.Index:
        """An index tree without voxels: one that a map no longer uses, else a new one, because Taichi
        never frees the memory of a tree. Raises CapacityError where another one would not be safe.
        """
        free = self.runtime.free_trees
        alike = any(fields == self.fields for fields, _ in free)
        if not alike and self.runtime.trees >= MAPS_OF_A_RUN:
            # maps that only a cycle holds, as the traceback of a run that failed: compiling kernels for
            # another tree takes seconds
            gc.collect()
        if free:
            _, tree = free.pop(self._most_alike(free))
            _empty_tree(tree, _is_crowded(self.runtime, tree))
        else:
            self.runtime.count_tree()
            if _too_large(self.runtime):
                _recount(self.runtime)
            if _too_large(self.runtime):
                self.runtime.trees -= 1
                raise CapacityError(
                    "the index of another map would not fit beside those of the maps of this process: "
                    "delete or save maps, or go on in a new process; on CUDA also with a larger "
                    "device_memory_gb for uf.init"
                )
            tree = _build_tree()
        weakref.finalize(self, free.append, (self.fields, tree))
        self.runtime.followers[self.runtime.last_tree].add(tree)
        self.runtime.last_tree = tree
        return tree

    def _most_alike(self, free: Sequence[tuple[tuple[VoxelField, ...], kernels.Index]]) -> int:
        """The place of a tree for which kernels are compiled already: that of an equal map, or,
        since some kernels take two, one that came after that of the last map before, if that lives.
        """
        last = self.runtime.last_tree
        after = self.runtime.followers[last] if all(last is not tree for _, tree in free) else ()
        followers = [place for place, (_, tree) in enumerate(free) if tree in after]
        alike = [place for place, (fields, _) in enumerate(free) if fields == self.fields]
        both = [place for place in alike if place in followers]
        return [-1, *followers, *alike, *both][-1]

    def next_frame(self) -> int:
        """A new frame stamp, which makes every block number of earlier frames void."""
        runtime.check_alive(self.runtime)
        self.frame += 1
        return self.frame

    def note_touched(self, voxels: int, spare: int = 0) -> None:
        """Note that voxels were touched, which takes sparse memory also if none is encoded.

        Raises CapacityError before the memory of this map, or of all maps, with `spare` voxels more
        becomes unsafe.
        """
        self._touched += voxels
        self._note_leaves()
        if self._alone_too_large(spare) or _too_large(self.runtime, spare):
            _recount(self.runtime)
        if self._alone_too_large(spare):
            raise CapacityError(
                f"the map holds {self.count:,} voxels and its index would pass "
                f"{SPARSE_LIMIT / 1e9:.1f} GB, where Taichi is no longer safe: use larger voxels or "
                "save the map and start a new one"
            )
        if _too_large(self.runtime, spare):
            raise CapacityError(
                f"the indices of all maps of this process, {len(self.runtime.grids)} now and those "
                f"before, would pass {_index_room(self.runtime) / 1e9:.2f} GB, where Taichi is no "
                "longer safe: use larger voxels or fewer maps, or save the maps and go on in a new "
                "process; on CUDA also with a larger device_memory_gb for uf.init"
            )

    def recount(self) -> None:
        """Count the leaves of the index tree, those of earlier maps included."""
        runtime.check_alive(self.runtime)
        self._leaves, self._touched = self.index.leaves, 0  # voxels touched since they were counted
        self._note_leaves()

    def _note_leaves(self) -> None:
        """What the tree has now, at most."""
        self.runtime.leaves[self.index] = self._leaves + self._touched

    def _alone_too_large(self, spare: int) -> bool:
        return (self._leaves + self._touched + spare) * BYTES_PER_LEAF > SPARSE_LIMIT

    def reserve(self, extra: int) -> None:
        """Make room for `extra` more voxels; raises CapacityError before sparse memory becomes
        unsafe, or a pool larger than an array can be.
        """
        self.note_touched(extra)
        self._make_room(extra)

    def expect(self, extra: int, untouched: int, touched: int) -> None:
        """Make room for `extra` more voxels that come later: `touched` of them were touched now,
        `untouched` will be only then; raises as `reserve`.
        """
        self.note_touched(touched, spare=untouched)
        self._make_room(extra)

    def grow_ahead(self, extra: int) -> list[Callable[[], None]]:
        """What makes room for `extra` more voxels, a pool at a time, so that no frame waits for all of
        them; nothing where there is room, or where there can be no more.
        """
        rows = self._rows_for(extra)
        try:
            self._check_room(rows)
        except CapacityError:  # said when it is needed
            return []
        # the keys' pool last, by which it is said how many voxels there is room for
        pools = [*self._pools.values()][::-1] if rows > self.capacity else []
        return [lambda pool=pool: pool.reserve(rows, self.count) for pool in pools]

    def _make_room(self, extra: int) -> None:
        rows = self._rows_for(extra)
        self._check_room(rows)
        for pool in self._pools.values():
            pool.reserve(rows, self.count)

    def _rows_for(self, extra: int) -> int:
        """Voxels that there should be room for where `extra` more come."""
        needed = self.count + extra
        if needed <= self.capacity or self.capacity < LARGE:
            return grown(self.capacity, needed)
        return max(self.capacity + self.capacity // 4, needed)

    def _check_room(self, rows: int) -> None:
        """Raise CapacityError where a pool cannot have so many rows, before the first one changes."""
        for pool in self._pools.values():
            pool.check_room(rows, len(self))

    def claim(
        self, blocks: int, keys: DeviceArray, weights: DeviceArray, slots: DeviceArray
    ) -> int:
        """Fill `slots` (B,) with the slot of every block of positive weight, new or known, and -1
        elsewhere; counts those.
        """
        self.reserve(blocks)
        counters = np.array([self.count, 0], np.int32)
        kernels.claim_slots(blocks, keys, weights, self.index, counters, slots, self["keys"])
        runtime.synchronize()
        self.count = int(counters[0])
        return int(counters[1])

    def find(self, blocks: int, keys: DeviceArray, weights: DeviceArray, slots: DeviceArray) -> int:
        """Fill `slots` (B,) with the slot of every block of positive weight, -1 where the map has
        none; counts them.
        """
        found = np.zeros(1, np.int32)
        kernels.find_slots(blocks, keys, weights, self.index, found, slots)
        runtime.synchronize()
        return int(found[0])

    def slots_of(self, keys: NDArray[np.int32]) -> NDArray[np.int32]:
        """Slots (N,) of voxels (N, 3), -1 where there is none."""
        slots = np.empty(len(keys), np.int32)
        if len(keys):
            self.find(len(keys), np.ascontiguousarray(keys), np.ones(len(keys), np.float32), slots)
        return slots

    def release(self, blocks: int, keys: DeviceArray, slots: DeviceArray) -> None:
        """Give up the voxels of `slots` that have no weight left."""
        released = np.zeros(1, np.int32)
        kernels.release_slots(blocks, keys, slots, self["weights"], self.index, released)
        runtime.synchronize()
        self.empty += int(released[0])

    def add_pool(self, field: VoxelField) -> None:
        """Keep something more of every voxel, 0 at first, that no file holds."""
        self._pools[field.name] = Pool(field, self.capacity)

    def clear(self) -> None:
        """Remove all voxels."""
        self.retain(np.empty(0, np.int32))

    def compact(self, least: int = 4096) -> None:
        """Give the slots of removed voxels back where they are many: at least so many, and a third."""
        if self.empty and self.empty >= max(least, self.count // 3):
            self.retain(self.used_slots())

    def used_slots(self) -> NDArray[np.int32]:
        """Slots that hold a voxel."""
        if not self.empty:
            return np.arange(self.count, dtype=np.int32)
        return np.flatnonzero(self["weights"].to_numpy()[: self.count] > 0).astype(np.int32)

    def rows(self, name: str, slots: NDArray[np.int32]) -> NDArray:
        """What a field holds of the voxels in `slots`, by value."""
        return self._pools[name].take(np.ascontiguousarray(slots))

    def voxel_keys(self) -> NDArray[np.int32]:
        """(N, 3) voxel indices, in no order."""
        return self._pools[KEYS.name].take(self.used_slots())

    def sorted_slots(self) -> NDArray[np.int32]:
        """Slots that hold a voxel, sorted by its index (i, then j, then k)."""
        return self.used_slots()[np.lexsort(self.voxel_keys().T[::-1])]

    def export(self) -> VoxelData:
        """All voxels by value."""
        runtime.check_alive(self.runtime)
        return self.take(self.sorted_slots())

    def add(self, data: VoxelData) -> None:
        """Add voxels, none of which is there, exactly as they are; raises CapacityError."""
        n = len(data)
        if n:
            self.reserve(n)
            kernels.assign_slots(data.keys, self.count, self.index)
            places = np.arange(self.count, self.count + n, dtype=np.int32)
            for name, pool in self._pools.items():
                pool.put(places, data.keys if name == KEYS.name else data.fields[name])
            self.count += n

    def take(self, slots: NDArray[np.int32]) -> VoxelData:
        """The voxels in `slots` by value, in that order."""
        slots = np.ascontiguousarray(slots)
        fields = {
            field.name: self._pools[field.name].take(slots).astype(field.dtype, copy=False)
            for field in self.fields
        }
        return VoxelData(self._pools[KEYS.name].take(slots), fields)

    def retain(self, slots: NDArray[np.int32]) -> None:
        """Keep the voxels in `slots`, in ascending order, and no other; what these took of the pools
        and of the index serves the next ones. No frame may be summed up meanwhile.
        """
        runtime.check_alive(self.runtime)
        crowded = _is_crowded(self.runtime, self.index)
        if not crowded:  # a few voxels of a tree that keeps all its nodes: quicker than emptying it
            gone = self.rows(KEYS.name, np.setdiff1d(self.used_slots(), slots, assume_unique=True))
            if len(gone):
                kernels.remove_slots(gone, self.index)
        for pool in self._pools.values():
            pool.move_down(slots, self.count)
        if crowded:
            _empty_tree(self.index, crowded)
        self.count, self.empty, self.packed = len(slots), 0, self.packed + 1
        if len(slots):
            kept = self._pools[KEYS.name].take(np.arange(len(slots), dtype=np.int32))
            kernels.assign_slots(kept, 0, self.index)
        self.recount()

    @property
    def row_bytes(self) -> int:
        """Bytes of a voxel in the pools."""
        return sum(field.bytes for field in (KEYS, *self.fields))

    @property
    def index_bytes(self) -> int:
        """Bytes that the index tree takes; nodes that were given back stay in Taichi's pool."""
        runtime.check_alive(self.runtime)
        return self.index.leaves * BYTES_PER_LEAF

    @property
    def memory_bytes(self) -> int:
        """Bytes that the voxels need: pools as far as they are used, and the index tree."""
        runtime.check_alive(self.runtime)
        return self.count * self.row_bytes + _leaves_of(self.voxel_keys()) * BYTES_PER_LEAF


def _index_bytes(live: runtime.Runtime) -> int:
    """Bytes of sparse nodes that the index trees of all maps take, at most."""
    leaves = live.leaves.values()
    if live.device == "cpu":
        return live.trees * BYTES_PER_TREE + sum(leaves) * BYTES_PER_LEAF
    return live.trees * CUDA_TREE + sum(n // NODES_PER_CHUNK for n in leaves) * CUDA_CHUNK


def _index_room(live: runtime.Runtime) -> int:
    """Bytes of sparse nodes that are safe."""
    return SPARSE_POOL if live.device == "cpu" else live.sparse_pool - CUDA_RESERVE


def _too_large(live: runtime.Runtime, spare: int = 0) -> bool:
    """Whether all maps, with `spare` leaves more, take more than is safe."""
    chunk = -(-spare // NODES_PER_CHUNK) * CUDA_CHUNK
    more = spare * BYTES_PER_LEAF if live.device == "cpu" else chunk
    return _index_bytes(live) + more > _index_room(live)


def _recount(live: runtime.Runtime) -> None:
    """Count the leaves of all trees: what was touched may have been there before."""
    for grid in live.grids:
        grid.recount()
    for _, tree in live.free_trees:
        live.leaves[tree] = tree.leaves


def _leaves_of(keys: NDArray[np.int32]) -> int:
    """Leaves that hold voxels (N, 3)."""
    return len(np.unique((keys.astype(np.int64) + kernels.INDEX_HALF) // 4 @ LEAF_CODE))


def _is_crowded(live: runtime.Runtime, tree: kernels.Index) -> bool:
    """Whether an index tree gives its nodes back when it is emptied: on the CPU (taichi#6401), where
    they are many, or where the tree has more than half of its share of what is safe.

    The memory of others stays with them, their nodes at their places: nodes that are given back again
    and again while other maps live have crashed processes.
    """
    share = (SPARSE_POOL - live.trees * BYTES_PER_TREE) / live.trees
    room = min(CROWDED, share / 2)
    if live.device != "cpu" or tree.leaves * BYTES_PER_LEAF <= room:
        return False
    return kernels.count_leaves(tree) * BYTES_PER_LEAF > room


def _empty_tree(tree: kernels.Index, crowded: bool) -> None:
    """Take all voxels out of an index tree; where it is crowded, its nodes apart, to be used again."""
    kernels.clear_index(tree)
    if crowded:
        topmost: Any = tree.leaf_parent.parent(2)  # pointer node
        topmost.deactivate_all()


def _build_tree() -> kernels.Index:
    """A new index tree."""
    slot, stamp, block = (ti.field(ti.i32) for _ in range(3))
    builder = ti.FieldsBuilder()
    node = builder.pointer(ti.ijk, 64)
    for _ in range(3):
        node = node.pointer(ti.ijk, 4)
    node.bitmasked(ti.ijk, 4).place(slot, stamp, block)
    builder.finalize()
    return kernels.Index(slot, stamp, block, node)
