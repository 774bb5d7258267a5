"""The two sides of boards that are thinner than a voxel: what is seen from opposite directions is kept
apart, since one smooth field cannot cross zero twice within a voxel.

A window sees one side. Its local LIM counts as a *back* where its surface faces away from one fixed
direction, FRONT; backs are fused into a mean of their own too. Where the mean of the backs and that
of all others, the front, face away from each other, a voxel has two fields.
"""

import taichi as ti

from .arrays import Bytes1, Doubles2, Floats1, Floats2, Floats3, Ints1, Masks2, Rows2
from .cells import BLOCK_CELLS
from .fusion import LEAST_WEIGHT

OPPOSITE = -0.5  # cosine between slopes that face away from each other
STEEP = 0.3  # mean slope of a field that has a surface: 1 is a distance


@ti.kernel
def weigh_sides(
    # in:
    blocks: ti.i32,
    lean: Floats1,  # (l,) the slope of a latent's field towards FRONT
    encoded: Floats3,  # (B, l or more, 1 or more) F'
    weights: Floats1,  # (B,) w'
    # out:
    side_weights: Floats2,  # (B, 2) w' of a front and of a back, of which one is 0
):
    for b in range(blocks):
        slope = 0.0
        for a in range(lean.shape[0]):
            slope += lean[a] * encoded[b, a, 0]
        side_weights[b, 0] = 0.0 if slope < 0 else weights[b]
        side_weights[b, 1] = weights[b] if slope < 0 else 0.0


@ti.kernel
def fuse_sides(
    # in:
    rank: ti.template(),
    exact: ti.template(),  # whether `totals` are kept
    blocks: ti.i32,
    slots: Ints1,  # (B,) slot in the map, -1 where none
    encoded: Floats3,  # (B, l or more, 1 or more) F'
    side_weights: Floats2,  # (B, 2) w' of fronts and of backs
    sign: ti.i32,  # 1; -1 takes out again what was fused
    # in and out:
    totals: Doubles2,  # (S, 1 + l) sums of w' and F' w' of backs, where they are exact
    backs: Rows2,  # (S, l) F <- (F w + F' w') / (w + w') of backs
    map_weights: Floats2,  # (S, 2) w <- w + w'
):
    for b in range(blocks):
        s = slots[b]
        if s >= 0:
            new, before = side_weights[b, 1] * sign, map_weights[s, 1]
            for side in ti.static(range(2)):
                total = map_weights[s, side] + side_weights[b, side] * sign
                map_weights[s, side] = total if total > LEAST_WEIGHT else 0.0
            total = map_weights[s, 1]
            share = 1.0  # exactly, so that a loaded map equals the saved one
            if before > 0 and total > 0:
                share = new / total
            for a in range(rank if new != 0 else 0):
                old, fused = ti.cast(backs[s, a], ti.f32), 0.0
                if ti.static(exact):
                    sums = totals[s, 1 + a] + ti.cast(encoded[b, a, 0], ti.f64) * new
                    totals[s, 1 + a] = sums
                    if total > 0:
                        fused = ti.cast(sums / total, ti.f32)
                elif total > 0:
                    fused = old + (encoded[b, a, 0] - old) * share
                backs[s, a] = ti.cast(fused, ti.f16)
            if ti.static(exact):
                totals[s, 0] = totals[s, 0] + new


@ti.kernel
def note_support(
    # in:
    blocks: ti.i32,
    slots: Ints1,  # (B,) slot in the map, -1 where none
    support: Masks2,  # (B, 2)
    # in and out:
    masks: Masks2,  # (S, 2) |= support
):
    for b in range(blocks):
        s = slots[b]
        if s >= 0:
            for half in ti.static(range(2)):
                masks[s, half] = masks[s, half] | support[b, half]  # `|=` would be atomic


@ti.func
def mean_slope(F: ti.template(), features: ti.template(), rank: ti.template()):
    """The mean slope of a field over a voxel [1]."""
    g = ti.Vector([0.0, 0.0, 0.0])
    for a in range(rank):
        for d in ti.static(range(3)):
            g[d] += features[BLOCK_CELLS, 1 + d, a] * F[a]
    return g


@ti.func
def part_sides(
    # in:
    rank: ti.template(),
    s: ti.i32,
    features: ti.template(),  # (65, 4, l) as of `visibility.vote_cells`
    backs: ti.template(),  # (S, l)
    side_weights: ti.template(),  # (S, 2)
    # in and out:
    F: ti.template(),  # (l,) the voxel's latent; becomes that of the front where there are two sides
    # out:
    B: ti.template(),  # (l,) that of the back
) -> ti.i32:
    """Whether voxel s has two sides, and their latents."""
    front, back = side_weights[s, 0], side_weights[s, 1]
    two = False
    if back > LEAST_WEIGHT and front > LEAST_WEIGHT:
        ahead = ti.Vector([0.0] * rank)
        for a in range(rank):
            B[a] = ti.cast(backs[s, a], ti.f32)
            ahead[a] = (F[a] * (front + back) - B[a] * back) / front
        one, other = mean_slope(ahead, features, rank), mean_slope(B, features, rank)
        steep = ti.min(one.norm(), other.norm()) > STEEP
        two = steep and one.dot(other) < OPPOSITE * one.norm() * other.norm()
        if two:
            for a in range(rank):
                F[a] = ahead[a]
    return ti.cast(two, ti.i32)


@ti.kernel
def find_sides(
    # in:
    rank: ti.template(),
    features: Floats3,  # (65, 4, l) as of `visibility.vote_cells`
    slots: Ints1,  # (N,) of some voxels
    latents: Floats3,  # (S, l, 1)
    backs: Rows2,  # (S, l)
    side_weights: Floats2,  # (S, 2)
    # out:
    two: Bytes1,  # (N,) 1 where a voxel has two sides
    fronts: Floats2,  # (N, l) F, of the front where there are two
    mean_slopes: Floats2,  # (N, 6) of it, and of that of the back
):
    for n in range(slots.shape[0]):
        s = slots[n]
        F, B = ti.Vector([0.0] * rank), ti.Vector([0.0] * rank)
        for a in range(rank):
            F[a] = latents[s, a, 0]
        two[n] = ti.cast(part_sides(rank, s, features, backs, side_weights, F, B), ti.u8)
        g, h = mean_slope(F, features, rank), mean_slope(B, features, rank)
        for a in range(rank):
            fronts[n, a] = F[a]
        for d in ti.static(range(3)):
            mean_slopes[n, d], mean_slopes[n, 3 + d] = g[d], h[d]
