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
from numpy.typing import NDArray

from ..kernels.query import ABSENT, ITSELF
from ..kernels.sides import OPPOSITE, STEEP, find_sides

if TYPE_CHECKING:
    from .regression_map import RegressionGrid

# backs face away from it; no wall, floor or board of a building is seen edge-on from there
FRONT = np.array([0.36, 0.48, 0.8])
THINNEST, THICKEST = -0.1, 0.8  # of a board [voxels]: less is a gap, more fits into one field
TOGETHER = 5  # neighbours with two sides that a voxel of a board has: three by three, at their edge
REACH = 3  # voxels: what a voxel shows depends on those that lie so far from it
AROUND = np.array([step for step in product((-1, 0, 1), repeat=3) if any(step)], np.int32)


@dataclass(frozen=True)
class Sheet:
    """What of a map makes a sheet of surface: of some voxels a field of its own, of the others theirs."""

    rows: NDArray[np.int32]  # (S,) place of its own field, ITSELF, or ABSENT: it takes no part
    latents: NDArray[np.float32]  # (E, l, 1) at least one
    masks: NDArray[np.uint32]  # (E, 2) support
    near: NDArray[np.int32] | None = None  # (N, 3) voxels around which it is; None: everywhere


@dataclass(frozen=True)
class Fields:
    """The fields of some voxels."""

    places: NDArray[np.int32]  # (S,) by slot, the row that a voxel has here, -1 where none
    fronts: NDArray[np.float32]  # (N, l) F, that of the front where a voxel has two sides
    backs: NDArray[np.float32]  # (N, l) that of the back
    front_slopes: NDArray[np.float32]  # (N, 3) their mean slopes
    back_slopes: NDArray[np.float32]


def whole(grid: RegressionGrid) -> Sheet:
    """The one sheet of a map without boards."""
    rank = grid["latents"].shape[1]
    rows = np.full(max(grid.count, 1), ITSELF, np.int32)
    return Sheet(rows, np.zeros((1, rank, 1), np.float32), np.zeros((1, 2), np.uint32))


def sheets_of(
    grid: RegressionGrid, features: NDArray[np.float32], slots: NDArray[np.int32]
) -> Sequence[Sheet]:
    """The sheet of fronts and, where there are boards, that of backs, right for those voxels that have
    all others within REACH among `slots` (N,); `features` (65, 4, l) are those of
    `SurfaceMap.cell_gradients`.
    """
    n, rank = len(slots), features.shape[2]
    two, fronts = np.zeros(n, np.uint8), np.empty((n, rank), np.float32)
    found = np.empty((n, 6), np.float32)
    if n:
        latents, side_weights = grid["latents"], grid["side_weights"]
        find_sides(rank, features, slots, latents, grid["backs"], side_weights, two, fronts, found)
    if not two.any():
        return (whole(grid),)
    places = np.full(grid.count, -1, np.int32)
    places[slots] = np.arange(n, dtype=np.int32)
    backs = grid.rows("backs", slots).astype(np.float32)
    fields = Fields(places, fronts, backs, found[:, :3], found[:, 3:])
    boards = _boards(grid, fields, slots[two > 0], features[-1, 0])
    if not len(boards):
        return (whole(grid),)
    fronts_alone, backs_alone = _beside(grid, fields, boards)
    near = grid.rows("keys", np.concatenate([boards, fronts_alone, backs_alone]))

    def sheet(F: NDArray, support: str, others: NDArray, near: NDArray | None) -> Sheet:
        rows = np.full(grid.count, ITSELF, np.int32)
        rows[boards], rows[others] = np.arange(len(boards)), ABSENT
        shown = np.ascontiguousarray(F[places[boards]][..., None])
        return Sheet(rows, shown, grid.rows(support, boards), near)

    return (
        sheet(fields.fronts, "front_masks", backs_alone, None),
        sheet(fields.backs, "back_masks", fronts_alone, near),
    )


def _boards(
    grid: RegressionGrid, fields: Fields, split: NDArray[np.int32], middle: NDArray
) -> NDArray[np.int32]:
    """Slots of the voxels that make boards, of those (N,) with two sides; `middle` (l,) is the mean of
    f_posi over a voxel.
    """
    # near a board the fields of its sides sum up to minus its thickness
    at = fields.places[split]
    thickness = -(fields.fronts[at] + fields.backs[at]) @ middle
    split = split[(thickness > THINNEST) & (thickness < THICKEST)]
    around = _slots_around(grid, split)
    core = np.isin(around, split).sum(axis=1) >= TOGETHER
    return split[core | np.isin(around, split[core]).any(axis=1)]


def _beside(
    grid: RegressionGrid, fields: Fields, boards: NDArray[np.int32]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Slots of the voxels beside boards that show their front alone, and their back alone."""
    around = _slots_around(grid, boards)
    own, rows = np.repeat(boards, len(AROUND)), around.reshape(-1)
    known = (rows >= 0) & ~np.isin(rows, boards)
    own, rows = own[known], rows[known]
    own, rows = own[fields.places[rows] >= 0], rows[fields.places[rows] >= 0]
    at = fields.places[rows]
    g = fields.front_slopes[at]

    def against(h: NDArray[np.float32]) -> NDArray[np.int32]:
        lengths = np.linalg.norm(g, axis=1), np.linalg.norm(h, axis=1)
        opposed = np.einsum("ni,ni->n", g, h) < OPPOSITE * lengths[0] * lengths[1]
        return np.unique(rows[opposed & (lengths[0] > STEEP)])

    of = fields.places[own]
    fronts, backs = against(fields.back_slopes[of]), against(fields.front_slopes[of])
    return np.setdiff1d(fronts, backs), np.setdiff1d(backs, fronts)


def _slots_around(grid: RegressionGrid, slots: NDArray[np.int32]) -> NDArray[np.int32]:
    """(N, 26) slots of the voxels around some, -1 where there is none."""
    keys = grid.rows("keys", slots)
    around = (keys[:, None] + AROUND).reshape(-1, 3)
    return grid.slots_of(np.ascontiguousarray(around)).reshape(-1, len(AROUND))
