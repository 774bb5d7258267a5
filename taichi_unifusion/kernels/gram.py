"""The Gram matrix of a voxel's regression: summed from tiles of samples, solved, or kept as sums.

G holds the lower triangle of P^T W P in its first `size` rows and Y^T W P in the rows below, as one
vector of a thread.
"""

import taichi as ti

from .layout import PATCH


@ti.func
def add_tile(
    layout: ti.template(),
    worker: ti.i32,
    filled: ti.i32,
    tiles: ti.template(),
    G: ti.template(),
):
    """G += P W P^T over the `filled` samples in a worker's tile, whose columns are zero up to the
    next multiple of 16.
    """
    size, rows = ti.static(layout.size, layout.rows)
    length = (filled + 15) // 16 * 16
    for i in range(rows // PATCH):
        for j in range(ti.min(i + 1, size // PATCH)):
            sums = ti.Vector([0.0] * (PATCH * PATCH))
            for k in range(length):
                for a in ti.static(range(PATCH)):
                    for b in ti.static(range(PATCH)):
                        sums[a * PATCH + b] += (
                            tiles[worker, i * PATCH + a, k] * tiles[worker, j * PATCH + b, k]
                        )
            for a in ti.static(range(PATCH)):
                for b in ti.static(range(PATCH)):
                    G[(i * PATCH + a) * size + j * PATCH + b] += sums[a * PATCH + b]


@ti.func
def flush(
    layout: ti.template(),
    worker: ti.i32,
    filled: ti.i32,
    tiles: ti.template(),
    G: ti.template(),
):
    """Add what a worker's tile holds to G, first clearing the columns that round it up to a
    multiple of 16.

    It is most of what a kernel compiles, so kernels call it in one place: when the tile is full,
    and in a round after the last neighbour for what is left.
    """
    for row in range(layout.rows):
        for k in range(filled, (filled + 15) // 16 * 16):
            tiles[worker, row, k] = 0.0
    add_tile(layout, worker, filled, tiles, G)


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
