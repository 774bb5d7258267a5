"""Decoding: f_dec(x, F) = f_posi(t) F at points and on the grid for marching cubes (Eq. 7, Sec.
IV-B).
"""

import taichi as ti

from .arrays import Bytes1, Floats1, Floats2, Floats3, Ints1, Ints2, Masks2, row3
from .cells import BLOCK_CELLS, CELLS, cell_bit, cell_index, first_cell
from .index import INDEX_HALF, all_within, find, voxel_of

UNKNOWN = 1e9  # signed distance where no voxel reaches
CHUNK = 32  # points that one thread sorts by lattice corner
CHANNELS = 4  # decoded at once
CODE_BITS = 15  # of an index along an axis
ITSELF, ABSENT = -1, -2  # in place of a row: the voxel's own field; it takes no part
NOWHERE, UNCOVERED = -1, -2  # codes of a point: not (or no longer) asked for; of the nearest voxel


@ti.func
def read_latent(
    # in:
    layout: ti.template(),
    s: ti.i32,  # slot, -1 where there is no voxel
    o: ti.i32,  # which of the eight voxels around a lattice corner it is
    first: ti.i32,  # channel
    latents: ti.template(),  # (S, l [+ 1], c)
    # in and out:
    F: ti.template(),  # (CHANNELS x 8 x size,) row o of every channel becomes that of the latent
    prior: ti.template(),  # (CHANNELS x 8,) and its prior mean
):
    """Copy some channels of a voxel's latent to where sums over eight voxels find them."""
    for c in ti.static(range(ti.min(layout.channels, CHANNELS))):
        channel = ti.min(first + c, layout.channels - 1)
        for a in range(layout.rank):
            F[(c * 8 + o) * layout.size + a] = latents[s, a, channel] if s >= 0 else 0.0
        if ti.static(layout.centered):
            prior[c * 8 + o] = latents[s, layout.rank, channel] if s >= 0 else 0.0


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


@ti.func
def node_shares(r: ti.template()):
    """Trilinear weights of the eight nodes around a point, at r in [0, 1]^3 between them."""
    shares = ti.Vector([1.0] * 8)
    for o, d in ti.static(ti.ndrange(8, 3)):
        shares[o] *= r[d] if ti.static(o >> 2 - d & 1 == 1) else 1.0 - r[d]
    return shares


@ti.func
def corner_code(x: ti.template()) -> ti.i64:
    """The lattice corner whose eight doubled voxels contain x, as one number; NOWHERE out of the
    index range.
    """
    code = ti.i64(NOWHERE)
    if all_within(x, INDEX_HALF - 1.0):
        at = ti.cast(voxel_of(x - 0.5) + INDEX_HALF, ti.i64)
        code = (at[0] << 2 * CODE_BITS) + (at[1] << CODE_BITS) + at[2]
    return code


@ti.func
def corner_of_code(code: ti.i64):
    """The lattice corner of a code."""
    at = ti.Vector([code >> 2 * CODE_BITS, code >> CODE_BITS, code])
    return (ti.cast(at, ti.i32) & (1 << CODE_BITS) - 1) - INDEX_HALF


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
    # f_posi of the eight voxels around a lattice corner, on nodes between their centres
    table: Floats1,  # (nodes x 8 x size,)
    spaces: ti.i32,  # between nodes, along an edge
    # points that no voxel covers take the value of the nearest one within this many voxels
    reach: ti.i32,
    # out:
    values: Floats2,  # (N, c) 0 where there is none
    valid: Bytes1,  # (N,) = 1 where a voxel covers the point
):
    # Neighbours in a list mostly lie between the same eight voxels. Of every CHUNK points, those
    # that do are decoded together: reading eight latents costs more than a product with them.
    size, group = ti.static(layout.size, min(layout.channels, CHANNELS))
    passes = ti.static((layout.channels + group - 1) // group)
    chunks = (points.shape[0] + CHUNK - 1) // CHUNK
    for task in range(chunks * passes):
        begin, first = task // passes * CHUNK, task % passes * group
        count = ti.min(points.shape[0] - begin, CHUNK)
        codes = ti.Vector([ti.i64(NOWHERE)] * CHUNK)
        F, prior = ti.Vector([0.0] * (group * 8 * size)), ti.Vector([0.0] * (group * 8))
        present, tents = ti.Vector([0.0] * 8), ti.Vector([0.0] * (8 * size))
        for k in range(count):
            codes[k] = corner_code(row3(points, begin + k) * per_meter)
            valid[begin + k] = 0
            for c in range(group):
                if first + c < layout.channels:
                    values[begin + k, first + c] = 0.0
        # first all points by corner, then one by one those that no voxel covers
        for turn in range(2 * count):
            head = turn % count
            code, last, corner = codes[head], 0, ti.Vector([0, 0, 0])
            slots = ti.Vector([-1] * 8)
            if turn < count:
                if code >= 0:
                    last, corner = count, corner_of_code(code)
                    for o in range(8):
                        slots[o] = find(index, corner + ti.Vector([o >> 2, o >> 1 & 1, o & 1]))
            elif code == UNCOVERED:
                x = row3(points, begin + head) * per_meter
                s, ijk = nearest_voxel(x, reach, index)
                if s >= 0:
                    above = ti.cast(x < ijk + 0.5, ti.i32)
                    last, corner = head + 1, ijk - above
                    slots[above[0] * 4 + above[1] * 2 + above[2]] = s
            voxels = 8 if last > 0 else 0
            for o in range(voxels):
                present[o] = ti.cast(slots[o] >= 0, ti.f32)
                read_latent(layout, slots[o], o, first, latents, F, prior)
            for k in range(head, last):
                if codes[k] == code:
                    n = begin + k
                    x = row3(points, n) * per_meter
                    u = ti.math.clamp(x - 0.5 - corner, 0.0, 1.0)
                    node = ti.math.clamp(ti.floor(u * spaces, ti.i32), 0, spaces - 1)
                    shares = node_shares(u * spaces - node)
                    edge = spaces + 1
                    row = ((node[0] * edge + node[1]) * edge + node[2]) * (8 * size)
                    weight, total = 0.0, ti.Vector([0.0] * group)
                    for o in range(8):
                        step = ti.Vector([o >> 2, o >> 1 & 1, o & 1])
                        tent = tent_weight((u - step) * 0.5) * present[o]
                        if ti.static(not blend):
                            own = ti.cast(u >= 0.5, ti.i32)
                            mine = turn >= count or own[0] * 4 + own[1] * 2 + own[2] == o
                            tent = present[o] if mine else 0.0
                        weight += tent
                        for a in ti.static(range(size)):
                            tents[o * size + a] = tent
                        for c in ti.static(range(group)):
                            total[c] += tent * prior[c * 8 + o]
                    # nothing is stored in this loop, so that it vectorises
                    for j in range(8 * size):
                        f = 0.0
                        for m in ti.static(range(8)):
                            above = ti.static(m >> 2) * edge * edge + ti.static(m >> 1 & 1) * edge
                            f += shares[m] * table[row + (above + ti.static(m & 1)) * 8 * size + j]
                        f *= tents[j]
                        for c in ti.static(range(group)):
                            total[c] += f * F[c * 8 * size + j]
                    if weight > 0:
                        for c in ti.static(range(group)):
                            if first + c < layout.channels:
                                values[n, first + c] = total[c] / weight
                    covered = weight > 0 and turn < count
                    valid[n] = ti.cast(covered, ti.u8)
                    codes[k] = UNCOVERED if weight == 0 and reach > 0 else NOWHERE


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
    rows: Ints1,  # (S,) row of `own_masks` that counts instead, ITSELF, or ABSENT
    own_masks: Masks2,  # (E, 2)
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
            s, row = corner_slot(keys, q, o, index), ABSENT
            if s >= 0:
                row = rows[s]
            if row != ABSENT:
                # A voxel's cells 0..3 along an axis are cells -2..1 (upper voxel: 2..5) of the cube
                # that starts at its centre.
                base = ti.Vector([o // 4, o // 2 % 2, o % 2]) * CELLS - CELLS // 2 + 1
                for half in range(2):
                    mask = own_masks[row, half] if row >= 0 else map_masks[s, half]
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
    rows: Ints1,  # (S,) row of `own` that counts instead, ITSELF, or ABSENT
    own: Floats3,  # (E, l, 1)
    basis: Floats2,  # (R^3, 8 l) tent weight times f_posi of each voxel, at the R^3 samples of a cube
    tents: Floats2,  # (R^3, 8)
    # out:
    sdf: Floats2,  # (Q, R^3) signed distance [voxels], UNKNOWN where no voxel reaches
):
    for q in range(keys.shape[0]):
        F = ti.Vector([0.0] * (8 * rank))
        present = ti.Vector([0.0] * 8)
        for o in range(8):
            s, row = corner_slot(keys, q, o, index), ABSENT
            if s >= 0:
                row = rows[s]
            if row != ABSENT:
                present[o] = 1.0
                for a in range(rank):
                    F[o * rank + a] = own[row, a, 0] if row >= 0 else latents[s, a, 0]
        for r in range(basis.shape[0]):
            value, weight = 0.0, 0.0
            for a in range(8 * rank):
                value += basis[r, a] * F[a]
            for o in range(8):
                weight += tents[r, o] * present[o]
            sdf[q, r] = value / weight if weight > 1e-5 else UNKNOWN
