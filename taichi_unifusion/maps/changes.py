"""What of a surface has changed since it was last meshed, so that a viewer meshes that alone again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..kernels.cells import BLOCK_CELLS
from ..kernels.pools import copy_rows
from .meshing import mesh_blocks
from .surface_map import SurfaceMap
from .voxel_data import EVIDENCE, KEYS, MASKS, WEIGHTS, VoxelField
from .voxel_grid import VoxelGrid

# A voxel is meshed again when its weight has grown by this share since: by Eq. 19 its latents have then
# moved by at most a fifth of the way to what was fused.
GROWTH = 0.25


@dataclass(frozen=True)
class MeshedSurface:
    """The state of a map's voxels, by slot, when they were last meshed."""

    weights: NDArray[np.float32]  # (S,); 0 where there was no voxel
    visible: NDArray[np.uint8]  # (S, 16) support and evidence of a voxel's cells, as bits
    packed: int = 0  # how often the grid had given its voxels other slots

    @classmethod
    def nothing(cls) -> MeshedSurface:
        """No voxel was meshed yet."""
        return cls(np.zeros(0, np.float32), np.zeros((0, BLOCK_CELLS // 4), np.uint8))


def changed_blocks(
    surface: SurfaceMap, before: MeshedSurface
) -> tuple[NDArray[np.int32], MeshedSurface]:
    """The blocks (M, 3) of the mesh that are to be extracted again since `before`, for
    `surface.extract_mesh(blocks=...)`, and the state to compare with next time.

    Voxels count that are new or gone, whose weight grew by a quarter, or in which cells became
    visible or ceased to be. Frames that wait to be fused do not count.
    """
    grid = surface.grid
    if before.packed != grid.packed:  # slots are others now
        before = MeshedSurface.nothing()
    weights = _of_slots(grid, WEIGHTS)
    bits = [_of_slots(grid, MASKS).view(np.uint8)]
    if "evidence" in grid:
        evidence = _of_slots(grid, EVIDENCE)
        bits.append(np.packbits(evidence >= surface.settings.min_evidence, axis=1))
    visible = np.hstack(bits)
    meshed = _with_rows(before.weights, grid.count)
    known = _with_rows(before.visible, grid.count)[:, : visible.shape[1]]
    grown = np.abs(weights - meshed) > GROWTH * meshed
    changed = np.flatnonzero(grown | (visible != known).any(axis=1))
    meshed[changed] = weights[changed]
    if not len(changed):
        return np.zeros((0, 3), np.int32), MeshedSurface(meshed, visible, grid.packed)
    keys = _of_slots(grid, KEYS)[changed]
    return mesh_blocks(keys), MeshedSurface(meshed, visible, grid.packed)


def _of_slots(grid: VoxelGrid, field: VoxelField) -> NDArray:
    """A field of all slots given out, (S, ...); several times as fast as `to_numpy` of the pool."""
    values = np.empty((grid.count, *field.shape), field.dtype)
    if grid.count:
        copy_rows(grid.count, grid[field.name], values)
    return values


def _with_rows(array: NDArray, rows: int) -> NDArray:
    """A copy of so many rows, those that are missing 0."""
    copy = np.zeros((rows, *array.shape[1:]), array.dtype)
    kept = min(rows, len(array))
    copy[:kept] = array[:kept]
    return copy
