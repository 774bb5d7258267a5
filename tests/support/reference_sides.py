"""Twins of `kernels/sides.py`: the two sides of boards, in float64."""

from __future__ import annotations

import numpy as np

OPPOSITE, STEEP = -0.5, 0.3


def mean_slopes(encoder):
    """(3, l): mean gradient of f_posi over a voxel, by voxel units."""
    axis = (np.arange(4) + 0.5) / 8 - 0.25  # a voxel is the inner half of its doubled voxel
    t = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return 0.5 * encoder.gradient(t).mean(axis=0)


def weigh_sides(lean, F, weights):
    """Weights (B, 2) of the local LIMs F (B, l) as fronts and as backs, which lean backwards."""
    back = F @ lean < 0
    return np.column_stack([np.where(back, 0.0, weights), np.where(back, weights, 0.0)])


def fuse_sides(parts):
    """Mean (l,) of backs, and weights of fronts and backs: parts are (F', (w', w'), sign)."""
    front, back = (sum(sign * w[side] for _, w, sign in parts) for side in (0, 1))
    total = sum(sign * w[1] * F for F, w, sign in parts)
    mean = total / back if back > 0.5 else 0 * total
    return mean, [weight if weight > 0.5 else 0.0 for weight in (front, back)]


def note_support(masks):
    """Cells that any of some masks (K, 64) supports."""
    return np.any(masks, axis=0)


def part_sides(encoder, F, back, front_weight, back_weight):
    """Whether a voxel has two sides, and the latent of its front: what is left of F without the back."""
    if min(front_weight, back_weight) <= 0.5:
        return False, F
    front, slopes = (
        (F * (front_weight + back_weight) - back * back_weight) / front_weight,
        mean_slopes(encoder),
    )
    g, h = slopes @ front, slopes @ back
    lengths = np.linalg.norm(g), np.linalg.norm(h)
    two = min(lengths) > STEEP and g @ h < OPPOSITE * lengths[0] * lengths[1]
    return bool(two), front if two else F


def find_sides(encoder, F, backs, side_weights):
    """For each voxel whether it has two sides, and the latent of its front, or F."""
    rows = [part_sides(encoder, *each, *w) for *each, w in zip(F, backs, side_weights, strict=True)]
    return np.array([two for two, _ in rows]), np.array([front for _, front in rows])
