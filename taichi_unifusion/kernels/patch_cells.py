"""The patches of a run -> sums in the cells of maps (Sec. IV-B).

A run's patches are known before the first of them is added, so that the cells that they lie in can be
asked for together: they come from memory, which takes longer than all that is computed.
"""

import taichi as ti

from .binning import add_run, mark_frame
from .cells import CELLS, cell_in_lattice
from .index import INDEX_HALF

QUAD = 4  # pixels, at most as many patches


@ti.func
def claim_block(
    # in:
    ijk: ti.template(),
    stamp: ti.i32,
    which: ti.template(),
    first: ti.i32,
    index: ti.template(),
    room: ti.i32,
    # in and out:
    totals: ti.template(),
    keys: ti.template(),
) -> ti.i32:
    """The block of voxel ijk, numbered by the first who asks; others wait until it says so.

    Blocks beyond the room in the arrays are counted only; they get their keys when the frame is gone
    through again, for blocks from `first` on.
    """
    at = ijk + INDEX_HALF
    b = index.block[at]
    if b == 0:
        if ti.atomic_max(index.stamp[at], stamp) != stamp:
            b = ti.atomic_add(totals[which], 1) + 1
            if b <= room:
                for d in ti.static(range(3)):
                    keys[b - 1, d] = ijk[d]
            ti.atomic_add(index.block[at], b)
        else:
            while b == 0:
                b = ti.atomic_add(index.block[at], 0)  # a plain read would be moved out of the loop
    elif first > 0 and b > first:
        for d in ti.static(range(3)):
            keys[b - 1, d] = ijk[d]
    return b - 1


@ti.func
def enter_voxel(
    # in:
    ijk: ti.template(),
    which: ti.template(),
    now: ti.template(),
    index: ti.template(),
    # in and out:
    totals: ti.template(),
    keys: ti.template(),
    sums: ti.template(),
) -> ti.i32:
    """The block of voxel ijk in the cells of map `which` of 2, 3, marked as seen by the frame."""
    room = sums.shape[0]
    block = claim_block(ijk, now[which], which, now[which + 2], index, room, totals, keys)
    if block < room:
        mark_frame(block, 1 << now[1], now[0], keys)
    return block


@ti.func
def find_cells(
    # in:
    which: ti.template(),
    per_meter: ti.template(),
    n: ti.i32,
    points: ti.template(),
    now: ti.template(),
    index: ti.template(),
    # in and out:
    totals: ti.template(),
    keys: ti.template(),
    sums: ti.template(),
    # out:
    blocks: ti.template(),
    cells: ti.template(),
):
    """The blocks, and the cells in them, of the n patches of a run, whose voxels are entered."""
    voxel, block = ti.Vector([INDEX_HALF, 0, 0]), 0
    for m in range(n):
        at = ti.floor(triple(points, m) * ti.static(per_meter * CELLS), ti.i32)
        if any((at >> 2) != voxel):  # neighbours in the image mostly share a voxel
            voxel = at >> 2
            block = enter_voxel(voxel, which, now, index, totals, keys, sums)
        blocks[m], cells[m] = block, cell_in_lattice(at)


@ti.func
def triple(rows: ti.template(), m: ti.i32):
    """Row m of a vector of rows of three."""
    return ti.Vector([rows[3 * m], rows[3 * m + 1], rows[3 * m + 2]])


@ti.func
def ask_ahead(n: ti.i32, sums: ti.template(), blocks: ti.template(), cells: ti.template()):
    """Read from all cells of a run at once, so that they come from memory together: whoever adds to
    one after the other waits for each.
    """
    asked = ti.i64(0)
    for m in range(n):
        asked |= sums[ti.min(blocks[m], sums.shape[0] - 1), cells[m], 0]
    if asked < 0:  # which counts never are: so the reading is not left out
        cells[0] = 0


@ti.func
def add_surfels(
    # in:
    per_meter: ti.template(),
    n: ti.i32,
    points: ti.template(),
    normals: ti.template(),
    counts: ti.template(),
    now: ti.template(),
    blocks: ti.template(),
    cells: ti.template(),
    # in and out:
    sums: ti.template(),
):
    """Add the patches of a run to cells of the surface."""
    run, total = 0, ti.Vector([0.0] * 6)
    for m in range(n):
        weight = ti.cast(counts[m], ti.f32)
        y = triple(points, m) * ti.static(per_meter * CELLS)
        run += counts[m]
        for d in ti.static(range(3)):
            total[d] += normals[3 * m + d] * weight
            total[3 + d] += (y[d] - ti.floor(y[d]) - 0.5) / CELLS * weight
        if m == n - 1 or blocks[m + 1] != blocks[m] or cells[m + 1] != cells[m]:
            end_run(6, 2, blocks[m], cells[m], run, total, now, sums)
            run = 0
            total.fill(0.0)


@ti.func
def add_colors(
    # in:
    n: ti.i32,
    color: ti.template(),
    across: ti.i32,
    places: ti.template(),
    counts: ti.template(),
    now: ti.template(),
    blocks: ti.template(),
    cells: ti.template(),
    # in and out:
    sums: ti.template(),
):
    """Add the patches of a run to cells of the colours."""
    run, total = 0, ti.Vector([0.0] * 3)
    for m in range(n):
        quad = places[m] >> 4
        run += counts[m]
        mean = patch_color(color, quad // across * 2, quad % across * 2, places[m] & 15)
        total += mean * ti.cast(counts[m], ti.f32)
        if m == n - 1 or blocks[m + 1] != blocks[m] or cells[m + 1] != cells[m]:
            end_run(3, 3, blocks[m], cells[m], run, total, now, sums)
            run = 0
            total.fill(0.0)


@ti.func
def end_run(
    # in:
    width: ti.template(),
    which: ti.template(),
    block: ti.i32,
    cell: ti.i32,
    run: ti.i32,
    total: ti.template(),
    now: ti.template(),
    # in and out:
    sums: ti.template(),
):
    """Add the sums over a run of patches in a cell, if there is room, and blocks from this one on are
    added to.
    """
    if block >= now[which + 2] and block < sums.shape[0]:
        add_run(width, block, cell, run, total, now[0], sums)


@ti.func
def patch_color(color: ti.template(), row: ti.i32, column: ti.i32, mask: ti.i32):
    """Mean colour, in [0, 1], of the pixels of a quad whose bits are in `mask`."""
    count, total = 0, ti.Vector([0, 0, 0])
    for p in range(QUAD):
        if (mask >> p) & 1 != 0:
            count += 1
            for c in ti.static(range(3)):
                total[c] += ti.cast(color[row + p // 2, column + p % 2, c], ti.i32)
    return ti.cast(total, ti.f32) * (1.0 / (255.0 * ti.cast(count, ti.f32)))


@ti.func
def whole_pixels(halves: ti.i32, quad: ti.i32, mask: ti.i32) -> ti.i32:
    """Pixels that so many halves of them are. One that is left over counts in every other patch, as on a
    chessboard: `quad` is row plus column of the patch's quad, and `mask` has the bits of its pixels.
    """
    first = mask & -mask
    black = quad + ti.cast(first == 2 or first == 4, ti.i32)
    return (halves + (black & 1)) >> 1
