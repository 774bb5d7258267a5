"""KeptWindow: what a window was fused from, by value, so that it can be taken out again, exactly.

A trajectory that a loop corrects moves whole windows: each is taken out at its old pose and fused
anew. Encoding depends on whole numbers only, so the local LIM that is taken out is the one that was
fused, to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels.cells import BLOCK_CELLS
from ..kernels.pools import copy_rows
from ..types import PinholeCamera, PointCloud
from .binner import patches_of
from .local_lim import CellArrays, LocalLim, OpenCells
from .property_group import Part
from .surface_map import SurfaceMap
from .voxel_grid import VoxelGrid


@dataclass(frozen=True)
class KeptCells:
    """The sums in the cells of the voxels that a window's frames touched."""

    keys: NDArray[np.int32]  # (B, 5) voxels, and bits of the frames that saw each
    cells: NDArray[np.int32]  # (M,) cells that hold points, by block
    sums: NDArray[np.int64]  # (M, 1 + c) counts, and fixed-point sums
    exponents: tuple[int, ...]  # of the sums, as `OpenCells` has them

    @classmethod
    def of(cls, open_cells: OpenCells) -> KeptCells:
        """By value what is summed up."""
        n, arrays = open_cells.count, open_cells.arrays
        sums = arrays.sums.to_numpy()[:n].reshape(n * BLOCK_CELLS, -1)
        cells = np.flatnonzero(sums[:, 0]).astype(np.int32)
        keys = arrays.keys.to_numpy()[:n]
        return cls(keys, cells, sums[cells].copy(), open_cells.exponents)

    @property
    def nbytes(self) -> int:
        """Bytes that this takes."""
        return self.keys.nbytes + self.cells.nbytes + self.sums.nbytes

    def encoded(self, part: Part, arrays: CellArrays) -> LocalLim:
        """The local LIM of a part, as it was fused; on loan from the arena of the runtime."""
        binner, n = part.binner, len(self.keys)
        centers = ((self.keys[:, :3] + np.float32(0.5)) * np.float32(binner.voxel_size)).astype(
            np.float32
        )
        patches = patches_of(PointCloud(centers), binner.grid.runtime.device)
        touched = binner.touch(binner.open(arrays, self.exponents), patches)
        # blocks have other numbers now
        order = np.argsort(_codes(self.keys))[
            np.argsort(np.argsort(_codes(arrays.keys.to_numpy()[:n])))
        ]
        block_of = np.argsort(order)
        sums = np.zeros((n, BLOCK_CELLS, self.sums.shape[1]), np.int64)
        sums[block_of[self.cells // BLOCK_CELLS], self.cells % BLOCK_CELLS] = self.sums
        copy_rows(n, sums, arrays.sums)
        copy_rows(n, np.ascontiguousarray(self.keys[order]), arrays.keys)
        return part.encoder.encode(binner.close(touched, binner.grid.runtime.arena))


def _codes(keys: NDArray[np.int32]) -> NDArray[np.int64]:
    """A number for each voxel (N, 3)."""
    i, j, k = keys[:, :3].T.astype(np.int64) + (1 << 20)
    return i << 42 | j << 21 | k


@dataclass(frozen=True)
class Visible:
    """What is known of the surface of all voxels of a map at one moment."""

    evidence: NDArray[np.int8]  # (S, 64)
    masks: NDArray[np.uint32]  # (S, 2)

    @classmethod
    def of(cls, grid: VoxelGrid) -> Visible:
        n = grid.count
        return cls(grid["evidence"].to_numpy()[:n], grid["masks"].to_numpy()[:n])


@dataclass(frozen=True)
class VisibleChange:
    """Votes and support that a window brought."""

    keys: NDArray[np.int32]  # (N, 3) voxels
    votes: NDArray[np.int8]  # (N, 64)
    support: NDArray[np.uint32]  # (N, 2) cells in which it was the first to see surface

    @classmethod
    def since(cls, before: Visible, grid: VoxelGrid) -> VisibleChange:
        """What has changed in a grid."""
        after, known = Visible.of(grid), len(before.masks)
        votes, support = after.evidence.astype(np.int16), after.masks.copy()
        votes[:known] -= before.evidence
        support[:known] &= ~before.masks
        slots = np.flatnonzero(votes.any(axis=1) | support.any(axis=1))
        keys = grid["keys"].to_numpy()[slots]
        return cls(keys, votes[slots].astype(np.int8), support[slots])

    @property
    def nbytes(self) -> int:
        return self.keys.nbytes + self.votes.nbytes + self.support.nbytes


@dataclass(frozen=True)
class KeptWindow:
    """A window that was fused: its keyframe, the sums of its frames, its views, and what its rays
    changed.
    """

    T_world_keyframe: NDArray[np.float64]
    camera: PinholeCamera
    depth: NDArray[np.float32]  # (K, H, W) [m] of its views
    T_camera_world: NDArray[np.float32]  # (K, 3, 4)
    cells: Mapping[tuple[str, ...], KeptCells]  # by the names of the maps of a part
    visible: Mapping[str, VisibleChange]  # by the name of a map

    @property
    def nbytes(self) -> int:
        """Bytes that it takes, with the depth images."""
        kept = sum(each.nbytes for each in (*self.cells.values(), *self.visible.values()))
        return self.depth.nbytes + kept


def take_visible(surface: SurfaceMap, change: VisibleChange) -> None:
    """Take back the votes and the support of a window, before its voxels are taken out.

    A cell keeps support that the window was the first to bring, if other windows have seen surface
    there since.
    """
    grid = surface.grid
    slots = grid.slots_of(change.keys)
    there = slots >= 0
    slots, votes, support = slots[there], change.votes[there], change.support[there]
    if len(slots):
        surface.add_evidence(slots, -votes)
        masks, evidence = grid["masks"].to_numpy(), grid["evidence"].to_numpy()[slots]
        unseen = np.packbits(evidence <= 0, axis=1).view(">u4").astype(np.uint32)
        masks[slots] &= ~(support & unseen)
        grid["masks"].from_numpy(masks)
