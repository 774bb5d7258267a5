"""Fusion of a frame's local LIM into the map: the running mean of latents (Eq. 19), or the batch
regression over all frames.
"""

import taichi as ti

from .regression import solve_voxel
from .voxels import Floats1, Floats2, Floats3, Ints1, Masks2

LEAST_WEIGHT = 0.5  # weights count points: less is what rounding leaves when all were taken out


@ti.kernel
def fuse(
    # in:
    rows: ti.template(),
    channels: ti.template(),
    first: ti.i32,  # column of `latents` that is the map's first
    voxels: ti.i32,
    slots: Ints1,  # (B,) slot in the map, -1 where none
    latents: Floats3,  # (B, r, first + c or more) F'
    weights: Floats1,  # (B,) w'
    masks: Masks2,  # (B, 2) support
    sign: ti.f32,  # 1; -1 takes out again what was fused
    # out:
    map_latents: Floats3,  # (S, r, c) F <- (F w + F' w') / (w + w')
    map_weights: Floats1,  # (S,) w <- w + w'
    map_masks: Masks2,  # (S, 2) |=
):
    for v in range(voxels):
        s = slots[v]
        if s >= 0:
            old, new = map_weights[s], sign * weights[v]
            total = old + new if old + new > LEAST_WEIGHT else 0.0
            share = 1.0  # exactly, so that a loaded map equals the saved one
            if old > 0 and total > 0:
                share = new / total
            for a in range(rows):
                # all reads before all writes
                old_row = ti.Vector([map_latents[s, a, c] for c in ti.static(range(channels))])
                new_row = ti.Vector([latents[v, a, first + c] for c in ti.static(range(channels))])
                fused = old_row + (new_row - old_row) * share
                for c in ti.static(range(channels)):
                    map_latents[s, a, c] = fused[c]
            map_weights[s] = total
            for half in ti.static(range(2)):
                map_masks[s, half] = map_masks[s, half] | masks[v, half]  # `|=` would be atomic


@ti.func
def encoded_place(
    q: ti.i32,
    size: ti.template(),
    channels: ti.template(),
    centered: ti.template(),
    first: ti.i32,
    encoded: ti.i32,
) -> ti.i32:
    """Where number q of a map's sums stands in the sums of `encoded` channels of which the map has
    those from `first` on.
    """
    targets = size * (size + 1) // 2
    ones = targets + size * channels
    means = ones + size * ti.static(int(centered))
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
    rank: ti.template(),
    size: ti.template(),
    rows: ti.template(),
    channels: ti.template(),
    centered: ti.template(),
    first: ti.i32,
    encoded: ti.i32,  # channel of the sums that is the map's first, and how many they have
    voxels: ti.i32,
    slots: Ints1,  # (B,) slot in the map, -1 where none
    sums: Floats2,  # (B, q or more) as `keep_sums`
    weights: Floats1,  # (B,) w'
    masks: Masks2,  # (B, 2) support
    sign: ti.f32,  # 1; -1 takes out again what was fused
    noise: ti.f32,
    # out:
    map_sums: Floats2,  # (S, q) += sums
    map_latents: Floats3,  # (S, r, c) F of the regression over all that was fused (Eq. 6)
    map_weights: Floats1,  # (S,) w <- w + w'
    map_masks: Masks2,  # (S, 2) |=
):
    for v in range(voxels):
        s = slots[v]
        if s >= 0:
            G = ti.Vector([0.0] * (rows * size))
            mean = ti.Vector([0.0] * channels)
            total = map_weights[s] + sign * weights[v]
            for q in range(map_sums.shape[1]):
                map_sums[s, q] = (
                    map_sums[s, q]
                    + sign * sums[v, encoded_place(q, size, channels, centered, first, encoded)]
                )
            k = 0
            for i in range(size):
                for j in range(i + 1):
                    G[i * size + j] = map_sums[s, k]
                    k += 1
            for i in range(size * (channels + ti.static(int(centered)))):
                G[size * size + i] = map_sums[s, k]
                k += 1
            for c in ti.static(range(channels)):
                mean[c] = map_sums[s, k + c]
            if total > LEAST_WEIGHT:
                solve_voxel(
                    s,
                    rank,
                    size,
                    rows,
                    channels,
                    centered,
                    noise,
                    total,
                    mean,
                    G,
                    map_latents,
                    map_weights,
                )
            else:
                map_weights[s] = 0.0
            for half in ti.static(range(2)):
                map_masks[s, half] = map_masks[s, half] | masks[v, half]
