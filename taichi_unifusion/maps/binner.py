"""Binner: a cloud's points -> averages in the cells of the voxels that they touch (Sec. IV-A, IV-B)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ..errors import OutOfRange
from ..kernels import binning as kernels
from ..kernels.cells import BLOCK_CELLS
from ..kernels.index import INDEX_HALF, block_of_points, touch_points
from ..kernels.regression import find_neighbors
from ..runtime import DeviceArray
from .local_lim import Binned, SortedSamples
from .voxel_grid import VoxelGrid

TOGETHER = 4  # arrays of values that the kernel takes
# consecutive points a thread takes: long enough for runs in one cell, short enough to balance
CPU_CHUNK = 32
FIRST_BLOCKS = 2048  # room to begin with


@dataclass(frozen=True)
class _Blocks:
    """The voxels that a frame touches, numbered."""

    turn: int
    frame: int  # stamp of the frame in the index
    count: int
    keys: DeviceArray  # (B, 3)


@dataclass(frozen=True)
class _Sums:
    """Points, and sums over them, in the cells of blocks."""

    counts: DeviceArray  # (B, 64)
    sums: DeviceArray  # (B, 64, c)


class Binner:
    """Sums a cloud's values, `channels` in all, in the cells (quarters) of the voxels of a grid.

    A cell supports surface where it holds `support_points` points. With `with_positions` also the
    points themselves, from the cell's centre, are averaged.
    """

    def __init__(
        self,
        grid: VoxelGrid,
        voxel_size: float,
        channels: int,
        *,
        support_points: int = 1,
        with_positions: bool = False,
    ) -> None:
        self.grid, self.voxel_size, self.channels = grid, voxel_size, channels
        self.support_points, self.with_positions = support_points, with_positions
        self.chunk = CPU_CHUNK if grid.runtime.device == "cpu" else 1

    def bin(self, points: NDArray[np.float32], values: Sequence[NDArray[np.float32]]) -> Binned:
        """Average arrays of values (N, c), side by side, at points (N, 3) world [m].

        Raises OutOfRange for points beyond the index range.
        """
        blocks = self._touch(points)
        sums = self._sums("points", self.channels + 3 * self.with_positions, blocks.count)
        self._add(points, values, self.with_positions, sums)
        return self._compact(blocks, sums)

    def sort(self, samples: NDArray[np.float32], targets: NDArray[np.float32]) -> SortedSamples:
        """Sort samples (N, 3) world [m] with targets (N, c) by voxel; each is kept as it is.

        Raises OutOfRange for samples beyond the index range.
        """
        blocks = self._touch(samples, spread=True)
        block_of = np.empty(len(samples), np.int32)
        block_of_points(samples, 1.0 / self.voxel_size, self.grid.index, block_of)
        order = np.argsort(block_of, kind="stable")
        starts = np.searchsorted(block_of[order], np.arange(blocks.count + 1)).astype(np.int32)
        sums = self._sums("points", 0, blocks.count)
        self._add(samples, [], False, sums)
        binned = self._compact(blocks, sums)
        return SortedSamples(
            blocks.turn,
            blocks.count,
            blocks.keys,
            binned.neighbors,
            binned.support,
            starts,
            samples[order] / np.float32(self.voxel_size),
            np.ascontiguousarray(targets[order], dtype=np.float32),
        )

    def _touch(
        self, points: NDArray[np.float32], spread: bool = False, room: int = FIRST_BLOCKS
    ) -> _Blocks:
        """Number every voxel that holds a point, or whose doubled voxel does (`spread`)."""
        while True:
            turn, frame = self.grid.runtime.arena.next_turn(), self.grid.next_frame()
            keys = self._borrow("keys", ti.i32, room, 3)
            counters = np.zeros(2, np.int32)
            touch_points(
                points,
                1.0 / self.voxel_size,
                frame,
                self.chunk,
                spread,
                self.grid.index,
                counters,
                keys,
            )
            ti.sync()
            count, outside = int(counters[0]), int(counters[1])
            if outside:
                raise OutOfRange(
                    f"{outside} of {len(points)} points lie more than "
                    f"{INDEX_HALF * self.voxel_size:.0f} m from the origin or are not finite: move "
                    "the origin nearer to the scene, or use larger voxels"
                )
            if count <= keys.shape[0]:
                return _Blocks(turn, frame, count, keys)
            room = count

    def _add(
        self,
        points: NDArray[np.float32],
        values: Sequence[NDArray[np.float32]],
        with_positions: bool,
        sums: _Sums,
    ) -> None:
        if len(values) > TOGETHER:
            values = [*values[: TOGETHER - 1], np.hstack(values[TOGETHER - 1 :])]
        nothing = TOGETHER - len(values)
        channels = tuple(array.shape[1] for array in values) + (0,) * nothing
        values_0, values_1, values_2, values_3 = [*values, *[points] * nothing]
        kernels.bin_points(
            points,
            values_0,
            values_1,
            values_2,
            values_3,
            channels,
            1.0 / self.voxel_size,
            self.chunk,
            with_positions,
            self.grid.index,
            sums.counts,
            sums.sums,
        )

    def _compact(self, blocks: _Blocks, sums: _Sums) -> Binned:
        """A row for every cell with points; the sums become 0."""
        n, width = blocks.count, sums.sums.shape[2]
        masks, support = self._borrow("masks", ti.u32, n, 2), self._borrow("support", ti.u32, n, 2)
        totals, neighbors = (
            self._borrow("totals", ti.i32, n),
            self._borrow("neighbors", ti.i32, n, 27),
        )
        occupied = np.empty(n, np.int32)
        kernels.mark_cells(n, sums.counts, self.support_points, masks, support, totals, occupied)
        ti.sync()
        starts = (np.cumsum(occupied) - occupied).astype(np.int32)
        cells = self._borrow("cells", ti.f32, int(occupied.sum()), 1 + width)
        kernels.compact_cells(n, starts, masks, width, sums.counts, sums.sums, cells)
        find_neighbors(self.grid.index, blocks.frame, n, blocks.keys, neighbors)
        return Binned(blocks.turn, n, blocks.keys, neighbors, masks, support, totals, starts, cells)

    def _sums(self, use: str, width: int, blocks: int) -> _Sums:
        return _Sums(
            self._borrow(f"{use}: counts", ti.i32, blocks, BLOCK_CELLS),
            self._borrow(f"{use}: sums", ti.i64, blocks, BLOCK_CELLS, max(width, 1)),
        )

    def _borrow(self, name: str, dtype: Any, rows: int, *row: int) -> DeviceArray:
        return self.grid.runtime.arena.borrow(name, dtype, (max(rows, FIRST_BLOCKS), *row))


class SurfelBinner(Binner):
    """Averages points and normals in cells; each average is a surfel, which gives samples at the
    cells along its normal, `steps` voxels from it.

    A sample is moved to its cell's centre, and its target is the centre's distance to the surfel's
    plane: exact to first order, and its features come from a table.
    """

    def __init__(
        self,
        grid: VoxelGrid,
        voxel_size: float,
        steps: NDArray[np.float32],
        *,
        support_points: int,
        with_normals: bool,
    ) -> None:
        super().__init__(grid, voxel_size, 1 + 3 * with_normals, support_points=support_points)
        self.steps, self.with_normals = steps, with_normals

    def bin(self, points: NDArray[np.float32], values: Sequence[NDArray[np.float32]]) -> Binned:
        """Samples of the surfels of points (N, 3) world [m] with unit normals (N, 3): distances
        [voxels], and normals if asked for. Raises OutOfRange for points beyond the index range.
        """
        room = FIRST_BLOCKS
        while True:
            blocks = self._touch(points, room=room)
            surfels = self._sums("surfels", 6, blocks.count)
            self._add(points, values, True, surfels)
            room = self._touch_samples(blocks, surfels)
            if room <= blocks.keys.shape[0]:
                break
            surfels.counts.fill(0)
            surfels.sums.fill(0)
        samples = self._sums("points", self.channels, room)
        kernels.bin_surfel_samples(
            blocks.count,
            blocks.keys,
            self.steps,
            self.with_normals,
            self.grid.index,
            surfels.counts,
            surfels.sums,
            samples.counts,
            samples.sums,
        )
        return self._compact(replace(blocks, count=room), samples)

    def _touch_samples(self, blocks: _Blocks, surfels: _Sums) -> int:
        """Number the voxels of the samples beside the surfels too; returns how many blocks there
        are, which may be more than there was room for.
        """
        counters = np.array([blocks.count, 0], np.int32)
        kernels.touch_surfel_samples(
            blocks.count,
            surfels.counts,
            surfels.sums,
            self.steps,
            blocks.frame,
            self.grid.index,
            blocks.keys,
            counters,
        )
        ti.sync()
        return int(counters[0])
