"""Slow float64 twins of information fusion: the regression of a voxel over the samples of all
frames (Eq. 6).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import reference
from reference import Voxel


@dataclass
class Samples:
    P: np.ndarray  # (n, l) features
    W: np.ndarray  # (n,) points behind each
    Y: np.ndarray  # (n, c) targets
    points: float  # points in all, which is less than W's sum where normals are targets too
    centered: bool  # a prior mean


@dataclass
class Sums:
    G: np.ndarray  # (l, l) P^T W P
    r: np.ndarray  # (l, c [+ 1]) P^T W Y, and P^T W 1 for a prior mean
    mean: np.ndarray  # (c,) Y^T W 1
    w: float


def samples_of_voxel(encoder, t, counts, targets, normals, noise, centered):
    """What `reference.encode_voxel` regresses over."""
    P, W, Y = reference.with_slopes(encoder, t, encoder(t), counts, targets, normals)
    return Samples(P, W, Y, counts.sum(), centered)


def surface_samples(encoder, x, normals, settings):
    """As `reference.surface_frame`, with samples in the place of latents."""
    return reference.surface_frame(encoder, x, normals, settings, encode=samples_of_voxel)


def property_samples(encoder, x, values, settings):
    return reference.property_frame(encoder, x, values, settings, encode=samples_of_voxel)


def regress_all(frames, noise):
    """Voxel -> the regression over the samples of all frames that encode it; no sums in between."""
    fused = {}
    for key in set().union(*frames):
        parts = [frame[key] for frame in frames if key in frame]
        P, W, Y = (np.concatenate([getattr(part.F, name) for part in parts]) for name in "PWY")
        mean = (W @ Y / W.sum())[None] if parts[0].F.centered else np.zeros((1, Y.shape[1]))
        F = reference.regress(P, W, Y - mean, noise)
        mask = np.any([part.mask for part in parts], axis=0)
        fused[key] = Voxel(
            np.vstack([F, mean]) if parts[0].F.centered else F,
            sum(part.F.points for part in parts),
            mask,
        )
    return fused


def keep_sums(P, W, Y, centered):
    targets = np.column_stack([Y, np.ones(len(Y))]) if centered else Y
    return Sums(P.T @ (W[:, None] * P), P.T @ (W[:, None] * targets), W @ Y, W.sum())


def fuse_information(parts, signs, noise):
    """F and w from the sums of some frames, each taken in (1) or out (-1)."""
    G, r, mean, w = (
        sum(sign * getattr(part, name) for part, sign in zip(parts, signs, strict=True))
        for name in ("G", "r", "mean", "w")
    )
    if r.shape[1] == len(mean):
        return np.linalg.solve(G + noise * np.eye(len(G)), r), w
    F = np.linalg.solve(G + noise * np.eye(len(G)), r[:, :-1] - np.outer(r[:, -1], mean / w))
    return np.vstack([F, mean / w]), w
