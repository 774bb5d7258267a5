"""Evidence for the surface and against it: a frame, one *view* of a window, votes in every cell that
it sees or sees through.

A regression extrapolates: where a surface ends, its field goes on. What ends it are rays that pass
through. Every cell of a voxel (its 4^3 quarters) counts the frames that saw surface in it, minus
those that read depth behind it.
"""

import taichi as ti

from .arrays import Floats1, Floats2, Floats3, Ints1, Ints2, Masks2, Rows2, Votes2, row3
from .camera import Intrinsics
from .cells import (
    BLOCK_CELLS,
    CELLS,
    cell_bit,
    cell_center,
    cell_in_lattice,
    first_cell,
    has_cell,
)
from .index import INDEX_HALF, find, voxel_of
from .sides import part_sides
from .tasks import worker_stride

MOST_VOTES = 127  # votes that a cell can hold, for or against
SLACK_VOXELS = 0.5  # a reading this far behind a point passes through it [voxels]...
SLACK_NOISE = 0.003  # ...plus this much [1/m] times its depth squared: two sigma of a Kinect
GRAZING = 0.1  # cosine; rays flatter on a surface than this cannot say that they pass through it
ALONE = 0.45  # the surface of a cell lies within this distance of its centre [voxels]
LEAST_TENT = 1e-6  # smallest sum of tent weights that counts; below it the default 1 is used
HALF = BLOCK_CELLS // 2  # cells whose bits are one word
NEAREST = 1e-3  # [m] before a camera, from which on it may see a point
VOTE_TASK = 16  # voxels that one task votes in
FLAT = 0.2  # a field with a smaller slope than this has no surface to speak of


@ti.func
def read_behind(p: ti.template(), k: ti.i32, depth: ti.template(), K: ti.template()):
    """How far behind p [m, camera] the reading of its pixel in view k lies [m], and whether there
    is a reading.
    """
    behind, known = 0.0, False
    if p[2] > 0:
        per_depth = 1.0 / p[2]
        u = p[0] * per_depth * K[0] + K[2] + 0.5
        v = p[1] * per_depth * K[1] + K[3] + 0.5
        # before the cast, which could overflow
        if u >= 0 and v >= 0 and u < depth.shape[2] and v < depth.shape[1]:
            reading = depth[k, ti.cast(v, ti.i32), ti.cast(u, ti.i32)]
            behind, known = reading - p[2], reading > 0
    return behind, known


@ti.func
def cell_surface(rank: ti.template(), F: ti.template(), cell: ti.i32, features: ti.template()):
    """The point of the surface nearest to a cell's centre [voxels from the voxel's corner], its
    normal, and if there is one.
    """
    value, slope = 0.0, ti.Vector([0.0, 0.0, 0.0])
    for a in range(rank):
        value += features[cell, 0, a] * F[a]
        for d in ti.static(range(3)):
            slope[d] += features[cell, 1 + d, a] * F[a]
    steep = slope.norm()
    normal = slope / ti.max(steep, 1e-6)
    distance = value / ti.max(steep, 1e-6)
    return cell_center(cell) - distance * normal, normal, steep > FLAT and ti.abs(distance) < ALONE


@ti.func
def add_votes(evidence: ti.template(), s: ti.i32, cell: ti.i32, votes: ti.i32):
    """Add votes to a cell, within what it can hold."""
    total = ti.cast(evidence[s, cell], ti.i32) + votes
    evidence[s, cell] = ti.cast(ti.math.clamp(total, -MOST_VOTES, MOST_VOTES), ti.i8)


@ti.func
def seen_beside(
    p: ti.template(),
    slack: ti.f32,
    k: ti.i32,
    depth: ti.template(),
    K: ti.template(),
):
    """Whether a pixel beside that of p [m, camera] in view k reads its depth: on glass and dark
    things, readings come and go.
    """
    seen = False
    u = p[0] / p[2] * K[0] + K[2] + 0.5
    v = p[1] / p[2] * K[1] + K[3] + 0.5
    if u >= 1 and v >= 1 and u < depth.shape[2] - 1 and v < depth.shape[1] - 1:
        for o in range(9):
            reading = depth[k, ti.cast(v, ti.i32) + o // 3 - 1, ti.cast(u, ti.i32) + o % 3 - 1]
            seen = seen or (reading > 0 and ti.abs(reading - p[2]) < slack)
    return seen


@ti.func
def surface_vote(
    p: ti.template(),
    normal: ti.template(),
    voxel_size: ti.f32,
    k: ti.i32,
    depth: ti.template(),
    K: ti.template(),
):
    """1 where the reading of view k at a point p of the surface [m, camera] saw it, -1 where it passed
    through, else 0; on a slanted surface, depth changes across a pixel.
    """
    behind, known = read_behind(p, k, depth, K)
    cosine = ti.max(ti.abs(normal.dot(p)) / p.norm(), 0.02)
    slack = SLACK_VOXELS * voxel_size + SLACK_NOISE * p[2] * p[2]
    slack += p[2] / K[0] * ti.sqrt(1.0 - ti.min(cosine * cosine, 1.0)) / cosine
    vote = 0
    if known == 0:
        vote = ti.cast(seen_beside(p, slack, k, depth, K), ti.i32)
    elif behind > slack:
        vote = -1 if cosine > GRAZING else 0
    elif behind > -slack:
        vote = 1
    return vote


@ti.func
def column3(rows: ti.template(), cell: ti.i32):
    """What three rows of a value a cell hold of a cell."""
    return ti.Vector([rows[d * BLOCK_CELLS + cell] for d in ti.static(range(3))])


@ti.func
def rotation_and_corner(
    T: ti.template(), k: ti.i32, s: ti.i32, keys: ti.template(), voxel_size: ti.f32
):
    """Rotation of view k from voxels in the world to metres in the camera, and where the corner of
    voxel s comes to lie.
    """
    R = ti.Matrix([[T[k, i, j] * voxel_size for j in range(3)] for i in range(3)])
    return R, R @ row3(keys, s) + ti.Vector([T[k, i, 3] for i in ti.static(range(3))])


@ti.func
def views_of(
    # in:
    s: ti.i32,
    keys: ti.template(),
    voxel_size: ti.f32,
    depth: ti.template(),
    K: ti.template(),
    T: ti.template(),
) -> ti.u32:
    """The views in whose images voxel s may lie, as bits."""
    seen = ti.u32(0)
    for k in range(T.shape[0]):
        R, corner = rotation_and_corner(T, k, s, keys, voxel_size)
        center = corner + R @ ti.Vector([0.5, 0.5, 0.5])
        z = ti.max(center[2], 1e-3)
        # what votes lies within a voxel's edge of its centre
        around = 1.5 * voxel_size * ti.max(K[0], K[1]) / ti.max(center[2] - voxel_size, 1e-3)
        u = center[0] / z * K[0] + K[2]
        v = center[1] / z * K[1] + K[3]
        if center[2] > -voxel_size:
            if (
                u > -around
                and v > -around
                and u < depth.shape[2] + around
                and v < depth.shape[1] + around
            ):
                seen |= ti.u32(1) << ti.cast(k, ti.u32)
    return seen


@ti.func
def ask_view(
    # in:
    points: ti.template(),
    half: ti.i32,
    R: ti.template(),
    corner: ti.template(),
    voxel_size: ti.f32,
    k: ti.i32,
    depth: ti.template(),
    K: ti.template(),
):
    """Of half a voxel's cells, as bits: whose points view k reads, and which it reads behind.

    A loop without branches and stores, which the compiler makes one over eight cells at once.
    """
    width, height = ti.cast(depth.shape[2], ti.f32), ti.cast(depth.shape[1], ti.f32)
    seen, passed = ti.u32(0), ti.u32(0)
    for c in range(HALF):
        cell = half * HALF + c
        x = ti.Vector([points[cell], points[BLOCK_CELLS + cell], points[2 * BLOCK_CELLS + cell]])
        p = corner + R @ x
        per_depth = 1.0 / ti.max(p[2], NEAREST)
        u = p[0] * per_depth * K[0] + K[2] + 0.5
        v = p[1] * per_depth * K[1] + K[3] + 0.5
        column = ti.cast(ti.min(ti.max(u, 0.0), width - 1.0), ti.i32)
        row = ti.cast(ti.min(ti.max(v, 0.0), height - 1.0), ti.i32)
        reading = depth[k, row, column]
        inside = (p[2] > NEAREST) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        known = inside & (reading > 0)
        behind = reading - p[2]
        slack = SLACK_VOXELS * voxel_size + SLACK_NOISE * p[2] * p[2]
        bit = ti.u32(1) << ti.cast(HALF - 1 - c, ti.u32)
        seen |= ti.select(known & (ti.abs(behind) <= slack), bit, ti.u32(0))
        passed |= ti.select(known & (behind > slack), bit, ti.u32(0))
    return seen, passed


@ti.kernel
def vote_cells(
    # in:
    rank: ti.template(),
    slots: ti.types.vector(2, ti.i32),  # the first slot to vote in, and the one after the last
    keys: Ints2,  # (S, 3)
    masks: Masks2,  # (S, 2) cells with support
    latents: Floats3,  # (S, l, 1)
    backs: Rows2,  # (S, l), or one row where the map does not keep sides apart
    side_weights: Floats2,  # (S, 2)
    # (65, 4, l) f_posi and its gradient by voxel units at the cells' centres, and their mean
    features: Floats3,
    voxel_size: ti.f32,
    depth: Floats3,  # (K or more, H, W) [m] of K views, 0: no reading
    K: Intrinsics,
    T_camera_world: Floats3,  # (K, 3, 4) [m]
    sign: ti.i32,  # 1; -1 takes the votes back
    # in and out:
    # (S, 64) += views that saw the cell's surface, -= those that saw through the cell
    evidence: Votes2,
):
    stride = ti.static(worker_stride())
    for i in range((slots[1] - slots[0] + VOTE_TASK - 1) // VOTE_TASK * stride):
        if i % stride == 0:
            first = slots[0] + i // stride * VOTE_TASK
            for s in range(first, ti.min(first + VOTE_TASK, slots[1])):
                views = views_of(s, keys, voxel_size, depth, K, T_camera_world)
                if views != 0:
                    F = ti.Vector([0.0] * rank)
                    for a in range(rank):
                        F[a] = latents[s, a, 0]
                    two, B = 0, ti.Vector([0.0] * rank)
                    if side_weights.shape[0] > 1:
                        two = part_sides(rank, s, features, backs, side_weights, F, B)
                    votes = ti.Vector([0] * BLOCK_CELLS)
                    points = ti.Vector([0.0] * (3 * BLOCK_CELLS))  # all x, then y, then z
                    normals = ti.Vector([0.0] * (3 * BLOCK_CELLS))
                    surface = ti.Vector([ti.u32(0), ti.u32(0)])  # cells that hold some
                    for cell in range(BLOCK_CELLS):  # once for all views
                        x, normal = cell_center(cell), ti.Vector([0.0, 0.0, 0.0])
                        if has_cell(masks, s, cell) != 0:
                            x, normal, found = cell_surface(rank, F, cell, features)
                            if two != 0:  # the nearer side
                                y, other, seen_too = cell_surface(rank, B, cell, features)
                                center = cell_center(cell)
                                nearer = (y - center).norm_sqr() < (x - center).norm_sqr()
                                if seen_too and (nearer or not found):
                                    x, normal, found = y, other, True
                            if found:
                                surface[cell // HALF] |= cell_bit(cell % HALF)
                        for d in ti.static(range(3)):
                            points[d * BLOCK_CELLS + cell] = x[d]
                            normals[d * BLOCK_CELLS + cell] = normal[d]
                    for k in range(T_camera_world.shape[0]):
                        if (views >> ti.cast(k, ti.u32)) & 1 != 0:
                            R, corner = rotation_and_corner(T_camera_world, k, s, keys, voxel_size)
                            for half in range(2):
                                seen, passed = ask_view(
                                    points, half, R, corner, voxel_size, k, depth, K
                                )
                                seen &= surface[half]
                                # also where no surface was seen yet: that this view saw through, in
                                # case a later frame extrapolates one there
                                passed &= ~masks[s, half]
                                for c in range(HALF):
                                    votes[half * HALF + c] += ti.cast(
                                        (seen >> ti.cast(HALF - 1 - c, ti.u32)) & 1, ti.i32
                                    ) - ti.cast(
                                        (passed >> ti.cast(HALF - 1 - c, ti.u32)) & 1, ti.i32
                                    )
                                rest = surface[half] & ~seen
                                while rest != 0:
                                    c = first_cell(rest)
                                    rest ^= cell_bit(c)
                                    cell = half * HALF + c
                                    p = corner + R @ column3(points, cell)
                                    if p[2] > 0:
                                        normal = R @ column3(normals, cell) / voxel_size
                                        votes[cell] += surface_vote(
                                            p, normal, voxel_size, k, depth, K
                                        )
                    for cell in range(BLOCK_CELLS):
                        if votes[cell] != 0:
                            add_votes(evidence, s, cell, sign * votes[cell])


@ti.kernel
def vote_support(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    support: Masks2,  # (B, 2) cells that the frame supports
    index: ti.template(),
    sign: ti.i32,
    # in and out:
    evidence: Votes2,  # (S, 64) += 1 where the frame supports the cell: it has no rays to ask
):
    for b, cell in ti.ndrange(blocks, BLOCK_CELLS):
        s = find(index, row3(keys, b))
        if s >= 0 and has_cell(support, b, cell) != 0:
            add_votes(evidence, s, cell, sign)


@ti.kernel
def add_evidence(
    # in:
    slots: Ints1,  # (N,)
    evidence: Votes2,  # (N, 64)
    # in and out:
    map_evidence: Votes2,  # (S, 64) += evidence
):
    for n, cell in ti.ndrange(slots.shape[0], BLOCK_CELLS):
        add_votes(map_evidence, slots[n], cell, ti.cast(evidence[n, cell], ti.i32))


@ti.kernel
def interpolate_evidence(
    # in:
    points: Floats2,  # (N, 3) world [m]
    per_meter: ti.f32,
    index: ti.template(),
    masks: Masks2,  # (S, 2)
    evidence: Votes2,  # (S, 64)
    # out:
    # (N,) trilinear mean over the 8 cells around, of those with support or negative evidence; 1 if
    # there is none
    values: Floats1,
):
    for n in range(points.shape[0]):
        x = row3(points, n) * (per_meter * CELLS) - 0.5
        corner = voxel_of(x)
        part = x - corner
        total, weight = 0.0, 0.0
        for o in range(8):
            step = ti.Vector([o // 4, o // 2 % 2, o % 2])
            at = corner + step
            s = find(index, ti.math.clamp(at >> 2, -INDEX_HALF, INDEX_HALF - 1))
            if s >= 0:
                cell = cell_in_lattice(at)
                if has_cell(masks, s, cell) != 0 or evidence[s, cell] < 0:
                    tent = 1.0
                    for d in ti.static(range(3)):
                        tent *= part[d] if step[d] == 1 else 1.0 - part[d]
                    total += tent * evidence[s, cell]
                    weight += tent
        values[n] = total / weight if weight > LEAST_TENT else 1.0
