"""Fusion of a frame's local LIM into the map: the running mean of latents (Eq. 19), or the batch
regression over all frames.
"""

import taichi as ti

from .arrays import Doubles2, Floats1, Floats3, Ints1, Masks2, Rows2, Shorts2
from .cells import cell_bit, has_cell
from .gram import solve_voxel

# weights are numbers of points; a remainder below this is rounding and counts as empty
LEAST_WEIGHT = 0.5


@ti.kernel
def fuse(
    # in:
    layout: ti.template(),
    first: ti.i32,  # column of `latents` that is the map's first
    voxels: ti.i32,
    slots: Ints1,  # (B,) slot in the map, -1 where none
    latents: Floats3,  # (B, r, first + c or more) F'
    weights: Floats1,  # (B,) w'
    masks: Masks2,  # (B, 2) support
    sign: ti.f32,  # 1; -1 takes out again what was fused
    # in and out:
    map_latents: Floats3,  # (S, r, c) F <- (F w + F' w') / (w + w')
    map_weights: Floats1,  # (S,) w <- w + w'
    map_masks: Masks2,  # (S, 2) |=
):
    channels = ti.static(layout.channels)
    for v in range(voxels):
        s = slots[v]
        if s >= 0:
            old, new = map_weights[s], sign * weights[v]
            total = old + new if old + new > LEAST_WEIGHT else 0.0
            share = 1.0  # exactly, so that a loaded map equals the saved one
            if old > 0 and total > 0:
                share = new / total
            for a in range(layout.latent_rows):
                # all reads before all writes
                old_row = ti.Vector([map_latents[s, a, c] for c in ti.static(range(channels))])
                new_row = ti.Vector([latents[v, a, first + c] for c in ti.static(range(channels))])
                fused = old_row + (new_row - old_row) * share
                for c in ti.static(range(channels)):
                    map_latents[s, a, c] = fused[c]
            map_weights[s] = total
            for half in ti.static(range(2)):
                map_masks[s, half] = map_masks[s, half] | masks[v, half]  # `|=` would be atomic


@ti.kernel
def fuse_exactly(
    # in:
    layout: ti.template(),
    first: ti.i32,  # column of `latents` that is the map's first
    voxels: ti.i32,
    slots: Ints1,  # (B,) slot in the map, -1 where none
    latents: Floats3,  # (B, r, first + c or more) F', whole numbers of a small step
    weights: Floats1,  # (B,) w', whole numbers
    sign: ti.i32,  # 1; -1 takes out again what was fused
    # in and out:
    map_sums: Doubles2,  # (S, 1 + r c) sums of w' and of F' w': exact, so their order is of no account
    # out:
    map_latents: Floats3,  # (S, r, c) F, the mean (Eq. 19)
    map_weights: Floats1,  # (S,) w
):
    channels = ti.static(layout.channels)
    for v in range(voxels):
        s = slots[v]
        if s >= 0:
            new = ti.cast(weights[v], ti.f64) * sign
            total = map_sums[s, 0] + new
            map_sums[s, 0] = total
            share = 1.0 / total if total > LEAST_WEIGHT else ti.cast(0.0, ti.f64)
            for a in range(layout.latent_rows):
                for c in ti.static(range(channels)):
                    q = 1 + a * channels + c
                    fused = map_sums[s, q] + ti.cast(latents[v, a, first + c], ti.f64) * new
                    map_sums[s, q] = fused
                    map_latents[s, a, c] = ti.cast(fused * share, ti.f32)
            map_weights[s] = ti.cast(total, ti.f32) if total > LEAST_WEIGHT else 0.0


@ti.kernel
def count_support(
    # in:
    voxels: ti.i32,
    slots: Ints1,  # (B,) slot in the map, -1 where none
    masks: Masks2,  # (B, 2) support
    sign: ti.i32,  # 1; -1 takes out again what was counted
    # in and out:
    counts: Shorts2,  # (S, 64) local LIMs that support each cell
    # out:
    map_masks: Masks2,  # (S, 2) cells that any supports
):
    for v in range(voxels):
        s = slots[v]
        if s >= 0:
            for half in ti.static(range(2)):
                support = ti.u32(0)
                for k in range(32):
                    cell = half * 32 + k
                    n = ti.cast(counts[s, cell], ti.i32) + sign * has_cell(masks, v, cell)
                    counts[s, cell] = ti.cast(n, ti.u16)
                    if n > 0:
                        support |= cell_bit(k)
                map_masks[s, half] = support


@ti.func
def encoded_place(layout: ti.template(), q: ti.i32, first: ti.i32, encoded: ti.i32) -> ti.i32:
    """Where number q of a map's sums stands in the sums of `encoded` channels of which the map has
    those from `first` on.
    """
    size, channels = ti.static(layout.size, layout.channels)
    targets = size * (size + 1) // 2
    ones = targets + size * channels
    means = ones + size * ti.static(int(layout.centered))
    place = q
    if q >= means:
        place += size * (encoded - channels) + first
    elif q >= ones:
        place += size * (encoded - channels)
    elif q >= targets:
        place += size * first
    return place


@ti.kernel
def fuse_information(
    # in:
    layout: ti.template(),
    first: ti.i32,  # channel of the sums that is the map's first
    encoded: ti.i32,  # channels that they have
    voxels: ti.i32,
    slots: Ints1,  # (B,) slot in the map, -1 where none
    sums: Floats3,  # (B, q or more, 1) as `keep_sums`
    weights: Floats1,  # (B,) w'
    masks: Masks2,  # (B, 2) support
    sign: ti.f32,  # 1; -1 takes out again what was fused
    noise: ti.f32,
    # in and out:
    map_sums: Rows2,  # (S, q) += sums
    map_weights: Floats1,  # (S,) w <- w + w'
    map_masks: Masks2,  # (S, 2) |=
    # out:
    map_latents: Floats3,  # (S, r, c) F of the regression over all that was fused (Eq. 6)
):
    size, channels = ti.static(layout.size, layout.channels)
    for v in range(voxels):
        s = slots[v]
        if s >= 0:
            G = ti.Vector([0.0] * (layout.rows * size))
            mean = ti.Vector([0.0] * channels)
            total = map_weights[s] + sign * weights[v]
            for q in range(map_sums.shape[1]):
                new = sums[v, encoded_place(layout, q, first, encoded), 0]
                map_sums[s, q] = map_sums[s, q] + sign * new  # `+=` would be atomic
            k = 0
            for i in range(size):
                for j in range(i + 1):
                    G[i * size + j] = ti.cast(map_sums[s, k], ti.f32)
                    k += 1
            for i in range(size * (channels + ti.static(int(layout.centered)))):
                G[size * size + i] = ti.cast(map_sums[s, k], ti.f32)
                k += 1
            for c in ti.static(range(channels)):
                mean[c] = ti.cast(map_sums[s, k + c], ti.f32)
            if total > LEAST_WEIGHT:
                solve_voxel(layout, s, noise, total, mean, G, map_latents, map_weights)
            else:
                map_weights[s] = 0.0
            for half in ti.static(range(2)):
                map_masks[s, half] = map_masks[s, half] | masks[v, half]
