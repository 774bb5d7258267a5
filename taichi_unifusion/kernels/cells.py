"""The 4 x 4 x 4 cells of a voxel: their numbers, and sets of them as 64 bits.

Cell `16 x + 4 y + z` is bit `31 - cell % 32` of word `cell // 32`, so that counting leading zeros
walks a set in order.
"""

import taichi as ti

CELLS = 4  # per voxel edge; shifts below rely on it
BLOCK_CELLS = CELLS**3


@ti.func
def cell_of(x: ti.template(), ijk: ti.template()) -> ti.i32:
    """Cell 0..63 of voxel ijk that contains x, in voxel units; x slowest."""
    cell = ti.math.clamp(ti.floor((x - ijk) * CELLS, ti.i32), 0, CELLS - 1)
    return (cell[0] * CELLS + cell[1]) * CELLS + cell[2]


@ti.func
def cell_in_lattice(at: ti.template()) -> ti.i32:
    """Cell 0..63, in its voxel, of a triple in the lattice of all cells."""
    return ((at[0] & 3) * CELLS + (at[1] & 3)) * CELLS + (at[2] & 3)


@ti.func
def cell_index(cell: ti.i32):
    """Cell 0..63 as an integer triple 0..3."""
    return ti.Vector([cell // (CELLS * CELLS), cell // CELLS % CELLS, cell % CELLS])


@ti.func
def cell_center(cell: ti.i32):
    """Centre of a cell relative to its voxel's corner, in voxel units."""
    return (cell_index(cell) + 0.5) / CELLS


@ti.func
def cell_bit(k: ti.i32) -> ti.u32:
    """The bit of cell k, 0..31, in its word."""
    return ti.u32(1) << ti.cast(31 - k, ti.u32)


@ti.func
def first_cell(word: ti.u32) -> ti.i32:
    """The first cell, 0..31, of a word that is not empty."""
    return ti.math.clz(ti.cast(word, ti.i32))


@ti.func
def cells_before(word: ti.u32, k: ti.i32) -> ti.i32:
    """How many cells of a word come before its cell k, 0..31."""
    return ti.cast(ti.math.popcnt((word >> 1) >> ti.cast(31 - k, ti.u32)), ti.i32)


@ti.func
def has_cell(masks: ti.template(), row: ti.i32, cell: ti.i32) -> ti.i32:
    """Whether row `row` of masks (N, 2) holds the cell 0..63."""
    return ti.cast((masks[row, cell >> 5] >> ti.cast(31 - (cell & 31), ti.u32)) & 1, ti.i32)
