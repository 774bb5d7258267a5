"""Per-frame scratch: which voxels a frame touches, and the sums over its points in each of their
cells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ..errors import OutOfRange
from ..kernels import cells as kernels
from ..kernels.voxels import BLOCK_CELLS, INDEX_HALF, touch_points
from .voxel_grid import VoxelGrid

TOGETHER = 4  # arrays of values that the kernel takes
# consecutive points a thread takes: long enough for runs in one cell, short enough to balance
CPU_CHUNK = 32


class FrameBlocks:
    """Blocks of the current frame, with `channels` sums a cell; grows to what a frame needs and
    keeps that room.
    """

    def __init__(self, grid: VoxelGrid, channels: int, with_positions: bool) -> None:
        self.grid, self.channels, self.with_positions = grid, channels, with_positions
        self.chunk = CPU_CHUNK if grid.runtime.device == "cpu" else 1
        self.count = 0
        self.sample_blocks = 0
        self.frame = 0
        self.starts = np.empty(0, np.int32)
        self.cells = ti.ndarray(ti.f32, (1, 1))
        self._allocate(2048)

    def _allocate(self, capacity: int) -> None:
        self.keys = ti.ndarray(ti.i32, (capacity, 3))
        self.counts = ti.ndarray(ti.i32, (capacity, BLOCK_CELLS))
        self.sums = ti.ndarray(
            ti.i64, (capacity, BLOCK_CELLS, self.channels + 3 * self.with_positions)
        )
        self.masks, self.support = (
            ti.ndarray(ti.u32, (capacity, 2)),
            ti.ndarray(ti.u32, (capacity, 2)),
        )
        self.totals = ti.ndarray(ti.i32, (capacity,))

    @property
    def capacity(self) -> int:
        return self.keys.shape[0]

    def touch(self, points: NDArray[np.float32], voxel_size: float, spread: bool = False) -> None:
        """Give every voxel that holds a point, or whose doubled voxel does (`spread`), a block
        number.

        Raises OutOfRange for points beyond the index range.
        """
        while True:
            self.frame = self.grid.next_frame()
            counters = np.zeros(2, np.int32)
            touch_points(
                points,
                1.0 / voxel_size,
                self.frame,
                self.chunk,
                spread,
                self.grid.stamp,
                self.grid.block,
                self.keys,
                counters,
            )
            ti.sync()
            self.count, outside = int(counters[0]), int(counters[1])
            if outside:
                reach = INDEX_HALF * voxel_size
                raise OutOfRange(
                    f"{outside} of {len(points)} points lie more than {reach:.0f} m from the origin or are not "
                    "finite: move the origin nearer to the scene, or use larger voxels"
                )
            if self.count <= self.capacity:
                return
            self._allocate(self.count * 5 // 4)

    def bin(
        self, points: NDArray[np.float32], values: Sequence[NDArray[np.float32]], voxel_size: float
    ) -> None:
        """Sum arrays of values (N, c), side by side, and positions into the cells of the touched
        blocks.
        """
        if len(values) > TOGETHER:
            values = [*values[: TOGETHER - 1], np.hstack(values[TOGETHER - 1 :])]
        nothing = TOGETHER - len(values)
        channels = tuple(array.shape[1] for array in values) + (0,) * nothing
        kernels.bin_points(
            points,
            *values,
            *[points] * nothing,
            channels,
            1.0 / voxel_size,
            self.chunk,
            self.with_positions,
            self.grid.block,
            self.counts,
            self.sums,
        )

    def touch_samples(self, offsets: NDArray[np.float32]) -> bool:
        """Also give numbers to the voxels of the samples beside the surfels; False where room had
        to be made: begin again.
        """
        counters = np.array([self.count, 0], np.int32)
        kernels.touch_surfel_samples(
            self.count,
            self.counts,
            self.sums,
            offsets,
            self.frame,
            self.grid.stamp,
            self.grid.block,
            self.keys,
            counters,
        )
        ti.sync()
        if counters[0] > self.capacity:
            self._allocate(int(counters[0]) * 5 // 4)
            return False
        self.sample_blocks = int(counters[0])
        return True

    def bin_samples(self, surfels: FrameBlocks, offsets: NDArray[np.float32]) -> None:
        """Sum the signed distances of the samples on and beside another frame's surfels into cells;
        shares its blocks.
        """
        if self.capacity < surfels.capacity:
            self._allocate(surfels.capacity)
        self.keys, self.frame, self.count = surfels.keys, surfels.frame, surfels.sample_blocks
        kernels.bin_surfel_samples(
            surfels.count,
            surfels.keys,
            offsets,
            self.channels > 1,
            self.grid.block,
            surfels.counts,
            surfels.sums,
            self.counts,
            self.sums,
        )

    def compact(self, support_points: int) -> None:
        """Sums -> `starts` and `cells`, a row for every cell with points, and support by
        `support_points`; sums become 0.
        """
        occupied = np.empty(self.count, np.int32)
        kernels.mark_cells(
            self.count, self.counts, support_points, self.masks, self.support, self.totals, occupied
        )
        ti.sync()
        self.starts = (np.cumsum(occupied) - occupied).astype(np.int32)
        total = int(occupied.sum())
        if total > self.cells.shape[0]:
            self.cells = ti.ndarray(ti.f32, (total * 5 // 4, 1 + self.sums.shape[2]))
        kernels.compact_cells(
            self.count,
            self.starts,
            self.masks,
            self.sums.shape[2],
            self.counts,
            self.sums,
            self.cells,
        )

    def bin_support(
        self, points: NDArray[np.float32], voxel_size: float, support_points: int
    ) -> None:
        """Only the support masks, from points in touched blocks."""
        kernels.bin_points(
            *[points] * (1 + TOGETHER),
            (0,) * TOGETHER,
            1.0 / voxel_size,
            self.chunk,
            False,
            self.grid.block,
            self.counts,
            self.sums,
        )
        self.compact(support_points)
