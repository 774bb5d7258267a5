"""High-dimensional features of the surface: regressed and fused as sums, solved only when they are
asked for (Sec. IV-D).

A voxel keeps running means over all that was seen in its doubled voxel: of the features y (its
*mean*), of f and of f f^T for q position features f (its *moments*), and the covariances of f and y
(its *slopes*, q rows). Eq. 19 fuses all of these exactly, the slopes with what the means moved, so
that

    F = (E[f f^T] - E[f] E[f]^T + d / w I)^-1 cov(f, y)

is the regression (Eq. 6) over all frames at once, about the mean of what was seen. Everything is
linear in y: a text is multiplied onto the rows first, and the regression is then solved for one
number instead of c.

Slopes may be kept in 8 bits with a scale for each row. They are then rounded up or down by chance,
so that no frame's share is lost to rounding on average; the chance is a hash of the voxel and its
weight, so that the same frames give the same map.
"""

import taichi as ti

from .cells import cell_center
from .regression import cell_row, neighbor_step
from .voxels import Floats1, Floats2, Floats3, Ints1, Ints2, Masks2, row3

# cells of a doubled voxel, 512 at most; no power of two, whose rows would share cache lines
ENTRIES = 528
CHANNELS = 16  # channels that a worker sums at once
LEVELS = 127  # of the largest number of a row in 8 bits
Rows2 = ti.types.ndarray(ndim=2)  # of any precision
Bytes1 = ti.types.ndarray(dtype=ti.u8, ndim=1)


@ti.kernel
def find_pixels(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    starts: Ints1,  # (B,) first row of each block in `cells`
    masks: Masks2,  # (B, 2) cells that hold points
    cells: Floats2,  # (M, 4) root of the count, then the mean offset from the cell's centre [voxels], times it
    voxel_size: ti.f32,
    projection: Floats2,  # (3, 4) world [m] -> homogeneous pixel of the feature image
    width: ti.i32,
    usable: Bytes1,  # (h * w,) 1 where a feature is finite
    minimum: ti.i32,
    # out:
    pixels: Ints1,  # (M,) feature pixel that a cell's mean point falls into, -1 where none
    seen: Ints1,  # (h * w,) += points in the pixel
    weights: Floats1,  # (B,) points of the block that have a feature; 0 for fewer than `minimum`
):
    for b in range(blocks):
        n, total = starts[b], 0
        for half in range(2):
            mask = masks[b, half]
            while mask != 0:
                k = ti.math.clz(ti.cast(mask, ti.i32))
                mask ^= ti.u32(1) << ti.cast(31 - k, ti.u32)
                root = cells[n, 0]
                offset = ti.Vector([cells[n, 1], cells[n, 2], cells[n, 3]]) / root
                x = (row3(keys, b) + cell_center(half * 32 + k) + offset) * voxel_size
                h = ti.Vector(
                    [
                        projection[i, 0] * x[0]
                        + projection[i, 1] * x[1]
                        + projection[i, 2] * x[2]
                        + projection[i, 3]
                        for i in ti.static(range(3))
                    ]
                )
                pixel = -1
                if h[2] > 1e-6:
                    u, v = ti.floor(h[0] / h[2] + 0.5, ti.i32), ti.floor(h[1] / h[2] + 0.5, ti.i32)
                    if u >= 0 and v >= 0 and u < width and v < usable.shape[0] // width:
                        if usable[v * width + u] != 0:
                            pixel = v * width + u
                if pixel >= 0:
                    count = ti.round(root * root, ti.i32)
                    total += count
                    ti.atomic_add(seen[pixel], count)
                pixels[n] = pixel
                n += 1
        weights[b] = ti.cast(total, ti.f32) if total >= minimum else 0.0


@ti.func
def gather_entries(
    # in:
    rank: ti.template(),
    v: ti.i32,
    worker: ti.i32,
    neighbors: ti.template(),
    masks: ti.template(),
    window: ti.template(),
    starts: ti.template(),
    cells: ti.template(),
    pixels: ti.template(),
    features: ti.template(),
    scale: ti.f32,
    # out:
    factors: ti.template(),
    places: ti.template(),
):
    """The cells in a doubled voxel that have a feature: their weight and weighted position
    features; returns how many.
    """
    filled = 0
    for o in range(27):
        b, step = neighbors[v, o], neighbor_step(o)
        if b >= 0:
            for half in range(2):
                occupied = masks[b, half]
                wanted = occupied & window[o, half]
                while wanted != 0:
                    k = ti.math.clz(ti.cast(wanted, ti.i32))
                    wanted ^= ti.u32(1) << ti.cast(31 - k, ti.u32)
                    n = starts[b] + ti.math.popcnt((occupied >> 1) >> ti.cast(31 - k, ti.u32))
                    if half == 1:
                        n += ti.math.popcnt(masks[b, 0])
                    if pixels[n] >= 0:
                        weight = cells[n, 0] * cells[n, 0] * scale
                        at = cell_row(half * 32 + k, step)
                        factors[worker, 0, filled] = weight
                        for a in ti.static(range(rank)):
                            factors[worker, 1 + a, filled] = weight * features[at, a]
                        places[worker, filled] = pixels[n]
                        filled += 1
    for k in range(filled, (filled + 15) // 16 * 16):  # a whole number of vectors
        for a in ti.static(range(1 + rank)):
            factors[worker, a, k] = 0.0
        places[worker, k] = 0
    return filled


@ti.func
def fuse_moments(
    rank: ti.template(),
    s: ti.i32,
    worker: ti.i32,
    filled: ti.i32,
    factors: ti.template(),
    moments: ti.template(),
    weights: ti.template(),
):
    """Fuse E[f] and the lower triangle of E[f f^T] of a voxel.

    Returns the weight that is new, its share of all, E[f] of what is new, and how far that is from
    what was there.
    """
    weight = 0.0
    for k in range(filled):
        weight += factors[worker, 0, k]
    old = weights[s]
    share = weight / (old + weight) if old > 0 else 1.0
    means, moved = ti.Vector([0.0] * rank), ti.Vector([0.0] * rank)
    at = 0
    for a in range(rank):
        mean = 0.0
        for k in range(filled):
            mean += factors[worker, 1 + a, k]
        means[a] = mean / weight
        moved[a] = means[a] - moments[s, a, 0]
        moments[s, a, 0] = moments[s, a, 0] + moved[a] * share
        for b in range(a + 1):
            product = 0.0
            for k in range(filled):
                product += (
                    factors[worker, 1 + a, k] * factors[worker, 1 + b, k] / factors[worker, 0, k]
                )
            place = rank + at
            moments[s, place, 0] = (
                moments[s, place, 0] + (product / weight - moments[s, place, 0]) * share
            )
            at += 1
    weights[s] = old + weight
    return weight, share, means, moved


@ti.func
def chance(seed: ti.u32, i: ti.i32) -> ti.f32:
    """A number in [0, 1) for the i-th number of a voxel."""
    h = (seed + ti.cast(i, ti.u32)) * ti.u32(0x9E3779B1)
    h = (h ^ (h >> 15)) * ti.u32(0x85EBCA77)
    h = h ^ (h >> 13)
    return ti.cast(h >> 8, ti.f32) * (1.0 / (1 << 24))


@ti.func
def fuse_row(
    # in:
    rank: ti.template(),
    bits8: ti.template(),
    s: ti.i32,
    worker: ti.i32,
    channels: ti.i32,
    share: ti.f32,
    moved: ti.template(),
    seed: ti.u32,
    # in and out:
    fresh: ti.template(),  # scratch of each worker: mean and slopes of what is new
    # out:
    means: ti.template(),
    slopes: ti.template(),
    scales: ti.template(),
):
    """Fuse new features into those of voxel s: the mean, and the slopes about it, in the precision
    that they are kept in.
    """
    for c in range(channels):
        before = ti.cast(means[s, c], ti.f32)
        fresh[worker, 0, c] -= before
        means[s, c] = before + fresh[worker, 0, c] * share
    for a in range(rank):
        largest, scale, apart = 0.0, scales[s, a], share * (1.0 - share) * moved[a]
        for c in range(channels):
            before = ti.cast(slopes[s, a * channels + c], ti.f32) * scale
            value = (
                before + (fresh[worker, 1 + a, c] - before) * share + apart * fresh[worker, 0, c]
            )
            fresh[worker, 1 + a, c] = value
            largest = ti.max(largest, ti.abs(value))
        if ti.static(bits8):
            scale = largest / LEVELS
            per = 1.0 / scale if largest > 1e-30 else 0.0
            for c in range(channels):
                i = a * channels + c
                slopes[s, i] = ti.cast(
                    ti.floor(fresh[worker, 1 + a, c] * per + chance(seed, i)), ti.i8
                )
            scales[s, a] = scale
        else:
            for c in range(channels):
                slopes[s, a * channels + c] = fresh[worker, 1 + a, c]
            scales[s, a] = 1.0


@ti.func
def voxel_seed(ijk: ti.template(), weight: ti.f32) -> ti.u32:
    """What the rounding of a voxel begins with: another for every voxel, and for every weight that
    it had.
    """
    h = ti.bit_cast(weight, ti.u32)
    for d in ti.static(range(3)):
        h = (h ^ ti.cast(ijk[d], ti.u32)) * ti.u32(0x01000193)
        h ^= h >> 16
    return h


@ti.kernel
def fuse_features(
    # in:
    rank: ti.template(),  # q
    bits8: ti.template(),  # whether slopes are kept in 8 bits
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    slots: Ints1,  # (B,) slot in the map, -1 where the block is left out
    neighbors: Ints2,  # (B, 27)
    # as find_pixels; (27, 2) cells of each neighbour that count
    masks: Masks2,
    window: Masks2,
    starts: Ints1,
    cells: Floats2,
    pixels: Ints1,  # (M,)
    features: Floats2,  # (8^3, q) position features at the cell centres of a doubled voxel
    image: Floats2,  # (h * w, c) features, c rounded up to CHANNELS
    scale: ti.f32,  # weight of a point: feature pixels a point
    workers: ti.i32,
    stride: ti.i32,
    # out:
    factors: ti.template(),
    places: ti.template(),
    tiles: ti.template(),
    fresh: ti.template(),  # scratch of each worker
    means: Rows2,  # (S, c) E[y]
    slopes: Rows2,  # (S, q c) cov(f, y), by the voxel's scales
    scales: Floats2,  # (S, q)
    moments: Floats3,  # (S, q + q (q + 1) / 2, 1) E[f], E[f f^T]
    weights: Floats1,  # (S,) feature pixels seen in the doubled voxel
):
    for i in range(workers * stride):
        if i % stride == 0:
            worker = i // stride
            for v in range(worker * blocks // workers, (worker + 1) * blocks // workers):
                s = slots[v]
                if s >= 0:
                    filled = gather_entries(
                        rank,
                        v,
                        worker,
                        neighbors,
                        masks,
                        window,
                        starts,
                        cells,
                        pixels,
                        features,
                        scale,
                        factors,
                        places,
                    )
                    weight, share, mean_f, moved = fuse_moments(
                        rank, s, worker, filled, factors, moments, weights
                    )
                    length = (filled + 15) // 16 * 16
                    for part in range(image.shape[1] // CHANNELS):
                        # transposed, so that the sums below run over the contiguous axis
                        for k in range(length):
                            for c in ti.static(range(CHANNELS)):
                                tiles[worker, c, k] = image[places[worker, k], part * CHANNELS + c]
                        for c in range(CHANNELS):
                            sums = ti.Vector([0.0] * (1 + rank))
                            for k in range(length):
                                y = tiles[worker, c, k]
                                for a in ti.static(range(1 + rank)):
                                    sums[a] += factors[worker, a, k] * y
                            mean = sums[0] / weight
                            fresh[worker, 0, part * CHANNELS + c] = mean
                            for a in ti.static(range(rank)):
                                fresh[worker, 1 + a, part * CHANNELS + c] = (
                                    sums[1 + a] / weight - mean_f[a] * mean
                                )
                    fuse_row(
                        rank,
                        bits8,
                        s,
                        worker,
                        means.shape[1],
                        share,
                        moved,
                        voxel_seed(row3(keys, v), weights[s]),
                        fresh,
                        means,
                        slopes,
                        scales,
                    )


@ti.kernel
def fuse_voxels(
    # in:
    rank: ti.template(),
    bits8: ti.template(),
    voxels: ti.i32,
    keys: Ints2,  # (N, 3)
    slots: Ints1,  # (N,) slot in the map
    # (N, ...)
    other_means: Rows2,
    other_slopes: Rows2,
    other_scales: Floats2,
    other_moments: Floats3,
    other_weights: Floats1,
    workers: ti.i32,
    stride: ti.i32,
    # out:
    fresh: ti.template(),  # scratch of each worker
    means: Rows2,
    slopes: Rows2,
    scales: Floats2,
    moments: Floats3,
    weights: Floats1,  # as fuse_features
):
    for i in range(workers * stride):
        if i % stride == 0:
            worker = i // stride
            for n in range(worker * voxels // workers, (worker + 1) * voxels // workers):
                s, channels = slots[n], means.shape[1]
                share = (
                    other_weights[n] / (weights[s] + other_weights[n]) if weights[s] > 0 else 1.0
                )
                moved = ti.Vector([0.0] * rank)
                for a in range(rank):
                    moved[a] = other_moments[n, a, 0] - moments[s, a, 0]
                for a in range(moments.shape[1]):
                    moments[s, a, 0] = (
                        moments[s, a, 0] + (other_moments[n, a, 0] - moments[s, a, 0]) * share
                    )
                weights[s] = weights[s] + other_weights[n]
                for c in range(channels):
                    fresh[worker, 0, c] = ti.cast(other_means[n, c], ti.f32)
                for a in range(rank):
                    for c in range(channels):
                        fresh[worker, 1 + a, c] = (
                            ti.cast(other_slopes[n, a * channels + c], ti.f32) * other_scales[n, a]
                        )
                fuse_row(
                    rank,
                    bits8,
                    s,
                    worker,
                    channels,
                    share,
                    moved,
                    voxel_seed(row3(keys, n), weights[s]),
                    fresh,
                    means,
                    slopes,
                    scales,
                )
