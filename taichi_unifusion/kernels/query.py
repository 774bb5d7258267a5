"""Decoding: f_dec(x, F) = f_posi(t) F at points and on the grid for marching cubes (Eq. 7, Sec.
IV-B).
"""

import taichi as ti

from .arrays import Bytes1, Floats2, Floats3, Ints2, Masks2, row3
from .cells import BLOCK_CELLS, CELLS, cell_bit, cell_index, first_cell
from .encoding import table_features
from .index import INDEX_HALF, all_within, find, voxel_of

UNKNOWN = 1e9  # signed distance where no voxel reaches


@ti.func
def decode(
    layout: ti.template(),
    s: ti.i32,
    t: ti.template(),
    latents: ti.template(),
    table: ti.template(),
    nodes: ti.i32,
):
    """f_dec(t, F) of the voxel in slot s, plus its prior mean (Eq. 7)."""
    rank, channels = ti.static(layout.rank, layout.channels)
    f = table_features(t, rank, table, nodes)
    values = ti.Vector([0.0] * channels)
    for c in ti.static(range(channels)):
        value = latents[s, rank, c] if ti.static(layout.centered) else 0.0
        for a in ti.static(range(rank)):
            value += f[a] * latents[s, a, c]
        values[c] = value
    return values


@ti.func
def nearest_voxel(x: ti.template(), reach: ti.i32, index: ti.template()):
    """Slot of the voxel whose centre is nearest to x within `reach` voxels along each axis, or -1,
    and its index.
    """
    home = voxel_of(x)
    found, at, nearest = -1, home, 1e9
    for o in range((2 * reach + 1) ** 3):
        edge = 2 * reach + 1
        step = ti.Vector([o // (edge * edge), o // edge % edge, o % edge]) - reach
        ijk = ti.math.clamp(home + step, -INDEX_HALF, INDEX_HALF - 1)
        s = find(index, ijk)
        distance = (x - ijk - 0.5).norm_sqr()
        if s >= 0 and distance < nearest:
            found, at, nearest = s, ijk, distance
    return found, at


@ti.func
def tent_weight(t: ti.template()) -> ti.f32:
    """Weight of a voxel at encoder coordinates t in [-0.5, 0.5]^3 when voxels are blended."""
    tent = 1.0
    for d in ti.static(range(3)):
        tent *= ti.max(1.0 - 2.0 * ti.abs(t[d]), 0.0)
    return ti.max(tent, 1e-6)  # on the border of the only voxel there is, its value still counts


@ti.kernel
def query_points(
    # in:
    layout: ti.template(),
    # all doubled voxels that contain the point, with tent weights; else its own voxel only
    blend: ti.template(),
    points: Floats2,  # (N, 3) world [m]
    per_meter: ti.f32,
    index: ti.template(),
    latents: Floats3,  # (S, l [+ 1], c)
    table: Floats2,  # (nodes^3, l) f_posi on a lattice over the doubled voxel
    nodes: ti.i32,
    # points that no voxel covers take the value of the nearest one within this many voxels
    reach: ti.i32,
    # out:
    values: Floats2,  # (N, c) 0 where there is none
    valid: Bytes1,  # (N,) = 1 where a voxel covers the point
):
    for n in range(points.shape[0]):
        x = row3(points, n) * per_meter
        total = ti.Vector([0.0] * layout.channels)
        weight, covered = 0.0, 0
        if all_within(x, INDEX_HALF - 1.0):
            corner = voxel_of(x - 0.5) if ti.static(blend) else voxel_of(x)
            covering = ti.static(8 if blend else 1)
            for o in range(covering + 1):
                ijk, s = corner, -1
                if o < covering:
                    ijk = corner + ti.Vector([o // 4, o // 2 % 2, o % 2])
                    s = find(index, ijk)
                elif weight == 0 and reach > 0:
                    s, ijk = nearest_voxel(x, reach, index)
                if s >= 0:
                    t = ti.math.clamp((x - ijk - 0.5) * 0.5, -0.5, 0.5)
                    tent = tent_weight(t) if ti.static(blend) else 1.0
                    total += tent * decode(layout, s, t, latents, table, nodes)
                    weight += tent
                    covered += ti.cast(o < covering, ti.i32)
        valid[n] = ti.cast(covered > 0, ti.u8)
        for c in ti.static(range(layout.channels)):
            values[n, c] = total[c] / ti.max(weight, 1e-12)


@ti.func
def corner_slot(keys: ti.template(), q: ti.i32, o: ti.i32, index: ti.template()) -> ti.i32:
    """Slot of voxel o of the eight around lattice corner q, or -1."""
    ijk = row3(keys, q) - ti.Vector([1 - o // 4, 1 - o // 2 % 2, 1 - o % 2])
    return find(index, ti.math.clamp(ijk, -INDEX_HALF, INDEX_HALF - 1))


@ti.kernel
def corner_support(
    # in:
    keys: Ints2,  # (Q, 3) lattice corners; the cube of corner q spans the centres of its eight voxels
    index: ti.template(),
    map_masks: Masks2,  # (S, 2) support of each voxel's cells
    # a cell with at least this many of its 26 neighbours supported is taken in: pinholes close,
    # rims stay
    closing: ti.i32,
    # out:
    support: Masks2,  # (Q, 2) supported cells of the cube, numbered as those of a voxel
):
    edge = ti.static(CELLS + 2)  # the cube's cells and one more on every side
    for q in range(keys.shape[0]):
        seen = ti.Vector([0] * edge**3)
        for o in range(8):
            s = corner_slot(keys, q, o, index)
            if s >= 0:
                # A voxel's cells 0..3 along an axis are cells -2..1 (upper voxel: 2..5) of the cube
                # that starts at its centre.
                base = ti.Vector([o // 4, o // 2 % 2, o % 2]) * CELLS - CELLS // 2 + 1
                for half in range(2):
                    mask = map_masks[s, half]
                    while mask != 0:
                        k = first_cell(mask)
                        mask ^= cell_bit(k)
                        at = base + cell_index(half * 32 + k)
                        if at.min() >= 0 and at.max() < edge:
                            seen[(at[0] * edge + at[1]) * edge + at[2]] = 1
        # sums over 3 x 3 x 3 cells, an axis at a time
        along = ti.Vector([0] * (edge * edge * CELLS))
        for row in range(edge * edge):
            for z in ti.static(range(CELLS)):
                at = row * edge + z
                along[row * CELLS + z] = seen[at] + seen[at + 1] + seen[at + 2]
        across = ti.Vector([0] * (edge * BLOCK_CELLS // CELLS))
        for x in range(edge):
            for y, z in ti.static(ti.ndrange(CELLS, CELLS)):
                at = (x * edge + y) * CELLS + z
                across[(x * CELLS + y) * CELLS + z] = (
                    along[at] + along[at + CELLS] + along[at + 2 * CELLS]
                )
        for half in range(2):
            reached = ti.u32(0)
            for k in range(32):
                cell = half * 32 + k
                at = cell_index(cell) + 1
                itself = seen[(at[0] * edge + at[1]) * edge + at[2]]
                layer = ti.static(CELLS * CELLS)
                around = across[cell] + across[cell + layer] + across[cell + 2 * layer]
                if around + 26 * itself >= ti.min(closing, 27):
                    reached |= cell_bit(k)
            support[q, half] = reached


@ti.kernel
def sdf_grid(
    # in:
    rank: ti.template(),
    keys: Ints2,  # (Q, 3) lattice corners
    index: ti.template(),
    latents: Floats3,  # (S, l, 1)
    basis: Floats2,  # (R^3, 8 l) tent weight times f_posi of each voxel, at the R^3 samples of a cube
    tents: Floats2,  # (R^3, 8)
    # out:
    sdf: Floats2,  # (Q, R^3) signed distance [voxels], UNKNOWN where no voxel reaches
):
    for q in range(keys.shape[0]):
        F = ti.Vector([0.0] * (8 * rank))
        present = ti.Vector([0.0] * 8)
        for o in range(8):
            s = corner_slot(keys, q, o, index)
            if s >= 0:
                present[o] = 1.0
                for a in range(rank):
                    F[o * rank + a] = latents[s, a, 0]
        for r in range(basis.shape[0]):
            value, weight = 0.0, 0.0
            for a in range(8 * rank):
                value += basis[r, a] * F[a]
            for o in range(8):
                weight += tents[r, o] * present[o]
            sdf[q, r] = value / weight if weight > 1e-5 else UNKNOWN
