"""Binner: points -> averages in the cells of the voxels that they touch (Sec. IV-A, IV-B)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..device_arrays import Arena, DeviceArray
from ..errors import OutOfRange
from ..kernels import binning as kernels
from ..kernels import ti
from ..kernels.binning import KEY_COLUMNS
from ..kernels.index import INDEX_HALF, block_of_points, forget_blocks, touch_points
from ..kernels.patches import Patches, Sink, Target, Values
from ..kernels.pools import copy_rows
from ..kernels.regression import find_neighbors
from ..types import PointCloud
from .local_lim import FIRST_BLOCKS, Binned, CellArrays, OpenCells, SortedSamples
from .voxel_grid import VoxelGrid

TOGETHER = 3  # arrays of values that the kernel takes
# consecutive points a thread takes: long enough for runs in one cell, short enough to balance
CPU_CHUNK = 32
NEIGHBORHOOD = 27  # voxels that a block's surfels may reach: itself and those around it


class Binner:
    """Sums what clouds carry, `channels` values in all, in the cells (quarters) of the voxels of a
    grid.

    A cell supports surface where it holds `support_points` points. With `with_positions` also the
    points themselves, from the cell's centre, are averaged.
    """

    frames = kernels.POINT_FRAMES  # column of the keys with the bits of the frames that count

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

    @property
    def width(self) -> int:
        """How many values are summed in a cell."""
        return self.channels + 3 * self.with_positions

    def open(self, arrays: CellArrays, exponents: tuple[int, ...] = ()) -> OpenCells:
        """No points yet, in arrays of this binner's width that hold none; `exponents` of the powers
        of two that the values of each channel are divided by.
        """
        assert arrays.width == self.width
        if self.grid.unclosed is not None:  # an exception came between; its keys are there still
            keys = self.grid.unclosed.keys
            forget_blocks(0, keys.shape[0], keys, self.grid.index)
        self.grid.unclosed = arrays
        return OpenCells(arrays, self.grid.next_frame(), 0, exponents)

    def touch(self, cells: OpenCells, patches: Patches) -> OpenCells:
        """Make room for the voxels that patches lie in; nothing is summed yet.

        Raises OutOfRange for points beyond the index range, with the cells as they were.
        """
        return self._touch(cells, patches, spread=False)

    def forget(self, cells: OpenCells, before: OpenCells) -> None:
        """Undo what `touch` did since `before`."""
        forget_blocks(before.count, cells.count, cells.arrays.keys, self.grid.index)

    def target(self, cells: OpenCells) -> Target:
        """The cells as `make_patches` takes them."""
        arrays = cells.arrays
        sink = Sink(self.grid.index, 1.0 / self.voxel_size)
        return Target(sink, cells.stamp, cells.count, arrays.keys, arrays.sums)

    def reaches(self, T_world_camera: NDArray[np.float64], reach: float) -> bool:
        """Whether all points within `reach` [m] of a camera lie in the index range."""
        farthest = float(np.abs(T_world_camera[:3, 3]).max()) + reach
        return farthest < (INDEX_HALF - 1) * self.voxel_size

    def add(
        self, cells: OpenCells, patches: Patches, values: Sequence[Values], frame: int = 0
    ) -> None:
        """Sum up patches, whose voxels were touched, and what they carry; `frame` is the number of
        theirs in its window.
        """
        arrays = [each.values for each in values]
        counts = values[0].counts if values else patches.counts
        firsts = np.cumsum([0, *(array.shape[1] for array in arrays[:-1])])
        scales = [2.0 ** -int(cells.exponents[i]) if cells.exponents else 1.0 for i in firsts]
        if len(arrays) > TOGETHER:
            rest = slice(TOGETHER - 1, None)
            arrays = [*arrays[: TOGETHER - 1], _side_by_side(arrays[rest], scales[rest])]
            scales[rest] = [1.0]
        nothing = TOGETHER - len(arrays)
        channels = tuple(array.shape[1] for array in arrays) + (0,) * nothing
        values_0, values_1, values_2 = [*arrays, *[patches.points] * nothing]
        kernels.bin_points(
            patches.found,
            patches.slots,
            patches.points,
            counts,
            values_0,
            values_1,
            values_2,
            channels,
            kernels.Scales([1.0 / self.voxel_size, *scales, *[1.0] * nothing]),
            1 << frame,
            self.with_positions,
            self.grid.index,
            cells.arrays.keys,
            cells.arrays.sums,
        )

    def close(self, cells: OpenCells, arena: Arena) -> Binned:
        """Average what was summed; the arrays of the cells hold nothing then. What comes out is on
        loan from `arena`.
        """
        return self._compact(cells, arena)

    def bin(
        self, patches: Patches, values: Sequence[Values], exponents: tuple[int, ...] = ()
    ) -> Binned:
        """Average what patches carry, side by side; `exponents` as in `open`.

        Raises OutOfRange for points beyond the index range.
        """
        opened = self.open(self.shared(), exponents)
        cells = self.touch(opened, patches)
        self.add(cells, patches, values)
        return self.close(cells, self.grid.runtime.arena)

    def shared(self) -> CellArrays:
        """Arrays that all maps use in turn, for what is averaged at once."""
        return self._shared("cells", self.width)

    def sort(self, samples: NDArray[np.float32], targets: NDArray[np.float32]) -> SortedSamples:
        """Sort samples (N, 3) world [m] with targets (N, c) by voxel; each is kept as it is.

        Raises OutOfRange for samples beyond the index range.
        """
        counting = Binner(self.grid, self.voxel_size, 0, support_points=self.support_points)
        patches = patches_of(PointCloud(samples), self.grid.runtime.device)
        cells = counting._touch(counting.open(self._shared("cells", 0)), patches, spread=True)
        block_of = np.empty(len(samples), np.int32)
        block_of_points(samples, 1.0 / self.voxel_size, self.grid.index, block_of)
        order = np.argsort(block_of, kind="stable")
        starts = np.searchsorted(block_of[order], np.arange(cells.count + 1)).astype(np.int32)
        counting.add(cells, patches, [])
        binned = counting.close(cells, self.grid.runtime.arena)
        return SortedSamples(
            binned.loan,
            binned.count,
            binned.keys,
            binned.neighbors,
            binned.support,
            starts,
            samples[order] / np.float32(self.voxel_size),
            np.ascontiguousarray(targets[order], dtype=np.float32),
        )

    def _touch(self, cells: OpenCells, patches: Patches, *, spread: bool) -> OpenCells:
        """Number every voxel that holds a point, or whose doubled voxel does (`spread`)."""
        arrays = cells.arrays
        # as many at most
        arrays.reserve_keys(cells.count + (8 if spread else 1) * patches.total, cells.count)
        counters = np.array([cells.count, 0], np.int32)
        touch_points(
            patches.found,
            patches.slots,
            patches.points,
            patches.counts,
            1.0 / self.voxel_size,
            cells.stamp,
            spread,
            self.grid.index,
            counters,
            arrays.keys,
        )
        ti.sync()
        after, outside = replace(cells, count=int(counters[0])), int(counters[1])
        if outside:
            self.forget(after, cells)
            raise OutOfRange(
                f"{outside} of {patches.total} points lie more than "
                f"{INDEX_HALF * self.voxel_size:.0f} m from the origin or are not finite: move "
                "the origin nearer to the scene, or use larger voxels"
            )
        arrays.reserve(after.count, cells.count)
        return after

    def _compact(self, cells: OpenCells, arena: Arena) -> Binned:
        """A row for every cell with points; the sums become 0."""
        n, arrays, loan = cells.count, cells.arrays, arena.next_turn()

        def borrow(name: str, dtype: Any, *row: int) -> DeviceArray:
            return arena.borrow(name, dtype, (max(n, FIRST_BLOCKS), *row))

        # a copy: the next window begins before this one is fused
        keys = borrow("keys", ti.i32, KEY_COLUMNS)
        copy_rows(n, arrays.keys, keys)
        masks, support = borrow("masks", ti.u32, 2), borrow("support", ti.u32, 2)
        neighbors, rows = borrow("neighbors", ti.i32, 27), np.zeros((max(n, 1), 3), np.int32)
        kernels.mark_cells(
            n, arrays.sums, self.support_points, self.frames, arrays.keys, masks, support, rows
        )
        ti.sync()
        total = int(rows[:, 0].sum())
        rows[:, 0] = np.cumsum(rows[:, 0]) - rows[:, 0]
        room = max(total, FIRST_BLOCKS)
        averages = arena.borrow("averages", ti.f32, (room, 1 + arrays.width))
        units = np.ones(max(arrays.width, 1), np.float32)
        units[: len(cells.exponents)] = 2.0 ** np.array(cells.exponents, np.float64)
        kernels.compact_cells(n, rows, masks, arrays.width, units, arrays.sums, averages)
        find_neighbors(self.grid.index, cells.stamp, n, keys, neighbors)
        forget_blocks(0, n, keys, self.grid.index)
        if n:
            self.grid.unclosed = None
        return Binned(loan, n, keys, neighbors, masks, support, rows, averages)

    def _shared(self, use: str, width: int) -> CellArrays:
        """Arrays that all maps use in turn, for a cloud that is averaged at once."""
        arena = self.grid.runtime.arena
        return arena.exact(use, lambda: CellArrays(width), (width,))


class SurfelBinner(Binner):
    """Averages points and normals in cells; each average is a surfel, which gives samples at the
    cells along its normal, `steps` voxels from it.

    A sample is moved to its cell's centre, and its target is the centre's distance to the surfel's
    plane: exact to first order, and its features come from a table.
    """

    frames = kernels.SAMPLE_FRAMES

    def __init__(
        self,
        grid: VoxelGrid,
        voxel_size: float,
        steps: NDArray[np.float32],
        *,
        support_points: int,
        with_normals: bool,
    ) -> None:
        super().__init__(grid, voxel_size, 3, support_points=support_points, with_positions=True)
        self.steps, self.with_normals = steps, with_normals

    def close(self, cells: OpenCells, arena: Arena) -> Binned:
        """Average samples of the surfels: distances [voxels], and normals if asked for."""
        surfels, count = cells.arrays, cells.count
        surfels.reserve_keys(NEIGHBORHOOD * count, count)
        counters = np.array([count, 0], np.int32)
        kernels.touch_surfel_samples(
            count,
            surfels.sums,
            self.steps,
            cells.stamp,
            self.grid.index,
            surfels.keys,
            counters,
        )
        ti.sync()
        samples = self._shared("samples", 1 + 3 * self.with_normals)
        samples.keys, room = surfels.keys, int(counters[0])
        samples.reserve(room, 0)
        kernels.bin_surfel_samples(
            count,
            self.steps,
            self.with_normals,
            self.grid.index,
            surfels.keys,
            surfels.sums,
            samples.sums,
        )
        return self._compact(replace(cells, arrays=samples, count=room), arena)


def patches_of(cloud: PointCloud, device: str) -> Patches:
    """A cloud in world coordinates as patches of a pixel each, or of what it says."""
    n, slots = len(cloud), CPU_CHUNK if device == "cpu" else 1
    found = np.full(-(-n // slots), slots, np.int32)
    if n % slots:
        found[-1] = n % slots
    counts = np.ones(n, np.int32) if cloud.counts is None else cloud.counts
    attributes = {name: Values(values, counts) for name, values in cloud.attributes.items()}
    pixels = int(counts.sum())
    return Patches(slots, found, cloud.points, counts, cloud.normals, attributes, n, pixels, (0, 0))


def _side_by_side(arrays: Sequence[DeviceArray], scales: Sequence[float]) -> NDArray[np.float32]:
    """Arrays of values (N, c), each times its scale, as one."""
    rows = [each if isinstance(each, np.ndarray) else each.to_numpy() for each in arrays]
    few = min(map(len, rows))
    return np.hstack(
        [each[:few] * np.float32(scale) for each, scale in zip(rows, scales, strict=True)]
    )
