"""Sheets: a surface for each side of boards that are thinner than a voxel.

Where voxels that lie together have two sides (`kernels.sides`), the fields of the fronts make one
sheet and those of the backs another. A voxel beside them that shows one side alone takes part in
the sheet of that side, all others in both: the sheets are one where nothing is thin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..kernels.sides import OPPOSITE, STEEP, find_sides

if TYPE_CHECKING:
    from .regression_map import RegressionGrid

# backs face away from it; no wall, floor or board of a building is seen edge-on from there
FRONT = np.array([0.36, 0.48, 0.8])
THINNEST, THICKEST = -0.1, 0.8  # of a board [voxels]: less is a gap, more fits into one field
TOGETHER = 5  # neighbours with two sides that a voxel of a board has: three by three, at their edge
AROUND = np.array([step for step in product((-1, 0, 1), repeat=3) if any(step)], np.int32)


@dataclass(frozen=True)
class Sheet:
    """What of a map makes a sheet of surface."""

    latents: ArrayLike  # (S or more, l, 1)
    masks: ArrayLike  # (S or more, 2) support
    taken: NDArray[np.uint8]  # (S,) 0: the voxel takes no part
    near: NDArray[np.int32] | None = None  # (N, 3) voxels around which it is; None: everywhere


@dataclass(frozen=True)
class Fields:
    """The fields of voxels, in the order of their slots."""

    fronts: NDArray[np.float32]  # (S, l) F, that of the front where a voxel has two sides
    backs: NDArray[np.float32]  # (S, l) that of the back
    front_slopes: NDArray[np.float32]  # (S, 3) their mean slopes
    back_slopes: NDArray[np.float32]


def whole(grid: RegressionGrid) -> Sheet:
    """The one sheet of a map without boards."""
    return Sheet(grid["latents"], grid["masks"], np.ones(max(grid.count, 1), np.uint8))


def sheets_of(grid: RegressionGrid, features: NDArray[np.float32]) -> Sequence[Sheet]:
    """The sheet of fronts and, where there are boards, that of backs; `features` (65, 4, l) are those
    of `SurfaceMap.cell_gradients`.
    """
    n, rank = grid.count, features.shape[2]
    two, fronts = np.zeros(n, np.uint8), np.empty((n, rank), np.float32)
    found = np.empty((n, 6), np.float32)
    if n:
        latents, side_weights = grid["latents"], grid["side_weights"]
        find_sides(rank, features, latents, grid["backs"], side_weights, two, fronts, found)
    if not two.any():
        return (whole(grid),)
    backs = grid["backs"].to_numpy()[:n].astype(np.float32)
    fields = Fields(fronts, backs, found[:, :3], found[:, 3:])
    boards = _boards(grid, fields, two > 0, features[-1, 0])
    if not len(boards):
        return (whole(grid),)
    fronts_alone, backs_alone = _beside(grid, fields, boards)
    latents, masks = grid["latents"].to_numpy()[:n], grid["masks"].to_numpy()[:n]
    special = np.concatenate([boards, fronts_alone, backs_alone])
    near = grid.rows("keys", special.astype(np.int32))

    def sheet(F: NDArray, support: str, others: NDArray, near: NDArray | None) -> Sheet:
        shown, seen, taken = latents.copy(), masks.copy(), np.ones(n, np.uint8)
        shown[boards, :, 0] = F[boards]
        seen[boards] = grid.rows(support, boards.astype(np.int32))
        taken[others], seen[others] = 0, 0
        return Sheet(shown, seen, taken, near)

    return (
        sheet(fields.fronts, "front_masks", backs_alone, None),
        sheet(fields.backs, "back_masks", fronts_alone, near),
    )


def _boards(
    grid: RegressionGrid, fields: Fields, two: NDArray[np.bool_], middle: NDArray
) -> NDArray[np.intp]:
    """Slots of the voxels with two sides that make boards; `middle` (l,) is the mean of f_posi over a
    voxel.
    """
    split = np.flatnonzero(two)
    # near a board the fields of its sides sum up to minus its thickness
    thickness = -(fields.fronts[split] + fields.backs[split]) @ middle
    split = split[(thickness > THINNEST) & (thickness < THICKEST)]
    around = _slots_around(grid, split)
    core = np.isin(around, split).sum(axis=1) >= TOGETHER
    return split[core | np.isin(around, split[core]).any(axis=1)]


def _beside(
    grid: RegressionGrid, fields: Fields, boards: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Slots of the voxels beside boards that show their front alone, and their back alone."""
    around = _slots_around(grid, boards)
    own, rows = np.repeat(boards, len(AROUND)), around.reshape(-1)
    known = (rows >= 0) & ~np.isin(rows, boards)
    own, rows = own[known], rows[known].astype(np.intp)
    g = fields.front_slopes[rows]

    def against(h: NDArray[np.float32]) -> NDArray[np.intp]:
        lengths = np.linalg.norm(g, axis=1), np.linalg.norm(h, axis=1)
        opposed = np.einsum("ni,ni->n", g, h) < OPPOSITE * lengths[0] * lengths[1]
        return np.unique(rows[opposed & (lengths[0] > STEEP)])

    fronts, backs = against(fields.back_slopes[own]), against(fields.front_slopes[own])
    return np.setdiff1d(fronts, backs), np.setdiff1d(backs, fronts)


def _slots_around(grid: RegressionGrid, slots: NDArray[np.intp]) -> NDArray[np.int32]:
    """(N, 26) slots of the voxels around some, -1 where there is none."""
    keys = grid.rows("keys", slots.astype(np.int32))
    around = (keys[:, None] + AROUND).reshape(-1, 3)
    return grid.slots_of(np.ascontiguousarray(around)).reshape(-1, len(AROUND))
