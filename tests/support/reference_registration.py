"""Slow float64 NumPy twins of the registration kernels, written from Park et al. 2017 and for
reading only.
"""

from __future__ import annotations

from itertools import product

import numpy as np

DEPTH, NORMAL, INTENSITY, SLOPE_U, SLOPE_V, CHANNELS = 0, slice(1, 4), 4, 5, 6, 8
FREEDOM, LEAST_SLOPE, NEAR, UNSEEN = 5.0, 0.012, 0.05, 1e9


def average_inverse_depth(inverse, factor, jump):
    """Mean over the nearest surface of every block, 0 where that fills less than half of it."""
    height, width = (n // factor for n in inverse.shape)
    averaged = np.zeros((height, width))
    for v, u in product(range(height), range(width)):
        block = inverse[v * factor : (v + 1) * factor, u * factor : (u + 1) * factor].astype(float)
        near = block[(block > 0) & (block.max() - block <= jump * block.max())]
        if 2 * near.size >= block.size:
            averaged[v, u] = near.mean()
    return averaged


def average_color(color, factor):
    """Rec. 601 luma in [0, 1], mean over blocks."""
    return average(color.astype(float) @ (0.299, 0.587, 0.114) / 255, factor)


def average_intensity(intensity):
    return average(intensity.astype(float), 2)


def average(image, factor):
    height, width = (n // factor for n in image.shape)
    return (
        image[: height * factor, : width * factor]
        .reshape(height, factor, width, factor)
        .mean(axis=(1, 3))
    )


def pack_surfels(inverse, normals, intensity):
    """(H, W, CHANNELS); Sobel slopes inside, zero at the border."""
    image = intensity.astype(float)
    surfels = np.zeros((*inverse.shape, CHANNELS))
    known = (inverse > 0) & (normals[..., 2] != 0)
    surfels[known, DEPTH] = 1 / inverse[known].astype(float)
    surfels[..., NORMAL], surfels[..., INTENSITY] = normals, image
    smooth = np.array([0.25, 0.5, 0.25])
    for v, u in product(range(1, image.shape[0] - 1), range(1, image.shape[1] - 1)):
        patch = image[v - 1 : v + 2, u - 1 : u + 2]
        surfels[v, u, SLOPE_U] = smooth @ (patch[:, 2] - patch[:, 0]) / 2
        surfels[v, u, SLOPE_V] = smooth @ (patch[2] - patch[0]) / 2
    return surfels


def axial_variance(z):
    """Nguyen et al. 2012, Eq. 3."""
    return (0.0012 + 0.0019 * (z - 0.4) ** 2) ** 2


def unprojected(u, v, z, K):
    return np.array([(u - K[2]) / K[0] * z, (v - K[3]) / K[1] * z, z])


def sum_normal_equations(
    source, target, K_source, K_target, T, step, gate, cosine, width, sigma, weight
):
    """H (6, 6), b (6,), and counts: source, in view, inliers, squared distance, coloured,
    photometric scale.
    """
    H, b, counts = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    for v, u in product(range(0, source.shape[0], step), range(0, source.shape[1], step)):
        z = source[v, u, DEPTH]
        if z <= 0:
            continue
        counts[0] += 1
        p = T[:3, :3] @ unprojected(u, v, z, K_source) + T[:3, 3]
        if p[2] <= NEAR:
            continue
        x, y = K_target[0] * p[0] / p[2] + K_target[2], K_target[1] * p[1] / p[2] + K_target[3]
        if not (0 <= x <= target.shape[1] - 1 and 0 <= y <= target.shape[0] - 1):
            continue
        j, i = int(x + 0.5), int(y + 0.5)
        depth, n = target[i, j, DEPTH], target[i, j, NORMAL]
        if depth <= 0:
            continue
        counts[1] += 1
        r = n @ (p - unprojected(j, i, depth, K_target))
        if abs(r) >= gate or n @ T[:3, :3] @ source[v, u, NORMAL] <= cosine:
            continue
        counts[2:4] += 1, r * r
        w = 1 / (axial_variance(depth) + axial_variance(z))
        w /= 1 + r * r * w / width**2
        rows = [(w, np.concatenate([n, np.cross(p, n)]), r)]
        slope = target[i, j, [SLOPE_U, SLOPE_V]]
        if weight > 0 and slope @ slope > LEAST_SLOPE**2:
            e = target[i, j, INTENSITY] + slope @ (x - j, y - i) - source[v, u, INTENSITY]
            projection = (
                np.array(
                    [[K_target[0], 0, -(x - K_target[2])], [0, K_target[1], -(y - K_target[3])]]
                )
                / p[2]
            )
            g = slope @ projection
            t = (FREEDOM + 1) / (FREEDOM + (e / sigma) ** 2)
            counts[4:] += 1, t * e * e
            rows.append((t * weight / sigma**2, np.concatenate([g, np.cross(p, g)]), e))
        for scale, row, residual in rows:
            H += scale * np.outer(row, row)
            b += scale * row * residual
    return H, b, counts


def leave_out(moving, surfels):
    """Depths below 0 where the mask, of any size, says so."""
    kept = surfels.copy()
    for v, u in product(range(surfels.shape[0]), range(surfels.shape[1])):
        i, j = v * moving.shape[0] // surfels.shape[0], u * moving.shape[1] // surfels.shape[1]
        kept[v, u, DEPTH] = abs(surfels[v, u, DEPTH]) * (-1 if moving[i, j] else 1)
    return kept


def read_surfels(surfels, step, channels):
    """The first channels of every step-th pixel and row."""
    return surfels[::step, ::step, :channels]


def compare_surfels(source, target, K_source, K_target, T, step):
    """(h / step, w / step, 3): how far in front [standard deviations], how much darker, slope."""
    height, width = (-(-n // step) for n in source.shape[:2])
    compared = np.zeros((height, width, 3))
    compared[..., 0] = UNSEEN
    for row, column in product(range(height), range(width)):
        v, u = row * step, column * step
        z = abs(source[v, u, DEPTH])
        p = T[:3, :3] @ unprojected(u, v, z, K_source) + T[:3, 3]
        if z == 0 or p[2] <= NEAR:
            continue
        x, y = K_target[0] * p[0] / p[2] + K_target[2], K_target[1] * p[1] / p[2] + K_target[3]
        if not (0 <= x <= target.shape[1] - 1 and 0 <= y <= target.shape[0] - 1):
            continue
        j, i = int(x + 0.5), int(y + 0.5)
        depth, n = target[i, j, DEPTH], target[i, j, NORMAL]
        if depth <= 0:
            continue
        slope = target[i, j, [SLOPE_U, SLOPE_V]]
        r = n @ (p - unprojected(j, i, depth, K_target))
        compared[row, column] = (
            r / np.sqrt(axial_variance(depth) + axial_variance(z)),
            target[i, j, INTENSITY] + slope @ (x - j, y - i) - source[v, u, INTENSITY],
            np.abs(slope).sum(),
        )
    return compared
