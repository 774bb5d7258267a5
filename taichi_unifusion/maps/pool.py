"""Pools: the data of voxels, a row each, on the device."""

from __future__ import annotations

from math import prod

import numpy as np
from numpy.typing import NDArray

from ..device_arrays import DeviceArray
from ..errors import CapacityError
from ..kernels import ti
from ..kernels.pools import copy_rows, gather_rows, scatter_rows
from .voxel_data import VoxelField

MAX_ELEMENTS = 2**31 - 1  # of an array of Taichi
MOVED = 65_536  # rows moved at once
_TAICHI = {
    np.dtype(np.float32): ti.f32,
    np.dtype(np.float16): ti.f16,
    np.dtype(np.int32): ti.i32,
    np.dtype(np.int8): ti.i8,
    np.dtype(np.uint32): ti.u32,
    np.dtype(np.uint16): ti.u16,
    np.dtype(np.float64): ti.f64,
}


class Pool:
    """Rows of one field on the device; more room keeps what they hold."""

    def __init__(self, field: VoxelField, capacity: int) -> None:
        self.field = field
        self.array: DeviceArray = self._allocate(capacity)

    def _allocate(self, capacity: int) -> DeviceArray:
        return ti.ndarray(_TAICHI[self.field.dtype], (capacity, *self.field.shape))

    @property
    def capacity(self) -> int:
        return self.array.shape[0]

    def check_room(self, rows: int, used: int) -> None:
        """Raise CapacityError where `rows` rows are more than an array of Taichi can hold."""
        if rows * prod(self.field.shape) > MAX_ELEMENTS:
            numbers = " x ".join(map(str, self.field.shape))
            raise CapacityError(
                f"the map holds {used:,} voxels of {numbers} numbers, as many as fit into an "
                "array: use larger voxels or save the map and start a new one"
            )

    def reserve(self, rows: int, used: int) -> None:
        """Make room for `rows` rows, of which the first `used` are kept."""
        if rows <= self.capacity:
            return
        old = self.array
        self.array = self._allocate(rows)
        if used:
            copy_rows(used, old, self.array)

    def take(self, slots: NDArray[np.int32]) -> NDArray:
        """The rows in `slots`, in order, by value."""
        rows = np.empty((len(slots), *self.field.shape), self.field.dtype)
        if rows.size:
            gather_rows(slots, self.array, rows)
        return rows

    def put(self, slots: NDArray[np.int32], rows: NDArray) -> None:
        """Fill the rows in `slots`, each once."""
        if rows.size:
            scatter_rows(slots, np.ascontiguousarray(rows), self.array)

    def move_down(self, slots: NDArray[np.int32], used: int) -> None:
        """Make the rows in `slots`, in ascending order, the first ones of the `used`; the others
        become 0, as rows are that no voxel has had yet.
        """
        for begin in range(0, len(slots), MOVED):
            part = np.ascontiguousarray(slots[begin : begin + MOVED])
            # rows that are still to be moved lie above those that are filled here
            self.put(np.arange(begin, begin + len(part), dtype=np.int32), self.take(part))
        for begin in range(len(slots), used, MOVED):
            places = np.arange(begin, min(begin + MOVED, used), dtype=np.int32)
            self.put(places, np.zeros((len(places), *self.field.shape), self.field.dtype))
