"""The Gram matrix of a voxel's regression: summed from tiles of samples, solved, or kept as sums.

A sample is a row of vectors: f_posi, then its targets and, if centred, a one, all times the root of
its weight. G holds the lower triangle of P^T W P in its first `size` rows and Y^T W P in the rows
below, as one vector of a thread; while it is summed up it lies in vectors of `LANES` columns.
"""

from dataclasses import dataclass

import taichi as ti

from .layout import LANES, PATCH

TILE = 64  # samples that are held at once
BATCH = 4  # of them, those whose products are added to a vector of G at once


@dataclass(frozen=True, eq=False)
class Scratch:
    """What each of W workers needs to itself, as one compile-time argument: fields, because their
    strides are known when compiling.
    """

    tiles: ti.Field  # (W, TILE, V) vectors of samples
    products: ti.Field  # (W, V x LANES, V) vectors of their products

    @property
    def workers(self) -> int:
        return self.tiles.shape[0]


@ti.func
def clear_products(layout: ti.template(), worker: ti.i32, scratch: ti.template()):
    """No samples yet."""
    for i in range(layout.vectors * LANES):
        for right in range(layout.feature_vectors):
            scratch.products[worker, i, right] = ti.Vector([0.0] * LANES)


@ti.func
def put_number(
    scratch: ti.template(), worker: ti.i32, sample: ti.i32, column: ti.template(), y: ti.f32
):
    """One of the numbers of a sample in a worker's tile."""
    scratch.tiles[worker, sample, column // LANES][column % LANES] = y


@ti.func
def add_samples(
    layout: ti.template(),
    worker: ti.i32,
    filled: ti.i32,
    scratch: ti.template(),
):
    """Add the products of the `filled` samples in a worker's tile to those before, below the diagonal
    and in the blocks on it; first clears the samples that round them up to a whole batch.
    """
    batches = (filled + BATCH - 1) // BATCH
    for k in range(filled, batches * BATCH):
        for part in range(layout.vectors):
            scratch.tiles[worker, k, part] = ti.Vector([0.0] * LANES)
    for batch in range(batches):
        k = batch * BATCH
        for right in range(layout.feature_vectors):
            for left in range(right, layout.vectors):
                for a in ti.static(range(LANES)):
                    row = scratch.products[worker, left * LANES + a, right]
                    for m in ti.static(range(BATCH)):
                        row += (
                            scratch.tiles[worker, k + m, left][a]
                            * scratch.tiles[worker, k + m, right]
                        )
                    scratch.products[worker, left * LANES + a, right] = row


@ti.func
def take_products(layout: ti.template(), worker: ti.i32, scratch: ti.template(), G: ti.template()):
    """G of the products that were summed up."""
    size = ti.static(layout.size)
    for i in range(layout.rows):
        for j in ti.static(range(size)):
            G[i * size + j] = scratch.products[worker, i, j // LANES][j % LANES]


@ti.func
def cholesky_solve(layout: ti.template(), noise: ti.f32, G: ti.template()):
    """Solve (G + noise I) F = R, where R^T stands in the rows of the targets below P^T P; F^T
    replaces it.
    """
    size, rows, width = ti.static(layout.size, layout.rows, layout.channels)
    for column in range(size // PATCH):
        for row in range(column, rows // PATCH):
            s = ti.Vector([0.0] * (PATCH * PATCH))
            for a in ti.static(range(PATCH)):
                for b in ti.static(range(PATCH)):
                    s[a * PATCH + b] = G[(row * PATCH + a) * size + column * PATCH + b]
            for k in range(PATCH * column):
                for a in ti.static(range(PATCH)):
                    for b in ti.static(range(PATCH)):
                        s[a * PATCH + b] -= (
                            G[(row * PATCH + a) * size + k] * G[(column * PATCH + b) * size + k]
                        )
            if row == column:  # factor the patch; its diagonal keeps the inverse pivots
                for c in ti.static(range(PATCH)):
                    pivot = s[c * PATCH + c] + noise
                    for k in ti.static(range(c)):
                        pivot -= s[c * PATCH + k] * s[c * PATCH + k]
                    s[c * PATCH + c] = 1.0 / ti.sqrt(ti.max(pivot, 1e-12))
                    for r in ti.static(range(c + 1, PATCH)):
                        for k in ti.static(range(c)):
                            s[r * PATCH + c] -= s[r * PATCH + k] * s[c * PATCH + k]
                        s[r * PATCH + c] *= s[c * PATCH + c]
            else:
                for c in ti.static(range(PATCH)):
                    for a in ti.static(range(PATCH)):
                        for k in ti.static(range(c)):
                            s[a * PATCH + c] -= (
                                s[a * PATCH + k]
                                * G[(column * PATCH + c) * size + column * PATCH + k]
                            )
                        s[a * PATCH + c] *= G[(column * PATCH + c) * size + column * PATCH + c]
            for a in ti.static(range(PATCH)):
                for b in ti.static(range(PATCH)):
                    G[(row * PATCH + a) * size + column * PATCH + b] = s[a * PATCH + b]
    for back in range(size):
        i = size - 1 - back
        s = ti.Vector([0.0] * width)
        for c in ti.static(range(width)):
            s[c] = G[(size + c) * size + i]
        for k in range(i + 1, size):
            for c in ti.static(range(width)):
                s[c] -= G[k * size + i] * G[(size + c) * size + k]
        for c in ti.static(range(width)):
            G[(size + c) * size + i] = s[c] * G[i * size + i]


@ti.func
def solve_voxel(
    # in:
    layout: ti.template(),
    v: ti.i32,
    noise: ti.f32,
    weight: ti.f32,
    # in and out:
    mean: ti.template(),
    G: ti.template(),
    # out:
    latents: ti.template(),
    weights: ti.template(),
):
    """F of one voxel from its Gram matrix; with a prior mean m, regress y - m and keep m as one
    more row.
    """
    size, rank, channels = ti.static(layout.size, layout.rank, layout.channels)
    if ti.static(layout.centered):
        # P^T W (Y - 1 m) = R - (P^T W 1) m; the row of ones follows the targets
        for c in ti.static(range(channels)):
            mean[c] /= weight
        for a in range(size):
            for c in ti.static(range(channels)):
                G[(size + c) * size + a] -= G[(size + channels) * size + a] * mean[c]
    cholesky_solve(layout, noise, G)
    weights[v] = weight
    for a in range(rank):
        for c in ti.static(range(channels)):
            latents[v, a, c] = G[(size + c) * size + a]
    if ti.static(layout.centered):
        for c in ti.static(range(channels)):
            latents[v, rank, c] = mean[c]


@ti.func
def keep_sums(
    # in:
    layout: ti.template(),
    v: ti.i32,
    weight: ti.f32,
    mean: ti.template(),
    G: ti.template(),
    # out:
    sums: ti.template(),
    weights: ti.template(),
):
    """What the regression of one voxel sums over its samples, in one row: the lower half of
    P^T W P, then Y^T W P, 1^T W P and Y^T W 1.
    """
    size = ti.static(layout.size)
    k = 0
    for i in range(size):
        for j in range(i + 1):
            sums[v, k, 0] = G[i * size + j]
            k += 1
    for i in range(size * (layout.channels + ti.static(int(layout.centered)))):
        sums[v, k, 0] = G[size * size + i]
        k += 1
    for c in ti.static(range(layout.channels)):
        sums[v, k + c, 0] = mean[c]
    weights[v] = weight
