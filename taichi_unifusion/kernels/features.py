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

from dataclasses import dataclass

import taichi as ti

from .arrays import Bytes1, Floats1, Floats2, Floats3, Ints1, Ints2, Masks2, Rows2, row3
from .cells import cell_bit, cell_center, cells_before, first_cell
from .regression import cell_row, neighbor_step
from .tasks import worker_stride

# cells of a doubled voxel, 512 at most; not a power of two: rows would map to the same cache sets
ENTRIES = 528
LOW = 0xFFFFFFFF  # the low half of 64 bits
CHANNELS = 16  # channels that a worker sums at once
LEVELS = 127  # of the largest number of a row in 8 bits


@dataclass(frozen=True)
class FeatureLayout:
    """What is known of a map of features when kernels are compiled."""

    rank: int  # q, position features that have a slope
    bits8: bool  # slopes are kept in 8 bits, with a scale a row


@dataclass(frozen=True, eq=False)
class Scratch:
    """What each of W workers needs to itself, as one compile-time argument."""

    factors: ti.Field  # (W, 1 + q, ENTRIES) weights, and position features times them
    places: ti.Field  # (W, ENTRIES) feature pixels
    tiles: ti.Field  # (W, CHANNELS, ENTRIES) some channels of those pixels
    fresh: ti.Field  # (W, 1 + q, c or more) mean and slopes of what is new

    @property
    def workers(self) -> int:
        return self.places.shape[0]


# What a map keeps of its voxels, as one argument.
FeaturePools = ti.types.argpack(
    means=Rows2,  # (S, c) E[y]
    slopes=Rows2,  # (S, q c) cov(f, y), by the voxel's scales
    scales=Floats2,  # (S, q)
    moments=Floats3,  # (S, q + q (q + 1) / 2, 1) E[f], E[f f^T]
    weights=Floats1,  # (S,) feature pixels seen in the doubled voxel
)


@ti.kernel
def find_pixels(
    # in:
    blocks: ti.i32,
    keys: Ints2,  # (B, 3)
    starts: Ints1,  # (B,) first row of each block in `cells`
    masks: Masks2,  # (B, 2) cells that hold points
    # (M, 4) root of the count, then the mean offset from the cell's centre [voxels], times it
    cells: Floats2,
    voxel_size: ti.f32,
    projection: Floats2,  # (3, 4) world [m] -> homogeneous pixel of the feature image
    width: ti.i32,
    usable: Bytes1,  # (h * w,) 1 where a feature is finite
    minimum: ti.i32,
    # in and out:
    seen: Ints1,  # (h * w,) += points in the pixel
    # out:
    pixels: Ints1,  # (M,) feature pixel that a cell's mean point falls into, -1 where none
    weights: Floats1,  # (B,) points of the block that have a feature; 0 for fewer than `minimum`
):
    for b in range(blocks):
        n, total = starts[b], 0
        for half in range(2):
            mask = masks[b, half]
            while mask != 0:
                k = first_cell(mask)
                mask ^= cell_bit(k)
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
                        at = v * width + u
                        pixel = at if usable[at] != 0 else -1
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
    scratch: ti.template(),
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
                    k = first_cell(wanted)
                    wanted ^= cell_bit(k)
                    n = starts[b] + cells_before(occupied, k)
                    if half == 1:
                        n += ti.cast(ti.math.popcnt(masks[b, 0]), ti.i32)
                    if pixels[n] >= 0:
                        weight = cells[n, 0] * cells[n, 0] * scale
                        at = cell_row(half * 32 + k, step)
                        scratch.factors[worker, 0, filled] = weight
                        for a in ti.static(range(rank)):
                            scratch.factors[worker, 1 + a, filled] = weight * features[at, a]
                        scratch.places[worker, filled] = pixels[n]
                        filled += 1
    for k in range(filled, (filled + 15) // 16 * 16):  # a whole number of vectors
        for a in ti.static(range(1 + rank)):
            scratch.factors[worker, a, k] = 0.0
        scratch.places[worker, k] = 0
    return filled


@ti.func
def fuse_moments(
    # in:
    rank: ti.template(),
    s: ti.i32,
    worker: ti.i32,
    filled: ti.i32,
    factors: ti.template(),
    # in and out:
    pools: ti.template(),
):
    """Fuse E[f] and the lower triangle of E[f f^T] of a voxel.

    Returns the weight that is new, its share of all, E[f] of what is new, and how far that is from
    what was there.
    """
    weight = 0.0
    for k in range(filled):
        weight += factors[worker, 0, k]
    old = pools.weights[s]
    share = weight / (old + weight) if old > 0 else 1.0
    means, moved = ti.Vector([0.0] * rank), ti.Vector([0.0] * rank)
    at = 0
    for a in range(rank):
        mean = 0.0
        for k in range(filled):
            mean += factors[worker, 1 + a, k]
        means[a] = mean / weight
        moved[a] = means[a] - pools.moments[s, a, 0]
        pools.moments[s, a, 0] = pools.moments[s, a, 0] + moved[a] * share
        for b in range(a + 1):
            product = 0.0
            for k in range(filled):
                product += (
                    factors[worker, 1 + a, k] * factors[worker, 1 + b, k] / factors[worker, 0, k]
                )
            place = rank + at
            pools.moments[s, place, 0] = (
                pools.moments[s, place, 0] + (product / weight - pools.moments[s, place, 0]) * share
            )
            at += 1
    pools.weights[s] = old + weight
    return weight, share, means, moved


@ti.func
def product(a: ti.u32, b: ti.template()) -> ti.u32:
    """a b modulo 2^32; debug mode would report a product of 32 bits that wraps around."""
    return ti.cast((ti.cast(a, ti.u64) * ti.u64(b)) & ti.u64(LOW), ti.u32)


@ti.func
def chance(seed: ti.u32, i: ti.i32) -> ti.f32:
    """A number in [0, 1) for the i-th number of a voxel."""
    h = product(
        ti.cast((ti.cast(seed, ti.u64) + ti.cast(i, ti.u64)) & ti.u64(LOW), ti.u32), 0x9E3779B1
    )
    h = product(h ^ (h >> 15), 0x85EBCA77)
    h = h ^ (h >> 13)
    return ti.cast(h >> 8, ti.f32) * (1.0 / (1 << 24))


@ti.func
def fuse_row(
    # in:
    layout: ti.template(),
    s: ti.i32,
    worker: ti.i32,
    channels: ti.i32,
    share: ti.f32,
    moved: ti.template(),
    seed: ti.u32,
    # in and out:
    fresh: ti.template(),  # (W, 1 + q, c) mean and slopes of what is new
    pools: ti.template(),
):
    """Fuse new features into those of voxel s: the mean, and the slopes about it, in the precision
    that they are kept in.
    """
    for c in range(channels):
        before = ti.cast(pools.means[s, c], ti.f32)
        fresh[worker, 0, c] -= before
        pools.means[s, c] = before + fresh[worker, 0, c] * share
    for a in range(layout.rank):
        largest, scale, apart = 0.0, pools.scales[s, a], share * (1.0 - share) * moved[a]
        for c in range(channels):
            before = ti.cast(pools.slopes[s, a * channels + c], ti.f32) * scale
            value = (
                before + (fresh[worker, 1 + a, c] - before) * share + apart * fresh[worker, 0, c]
            )
            fresh[worker, 1 + a, c] = value
            largest = ti.max(largest, ti.abs(value))
        if ti.static(layout.bits8):
            scale = largest / LEVELS
            per = 1.0 / scale if largest > 1e-30 else 0.0
            for c in range(channels):
                i = a * channels + c
                pools.slopes[s, i] = ti.cast(
                    ti.floor(fresh[worker, 1 + a, c] * per + chance(seed, i)), ti.i8
                )
            pools.scales[s, a] = scale
        else:
            for c in range(channels):
                pools.slopes[s, a * channels + c] = fresh[worker, 1 + a, c]
            pools.scales[s, a] = 1.0


@ti.func
def voxel_seed(ijk: ti.template(), weight: ti.f32) -> ti.u32:
    """Seed of the stochastic rounding; differs between voxels and between updates of a voxel."""
    h = ti.bit_cast(weight, ti.u32)
    for d in ti.static(range(3)):
        h = product(h ^ ti.cast(ijk[d], ti.u32), 0x01000193)
        h ^= h >> 16
    return h


@ti.kernel
def fuse_features(
    # in:
    layout: ti.template(),
    keys: Ints2,  # (B, 3)
    slots: Ints1,  # (B,) slot in the map, -1 where the block is left out
    neighbors: Ints2,  # (B, 27)
    masks: Masks2,  # (B, 2) as find_pixels
    window: Masks2,  # (27, 2) cells of each neighbour that count
    starts: Ints1,  # (B,)
    cells: Floats2,  # (M, 4)
    pixels: Ints1,  # (M,)
    features: Floats2,  # (8^3, q) position features at the cell centres of a doubled voxel
    image: Floats2,  # (h * w, c) features, c rounded up to CHANNELS
    scale: ti.f32,  # weight of a point: feature pixels a point
    # in and out:
    scratch: ti.template(),
    pools: FeaturePools,
):
    rank = ti.static(layout.rank)
    stride, workers, blocks = ti.static(worker_stride()), ti.static(scratch.workers), slots.shape[0]
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
                        scratch,
                    )
                    weight, share, mean_f, moved = fuse_moments(
                        rank, s, worker, filled, scratch.factors, pools
                    )
                    length = (filled + 15) // 16 * 16
                    for part in range(image.shape[1] // CHANNELS):
                        first = part * CHANNELS
                        # transposed, so that the sums below run over the contiguous axis
                        for k in range(length):
                            for c in ti.static(range(CHANNELS)):
                                pixel = scratch.places[worker, k]
                                scratch.tiles[worker, c, k] = image[pixel, first + c]
                        for c in range(CHANNELS):
                            sums = ti.Vector([0.0] * (1 + rank))
                            for k in range(length):
                                y = scratch.tiles[worker, c, k]
                                for a in ti.static(range(1 + rank)):
                                    sums[a] += scratch.factors[worker, a, k] * y
                            mean = sums[0] / weight
                            scratch.fresh[worker, 0, first + c] = mean
                            for a in ti.static(range(rank)):
                                slope = sums[1 + a] / weight - mean_f[a] * mean
                                scratch.fresh[worker, 1 + a, first + c] = slope
                    seed = voxel_seed(row3(keys, v), pools.weights[s])
                    channels = pools.means.shape[1]
                    fuse_row(layout, s, worker, channels, share, moved, seed, scratch.fresh, pools)


@ti.kernel
def fuse_voxels(
    # in:
    layout: ti.template(),
    keys: Ints2,  # (N, 3)
    slots: Ints1,  # (N,) slot in the map
    means: Rows2,  # (N, c) of the other map
    slopes: Rows2,  # (N, q c)
    scales: Floats2,  # (N, q)
    moments: Floats3,  # (N, q + q (q + 1) / 2, 1)
    weights: Floats1,  # (N,)
    # in and out:
    scratch: ti.template(),
    pools: FeaturePools,
):
    stride, workers, voxels = ti.static(worker_stride()), ti.static(scratch.workers), slots.shape[0]
    for i in range(workers * stride):
        if i % stride == 0:
            worker = i // stride
            for n in range(worker * voxels // workers, (worker + 1) * voxels // workers):
                s, channels = slots[n], pools.means.shape[1]
                before = pools.weights[s]
                share = weights[n] / (before + weights[n]) if before > 0 else 1.0
                moved = ti.Vector([0.0] * layout.rank)
                for a in range(layout.rank):
                    moved[a] = moments[n, a, 0] - pools.moments[s, a, 0]
                for a in range(moments.shape[1]):
                    old = pools.moments[s, a, 0]
                    pools.moments[s, a, 0] = old + (moments[n, a, 0] - old) * share
                pools.weights[s] = before + weights[n]
                for c in range(channels):
                    scratch.fresh[worker, 0, c] = ti.cast(means[n, c], ti.f32)
                for a in range(layout.rank):
                    for c in range(channels):
                        slope = ti.cast(slopes[n, a * channels + c], ti.f32) * scales[n, a]
                        scratch.fresh[worker, 1 + a, c] = slope
                seed = voxel_seed(row3(keys, n), pools.weights[s])
                fuse_row(layout, s, worker, channels, share, moved, seed, scratch.fresh, pools)
