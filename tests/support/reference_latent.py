"""Slow float64 twins of the kernels of feature maps; a twin has the name of its kernel. Positions
are in voxel units.

A feature is seen by a cell (its mean point falls into a pixel); a voxel's sums run over the cells
of its doubled box, all frames at once: what the kernels keep as running means must be the same
regression.
"""

from __future__ import annotations

import numpy as np
from reference import CELLS, CORNERS, rows_by


def find_pixels(x, projection, width, height, usable):
    """Feature pixel of points (N, 3) [m], -1 where none."""
    h = x @ projection[:, :3].T + projection[:, 3]
    u, v = np.floor(h[:, :2] / h[:, 2:] + 0.5).astype(int).T
    inside = (h[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    pixels = np.where(inside, v * width + u, -1)
    return np.where(inside & usable[np.maximum(pixels, 0)], pixels, -1)


def seen_cells(points, voxel_size, projection, values):
    """Lattice cell (N, 3), count (N,) and feature (N, c) of every cell with one, and the weight of
    a point.
    """
    x = points.astype(float) / voxel_size
    groups = rows_by(np.floor(x * CELLS).astype(int))
    means = np.array([x[rows].mean(axis=0) for rows in groups.values()])
    counts = np.array([len(rows) for rows in groups.values()], float)
    height, width, channels = values.shape
    flat = values.reshape(-1, channels).astype(float)
    pixels = find_pixels(
        means * voxel_size, projection, width, height, np.isfinite(flat).all(axis=1)
    )
    seen = pixels >= 0
    return (
        np.array(list(groups))[seen],
        counts[seen],
        flat[pixels[seen]],
        len(np.unique(pixels[seen])) / counts[seen].sum(),
    )


def fuse_features(encoder, frames, minimum, margin):
    """Voxel -> (f (N, q), weights (N,), features (N, c)) over frames, each a result of
    `seen_cells`.
    """
    gathered = {}
    for lattice, counts, features, scale in frames:
        for key, own in rows_by(lattice // CELLS).items():
            if counts[own].sum() >= minimum:
                offset = lattice - CELLS * np.array(key)
                near = ((offset >= -margin) & (offset < CELLS + margin)).all(axis=1)
                t = ((offset[near] + 0.5) / CELLS - 0.5) / 2
                gathered.setdefault(key, []).append(
                    (encoder(t)[:, 1:], counts[near] * scale, features[near])
                )
    return {
        key: tuple(np.concatenate(column) for column in zip(*parts, strict=True))
        for key, parts in gathered.items()
    }


def solve_rows(f, weights, products, noise):
    """Constant and coefficients (1 + q, T) of the ridge regression of products (N, T) about their
    mean.
    """
    mean_f, mean = weights @ f / weights.sum(), weights @ products / weights.sum()
    centered = f - mean_f
    gram = (centered.T * weights) @ centered
    F = np.linalg.solve(
        gram + noise * np.eye(f.shape[1]), (centered.T * weights) @ (products - mean)
    )
    return np.vstack([mean - mean_f @ F, F])


def query_products(encoder, solved, x):
    """Values (N, T) and validity (N,) at points x (N, 3), from voxel -> constants and coefficients."""
    width = next(iter(solved.values())).shape[1]
    values, valid = np.zeros((len(x), width)), np.zeros(len(x), bool)
    for n, point in enumerate(x):
        weight = 0.0
        for key in map(tuple, (np.floor(point - 0.5).astype(int) + CORNERS).tolist()):
            if key in solved:
                t = (point - key - 0.5) / 2
                tent = max(np.prod(1 - 2 * np.abs(t)), 1e-6)
                f = encoder(t[None])[0, 1:]
                values[n] += tent * (solved[key][0] + f @ solved[key][1:])
                weight += tent
        if weight > 0:
            values[n], valid[n] = values[n] / weight, True
    return values, valid


def fuse_voxels(mean_f_a, mean_a, slopes_a, weight_a, mean_f_b, mean_b, slopes_b, weight_b):
    """Mean and slopes (covariances with f) of what two voxels saw together, from the plain sums of
    products (Eq. 19).
    """
    total = weight_a + weight_b
    mean_f, mean = (
        (a * weight_a + b * weight_b) / total for a, b in ((mean_f_a, mean_f_b), (mean_a, mean_b))
    )
    products = (
        (slopes_a + np.outer(mean_f_a, mean_a)) * weight_a
        + (slopes_b + np.outer(mean_f_b, mean_b)) * weight_b
    ) / total
    return mean, products - np.outer(mean_f, mean)


def decoded_rows(means, slopes, scales):
    """Mean and slopes (S, 1 + q, c) as numbers."""
    slopes = slopes.reshape(*scales.shape, -1) * scales[..., None].astype(float)
    return np.concatenate([means[:, None].astype(float), slopes], axis=1)


def project_rows(means, slopes, scales, directions):
    """Products (S, 1 + q, T)."""
    return np.einsum("src,tc->srt", decoded_rows(means, slopes, scales), directions)


def take_channels(means, slopes, scales, first, count):
    """(S, 1 + q, count)."""
    return decoded_rows(means, slopes, scales)[:, :, first : first + count]


def mean_lengths(means):
    """Length (S,) of the means."""
    return np.linalg.norm(means.astype(float), axis=1)
