"""What passes between the steps of a map: sums in cells, binned points, sorted samples, and a local
LIM.

Where a value holds a loan, its arrays are on loan from an arena: whoever wants to keep a local LIM
takes a copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..device_arrays import DeviceArray, Loan, grown
from ..kernels import ti
from ..kernels.binning import KEY_COLUMNS
from ..kernels.cells import BLOCK_CELLS
from ..kernels.pools import copy_rows

FIRST_BLOCKS = 2048  # room to begin with
FIRST_BYTES = 32 << 20  # of sums: what a frame of a room takes and more
WINDOW_BYTES = 128 << 20  # of a window's: what ten frames take, so that hardly any video waits


class CellArrays:
    """Room for the cells of touched voxels, which grows: sums of `width` values beside the counts.

    All sums and bits are 0 where nothing is summed up.
    """

    def __init__(self, width: int, first_bytes: int = FIRST_BYTES) -> None:
        self.width = width
        blocks = max(first_bytes // self.block_bytes, FIRST_BLOCKS)
        # voxel of each block, and bits of the frames that saw it
        self.keys: DeviceArray = ti.ndarray(ti.i32, (blocks, KEY_COLUMNS))
        # counts, then fixed-point sums of values, by cell
        self.sums: DeviceArray = ti.ndarray(ti.i64, (blocks, BLOCK_CELLS, 1 + width))

    @property
    def block_bytes(self) -> int:
        """Bytes of one block's sums."""
        return 8 * BLOCK_CELLS * (1 + self.width)

    @property
    def room(self) -> int:
        """Blocks that there is room for."""
        return self.sums.shape[0]

    def reserve_keys(self, rows: int, used: int) -> None:
        """Make room for the keys of `rows` blocks; the first `used` are kept."""
        self.keys = _grow(self.keys, rows, used)

    def grow_ahead(self, blocks: int) -> None:
        """Make room for the next window after one of so many blocks, while nothing is summed up:
        to grow later would take a copy, for which a frame would wait.
        """
        if 3 * blocks > 2 * self.room:
            self.reserve_keys(2 * self.room, 0)
            self.reserve(2 * self.room, 0)

    def reserve(self, rows: int, used: int) -> None:
        """Make room for the sums of `rows` blocks; the first `used` are kept."""
        self.sums = _grow(self.sums, rows, used)


def _grow(array: DeviceArray, rows: int, used: int) -> DeviceArray:
    if rows <= array.shape[0]:
        return array
    larger: DeviceArray = ti.ndarray(array.dtype, (grown(array.shape[0], rows), *array.shape[1:]))
    if used:
        copy_rows(used, array, larger)
    return larger


@dataclass(frozen=True)
class OpenCells:
    """Points of one or more frames, summed in the cells of the blocks (voxels) that they touch."""

    arrays: CellArrays
    stamp: int  # of these blocks in the index of the grid
    count: int  # blocks
    exponents: tuple[int, ...] = ()  # of the first columns: values / 2^e are summed; 0 of others


@dataclass(frozen=True)
class Binned:
    """Points, averaged in the cells of the blocks (voxels) that they touch."""

    loan: Loan
    count: int  # B blocks
    keys: DeviceArray  # (B, 3 or more) voxel of each block
    neighbors: DeviceArray  # (B, 27) block number of each neighbour, -1 where there is none
    masks: DeviceArray  # (B, 2) cells that hold points
    support: DeviceArray  # (B, 2) cells that hold enough of them
    # (B, 3) first row of each block in `cells`, points, bits of the frames that saw it
    rows: NDArray[np.int32]
    cells: DeviceArray  # (M, 1 + c) root of each cell's count, then mean values times it


@dataclass(frozen=True)
class SortedSamples:
    """Single samples of a cloud, sorted by the block (voxel) that they lie in."""

    loan: Loan
    count: int
    keys: DeviceArray  # (B, 3 or more)
    neighbors: DeviceArray  # (B, 27)
    support: DeviceArray  # (B, 2) cells that hold enough of them
    starts: NDArray[np.int32]  # (B + 1,) block b has samples starts[b] .. starts[b + 1]
    samples: NDArray[np.float32]  # (N, 3) [voxels]
    targets: NDArray[np.float32]  # (N, c [+ 3])


@dataclass(frozen=True)
class LocalLim:
    """F', w' of every voxel that was touched (Fig. 5), to be fused into a map by Eq. 19."""

    loan: Loan | None  # None: its arrays are its own
    count: int
    keys: DeviceArray  # (B, 3 or more)
    # (B, r, c) F', then the prior mean; (B, q, 1) sums of the regression for `fusion: information`
    encoded: DeviceArray
    weights: DeviceArray  # (B,) w', points in the doubled voxel; 0 where not encoded
    support: DeviceArray  # (B, 2) cells in which surface was seen
    channels: int  # that were encoded
    first: int = 0  # of them, the first that is meant
    # of what several windows saw: as `VoxelData.sides`. None: which side one shows is told by F'
    sides: tuple[NDArray, ...] | None = None

    def check(self) -> None:
        """Raise RuntimeStateError where its loan is over."""
        if self.loan is not None:
            self.loan.check()

    def part(self, first: int, channels: int) -> LocalLim:
        """The same voxels, of whose channels those from `first` on are meant."""
        assert first + channels <= self.channels
        return replace(self, first=first)

    def parts(self, channels: Sequence[int]) -> list[LocalLim]:
        """One after the other, the parts of so many channels each."""
        ends = np.cumsum(channels)
        return [
            self.part(int(end) - count, count) for end, count in zip(ends, channels, strict=True)
        ]

    def copy(self) -> LocalLim:
        """The same by value, which no later cloud overwrites."""
        n = self.count
        keys, encoded, weights, support = (
            np.ascontiguousarray(a[:n] if isinstance(a, np.ndarray) else a.to_numpy()[:n])
            for a in (self.keys, self.encoded, self.weights, self.support)
        )
        keys = np.ascontiguousarray(keys[:, :3])
        return replace(
            self, loan=None, keys=keys, encoded=encoded, weights=weights, support=support
        )
