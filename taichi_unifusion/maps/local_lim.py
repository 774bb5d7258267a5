"""What passes between the steps of a map: binned points, sorted samples, and a frame's local LIM.

Their arrays are on loan from the runtime's arena until the next cloud is binned: whoever wants to
keep a local LIM takes a copy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..runtime import DeviceArray


@dataclass(frozen=True)
class Binned:
    """A cloud's points, averaged in the cells of the blocks (voxels) that they touch."""

    turn: int  # of the arena's loan
    count: int  # B blocks
    keys: DeviceArray  # (B, 3) voxel of each block
    neighbors: DeviceArray  # (B, 27) block number of each neighbour, -1 where there is none
    masks: DeviceArray  # (B, 2) cells that hold points
    support: DeviceArray  # (B, 2) cells that hold enough of them
    totals: DeviceArray  # (B,) points
    starts: NDArray[np.int32]  # (B,) first row of each block in `cells`
    cells: DeviceArray  # (M, 1 + c) root of each cell's count, then mean values times it


@dataclass(frozen=True)
class SortedSamples:
    """Single samples of a cloud, sorted by the block (voxel) that they lie in."""

    turn: int
    count: int
    keys: DeviceArray  # (B, 3)
    neighbors: DeviceArray  # (B, 27)
    support: DeviceArray  # (B, 2) cells that hold enough of them
    starts: NDArray[np.int32]  # (B + 1,) block b has samples starts[b] .. starts[b + 1]
    samples: NDArray[np.float32]  # (N, 3) [voxels]
    targets: NDArray[np.float32]  # (N, c [+ 3])


@dataclass(frozen=True)
class LocalLim:
    """F', w' of every voxel that a cloud touches (Fig. 5), to be fused into a map by Eq. 19."""

    turn: int | None  # of the arena's loan; None: its arrays are its own
    count: int
    keys: DeviceArray  # (B, 3)
    # (B, r, c) F', then the prior mean; (B, q, 1) sums of the regression for `fusion: information`
    encoded: DeviceArray
    weights: DeviceArray  # (B,) w', points in the doubled voxel; 0 where not encoded
    support: DeviceArray  # (B, 2) cells in which surface was seen
    channels: int  # that were encoded
    first: int = 0  # of them, the first that is meant

    def part(self, first: int, channels: int) -> LocalLim:
        """The same voxels, of whose channels those from `first` on are meant."""
        assert first + channels <= self.channels
        return replace(self, first=first)

    def copy(self) -> LocalLim:
        """The same by value, which no later cloud overwrites."""
        n = self.count
        keys, encoded, weights, support = (
            np.ascontiguousarray(a[:n] if isinstance(a, np.ndarray) else a.to_numpy()[:n])
            for a in (self.keys, self.encoded, self.weights, self.support)
        )
        return replace(
            self, turn=None, keys=keys, encoded=encoded, weights=weights, support=support
        )
