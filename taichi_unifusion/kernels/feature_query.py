"""Features of a map when they are asked for: texts times rows, the regression of each voxel, its
value at points (Sec. IV-D).

See `features.py` for what a voxel keeps.
"""

import taichi as ti

from .arrays import Bytes1, Floats1, Floats2, Floats3, Rows2, row3
from .encoding import table_features
from .index import INDEX_HALF, all_within, find, voxel_of
from .query import nearest_voxel, tent_weight

DIRECTIONS = 4  # texts that are worked on at once


@ti.kernel
def project_rows(
    # in:
    voxels: ti.i32,
    means: Rows2,  # (S, c)
    slopes: Rows2,  # (S, q c)
    scales: Floats2,  # (S, q)
    directions: Floats2,  # (T, c), T a multiple of DIRECTIONS
    # out:
    products: Floats3,  # (S, 1 + q, T)
):
    for s in range(voxels):
        channels = means.shape[1]
        for part in range(directions.shape[0] // DIRECTIONS):
            sums = ti.Vector([0.0] * DIRECTIONS)
            for c in range(channels):
                y = ti.cast(means[s, c], ti.f32)
                for t in ti.static(range(DIRECTIONS)):
                    sums[t] += y * directions[part * DIRECTIONS + t, c]
            for t in ti.static(range(DIRECTIONS)):
                products[s, 0, part * DIRECTIONS + t] = sums[t]
            for a in range(scales.shape[1]):
                sums = ti.Vector([0.0] * DIRECTIONS)
                for c in range(channels):
                    y = ti.cast(slopes[s, a * channels + c], ti.f32)
                    for t in ti.static(range(DIRECTIONS)):
                        sums[t] += y * directions[part * DIRECTIONS + t, c]
                for t in ti.static(range(DIRECTIONS)):
                    products[s, 1 + a, part * DIRECTIONS + t] = sums[t] * scales[s, a]


@ti.kernel
def take_channels(
    # in:
    voxels: ti.i32,
    means: Rows2,  # (S, c)
    slopes: Rows2,  # (S, q c)
    scales: Floats2,  # (S, q)
    first: ti.i32,
    # out:
    products: Floats3,  # (S, 1 + q, T) channels first .. first + T, as far as there are so many
):
    for s in range(voxels):
        for t in range(ti.min(products.shape[2], means.shape[1] - first)):
            products[s, 0, t] = ti.cast(means[s, first + t], ti.f32)
            for a in range(scales.shape[1]):
                products[s, 1 + a, t] = (
                    ti.cast(slopes[s, a * means.shape[1] + first + t], ti.f32) * scales[s, a]
                )


@ti.kernel
def mean_lengths(
    # in:
    voxels: ti.i32,
    means: Rows2,  # (S, c)
    # out:
    lengths: Floats1,  # (S,) |E[y]|
):
    for s in range(voxels):
        total = 0.0
        for c in range(means.shape[1]):
            y = ti.cast(means[s, c], ti.f32)
            total += y * y
        lengths[s] = ti.sqrt(total)


@ti.kernel
def solve_rows(
    # in:
    rank: ti.template(),
    voxels: ti.i32,
    moments: Floats3,  # (S, q + q (q + 1) / 2, 1)
    weights: Floats1,  # (S,)
    noise: ti.f32,  # d of Eq. 6 for one feature pixel
    # in and out:
    # (S, 1 + q, T) products of mean and slopes -> the constant and the coefficients of f_posi
    products: Floats3,
):
    for s in range(voxels):
        L = ti.Vector([0.0] * (rank * rank))
        at = rank
        for a in range(rank):  # Cholesky factor, row by row; the diagonal keeps its inverse
            for b in range(a + 1):
                value = moments[s, at, 0] - moments[s, a, 0] * moments[s, b, 0]
                at += 1
                for k in range(b):
                    value -= L[a * rank + k] * L[b * rank + k]
                if a == b:
                    L[a * rank + a] = 1.0 / ti.sqrt(ti.max(value + noise / weights[s], 1e-12))
                else:
                    L[a * rank + b] = value * L[b * rank + b]
        for t in range(products.shape[2]):
            F = ti.Vector([0.0] * rank)
            mean = products[s, 0, t]
            for a in range(rank):
                value = products[s, 1 + a, t]
                for k in range(a):
                    value -= L[a * rank + k] * F[k]
                F[a] = value * L[a * rank + a]
            for back in range(rank):
                a = rank - 1 - back
                value = F[a]
                for k in range(a + 1, rank):
                    value -= L[k * rank + a] * F[k]
                F[a] = value * L[a * rank + a]
                mean -= moments[s, a, 0] * F[a]
                products[s, 1 + a, t] = F[a]
            products[s, 0, t] = mean


@ti.kernel
def query_products(
    # in:
    rank: ti.template(),
    points: Floats2,  # (N, 3) world [m]
    per_meter: ti.f32,
    index: ti.template(),
    products: Floats3,  # (S, 1 + q, T) constants and coefficients, T a multiple of DIRECTIONS
    table: Floats2,  # (nodes^3, q)
    nodes: ti.i32,
    # points that no voxel covers take the value of the nearest one within this many voxels
    reach: ti.i32,
    # out:
    values: Floats2,  # (N, T)
    valid: Bytes1,  # (N,) = 1 where a voxel covers the point
):
    for n in range(points.shape[0]):
        x = row3(points, n) * per_meter
        weight, covered, found = 0.0, 0, 0
        slots = ti.Vector([0] * 9)
        # of each voxel's constant and coefficients in the value
        shares = ti.Vector([0.0] * (9 * (1 + rank)))
        if all_within(x, INDEX_HALF - 1.0):
            corner = voxel_of(x - 0.5)
            for o in range(9):
                ijk, s = corner, -1
                if o < 8:
                    ijk = corner + ti.Vector([o // 4, o // 2 % 2, o % 2])
                    s = find(index, ijk)
                elif weight == 0 and reach > 0:
                    s, ijk = nearest_voxel(x, reach, index)
                if s >= 0:
                    at = ti.math.clamp((x - ijk - 0.5) * 0.5, -0.5, 0.5)
                    tent = tent_weight(at)
                    f = table_features(at, rank, table, nodes)
                    shares[found * (1 + rank)] = tent
                    for a in ti.static(range(rank)):
                        shares[found * (1 + rank) + 1 + a] = tent * f[a]
                    slots[found] = s
                    found += 1
                    weight += tent
                    covered += ti.cast(o < 8, ti.i32)
        valid[n] = ti.cast(covered > 0, ti.u8)
        for part in range(values.shape[1] // DIRECTIONS):
            sums = ti.Vector([0.0] * DIRECTIONS)
            for i in range(found):
                for a in range(1 + rank):
                    for t in ti.static(range(DIRECTIONS)):
                        sums[t] += (
                            shares[i * (1 + rank) + a]
                            * products[slots[i], a, part * DIRECTIONS + t]
                        )
            for t in ti.static(range(DIRECTIONS)):
                values[n, part * DIRECTIONS + t] = sums[t] / ti.max(weight, 1e-12)
