"""KeptCells: the averages of a window in the cells that it was fused from, quantised, by value.

What is fused is what is kept: the sums in the cells become those of the quantised averages before
they are encoded. So the local LIM of the same cells is the same to the bit at any later time, and
that of points moved by a rigid transform is, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels import keeping as kernels
from ..kernels.binning import FIXED
from ..kernels.cells import BLOCK_CELLS, CELLS
from ..kernels.index import block_of_points
from ..kernels.patches import Values
from ..types import PointCloud
from .binner import Binner, SurfelBinner, patches_of
from .local_lim import Binned, CellArrays, OpenCells

MOST_COUNT = 65535  # pixels of a cell that count
HALF_CELL = 0.5 / CELLS  # [voxels]
BYTE = 1e-3  # beyond 0..1, of rounding, that is left of values that were bytes
OFFSETS = np.array([(c >> 4, c >> 2 & 3, c & 3) for c in range(BLOCK_CELLS)], np.float32)


@dataclass(frozen=True)
class Levels:
    """Whole numbers in the place of the values of some channels: `first` + `step` times each."""

    numbers: NDArray  # (M, c) int8, uint8 or uint16
    first: NDArray[np.float32]  # (c,)
    step: NDArray[np.float32]  # (c,)

    @classmethod
    def signed(cls, values: NDArray[np.float32], most: float) -> Levels:
        """In 8 bits, values of at most `most`."""
        steps = 127 / most
        numbers = np.clip(np.rint(values * steps), -127, 127).astype(np.int8)
        c = values.shape[1]
        return cls(numbers, np.zeros(c, np.float32), np.full(c, 1 / steps, np.float32))

    @classmethod
    def between(cls, values: NDArray[np.float32]) -> Levels:
        """In 8 bits where all lie in 0..1 in all channels, as those of colours do; else in 16 bits
        from the smallest value of a channel to the largest.
        """
        n, c = values.shape
        columns = [np.ascontiguousarray(values[:, i]) for i in range(c)] if n else [np.zeros(1)] * c
        low = np.array([column.min() for column in columns])  # over columns: ten times as fast
        high = np.array([column.max() for column in columns])
        if c == 3 and (low >= -BYTE).all() and (high <= 1 + BYTE).all():
            low, step, dtype = np.zeros(c), np.full(c, 1 / 255), np.uint8
        else:
            step, dtype = np.maximum((high.astype(np.float64) - low) / 65535, 1e-30), np.uint16
        first, step = low.astype(np.float32), step.astype(np.float32)
        most = np.iinfo(dtype).max
        return cls(np.clip(np.rint((values - first) / step), 0, most).astype(dtype), first, step)

    @property
    def values(self) -> NDArray[np.float32]:
        """(M, c)."""
        return (self.first + self.step * self.numbers.astype(np.float32)).astype(np.float32)


@dataclass(frozen=True)
class KeptCells:
    """Averages in the cells of the voxels (blocks) that a window's frames touched, sorted by voxel."""

    keys: NDArray[np.int32]  # (B, 3) voxels
    frames: NDArray[np.int32]  # (B,) bits of the frames of the window that saw each
    masks: NDArray[np.uint8]  # (B, 8) cells that hold points, first cell in the highest bit
    counts: NDArray[np.uint16]  # (M,) pixels of each such cell
    levels: tuple[Levels, ...]  # of M cells: normals and positions, or what maps take, side by side
    exponents: tuple[int, ...]  # of the values, as `OpenCells` has them

    @classmethod
    def of(cls, opened: OpenCells, binner: Binner, channels: Sequence[int]) -> KeptCells:
        """What is summed up, of maps of so many `channels`; the sums become what is kept of them."""
        n, arrays = opened.count, opened.arrays
        keys = arrays.keys.to_numpy()[:n]
        order = np.lexsort(keys[:, 2::-1].T)
        occupied = np.zeros(max(n, 1), np.int32)
        kernels.count_cells(n, arrays.sums, occupied)
        occupied = occupied[:n]
        starts = np.empty(max(n, 1), np.int32)
        starts[order] = np.cumsum(occupied[order]) - occupied[order]
        total = int(occupied.sum())
        places, counts = np.empty(max(total, 1), np.int32), np.empty(max(total, 1), np.int32)
        means = np.empty((max(total, 1), arrays.width), np.float32)
        kernels.gather_cells(n, starts, arrays.sums, places, counts, means)
        places, counts, means = places[:total], counts[:total], means[:total]
        masks = np.zeros((n, BLOCK_CELLS), np.bool_)
        masks[np.repeat(np.arange(n), occupied[order]), places] = True
        kept = cls(
            np.ascontiguousarray(keys[order, :3]),
            np.ascontiguousarray(keys[order, 3]),
            np.packbits(masks, axis=1),
            np.minimum(counts, MOST_COUNT).astype(np.uint16),
            _levels(means, binner, channels),
            opened.exponents,
        )
        if total:
            blocks = np.repeat(order.astype(np.int32), occupied[order])
            kernels.scatter_cells(blocks, places, kept.sums(), arrays.sums)
        return kept

    @property
    def nbytes(self) -> int:
        """Bytes that this takes, not compressed."""
        levels = sum(each.numbers.nbytes for each in self.levels)
        return levels + sum(
            each.nbytes for each in (self.keys, self.frames, self.masks, self.counts)
        )

    @property
    def cells(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Row of its voxel (M,), and number in that (M,), of every cell."""
        rows, places = np.nonzero(np.unpackbits(self.masks, axis=1))
        return rows.astype(np.int32), places.astype(np.int32)

    @property
    def means(self) -> NDArray[np.float32]:
        """(M, c) averages, scaled by the exponents."""
        empty = np.empty((len(self.counts), 0), np.float32)
        return np.hstack([empty, *(each.values for each in self.levels)], dtype=np.float32)

    def sums(self) -> NDArray[np.int64]:
        """(M, 1 + c) counts, then fixed-point sums."""
        counts = self.counts.astype(np.int64)[:, None]
        return np.hstack([counts, counts * np.rint(self.means * FIXED).astype(np.int64)])

    def points(self, voxel_size: float, with_positions: bool) -> NDArray[np.float32]:
        """(M, 3) [m] where the average of each cell lies, or its centre."""
        rows, places = self.cells
        inner = (OFFSETS[places] + np.float32(0.5)) / np.float32(CELLS)
        if with_positions:
            inner += self.levels[-1].values
        return ((self.keys[rows] + inner) * np.float32(voxel_size)).astype(np.float32)

    def binned(
        self, binner: Binner, arrays: CellArrays, T: NDArray[np.float64] | None = None
    ) -> Binned:
        """The averages as they were fused, on loan from the arena of the runtime; with `T` moved by
        it. Raises OutOfRange as `Binner.bin`, with nothing changed.
        """
        return self._where_it_was(binner, arrays) if T is None else self._moved(binner, arrays, T)

    def _where_it_was(self, binner: Binner, arrays: CellArrays) -> Binned:
        centers = ((self.keys + np.float32(0.5)) * np.float32(binner.voxel_size)).astype(np.float32)
        opened = binner.open(arrays, self.exponents)
        if not len(centers):
            return binner.close(opened, binner.grid.runtime.arena)
        opened = binner.touch(opened, patches_of(PointCloud(centers), binner.grid.runtime.device))
        index, per_meter = binner.grid.index, 1.0 / binner.voxel_size
        blocks = np.empty(len(centers), np.int32)
        block_of_points(centers, per_meter, index, blocks)
        rows, places = self.cells
        kernels.scatter_cells(
            np.ascontiguousarray(blocks[rows]), places, self.sums(), opened.arrays.sums
        )
        kernels.mark_points(
            opened.count, centers, self.frames, per_meter, index, opened.arrays.keys
        )
        return binner.close(opened, binner.grid.runtime.arena)

    def _moved(self, binner: Binner, arrays: CellArrays, T: NDArray[np.float64]) -> Binned:
        rows, _ = self.cells
        points = self.points(binner.voxel_size, binner.with_positions).astype(np.float64)
        points = (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        opened = binner.open(arrays, self.exponents)
        if not len(points):
            return binner.close(opened, binner.grid.runtime.arena)
        cloud = PointCloud(points, counts=self.counts.astype(np.int32))
        patches = patches_of(cloud, binner.grid.runtime.device)
        opened = binner.touch(opened, patches)
        binner.add(opened, patches, self._carried(binner, cloud, T))
        kernels.mark_points(
            opened.count,
            points,
            np.ascontiguousarray(self.frames[rows]),
            1.0 / binner.voxel_size,
            binner.grid.index,
            opened.arrays.keys,
        )
        return binner.close(opened, binner.grid.runtime.arena)

    def _carried(self, binner: Binner, cloud: PointCloud, T: NDArray[np.float64]) -> list[Values]:
        """What moved points carry: normals that turn with them, or values."""
        if isinstance(binner, SurfelBinner):
            normals = self.levels[0].values.astype(np.float64) @ T[:3, :3].T
            return [Values(np.ascontiguousarray(normals, np.float32), cloud.counts)]
        if binner.with_positions:
            return []
        units = np.ones(binner.channels, np.float32)
        units[: len(self.exponents)] = 2.0 ** np.array(self.exponents, np.float64)
        return [Values(np.ascontiguousarray(self.means * units, np.float32), cloud.counts)]


def _levels(
    means: NDArray[np.float32], binner: Binner, channels: Sequence[int]
) -> tuple[Levels, ...]:
    positions = [Levels.signed(means[:, -3:], HALF_CELL)] if binner.with_positions else []
    if isinstance(binner, SurfelBinner):
        return (Levels.signed(means[:, :3], 1.0), *positions)
    ends = np.cumsum([0, *channels])
    own = [Levels.between(means[:, a:b]) for a, b in zip(ends, ends[1:], strict=False)]
    return (*own, *positions)
