"""Slow float64 twins of what keeps windows, and of the exact sums that let them be taken out."""

from __future__ import annotations

import numpy as np

FIXED = 2.0**24


def count_cells(sums):
    """(B,) cells that hold points."""
    return (sums[:, :, 0] > 0).sum(axis=1)


def gather_cells(sums):
    """Cell, count and means (M, c) of every cell that holds points."""
    b, cell = np.nonzero(sums[:, :, 0])
    counts = sums[b, cell, 0]
    return cell, counts, sums[b, cell, 1:] / counts[:, None] / FIXED


def scatter_cells(sums, blocks, places, rows):
    """Sums with some cells replaced."""
    after = sums.copy()
    after[blocks, places] = rows
    return after


def mark_points(voxels, points, bits, voxel_size):
    """(B,) for every voxel the bits of all points in it."""
    at = np.floor(points / voxel_size).astype(int)
    return np.array([np.bitwise_or.reduce(bits[(at == v).all(axis=1)], initial=0) for v in voxels])


def shrink_depth(images, step, per_meter):
    units = np.floor(images[:, ::step, ::step].astype(float) * per_meter + 0.5)
    return np.where(images[:, ::step, ::step] > 0, np.clip(units, 1, 65535), 0)


def round_rows(rows, weights, per_unit):
    return np.rint(rows.astype(float) * per_unit) / per_unit, np.rint(weights)


def fuse_exactly(parts, signs):
    """F and w of some local LIMs (F', w'), each taken in (1) or out (-1); 0 where nothing is left."""
    total = sum(sign * w for (_, w), sign in zip(parts, signs, strict=True))
    summed = sum(sign * w * F for (F, w), sign in zip(parts, signs, strict=True))
    return (summed / total if total > 0 else summed * 0), total


def count_support(parts, signs):
    """(64,) cells that are supported by some of the masks (64,), each taken in or out."""
    return sum(sign * mask.astype(int) for mask, sign in zip(parts, signs, strict=True)) > 0
