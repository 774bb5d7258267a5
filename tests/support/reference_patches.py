"""Slow float64 twins of the front end: depth image -> patches of up to 2 x 2 pixels (Sec. IV-B)."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

import numpy as np
from reference import inverse_depth_slope, normal_towards_camera, transform

QUAD = tuple(product(range(2), repeat=2))  # row and column of its pixels


@dataclass
class Patch:
    quad: int  # row by row
    normal: np.ndarray  # (3,) world
    pixels: list[int] = field(default_factory=list)  # of 0..3 in the quad
    points: list[np.ndarray] = field(default_factory=list)  # (3,) camera [m] of each
    halves: list[int] = field(default_factory=list)  # of a pixel that each counts
    black: int = 0  # of its quad, as on a chessboard

    @property
    def count(self) -> int:
        """Pixels; half a one that is left over counts in patches whose first pixel is on a black field."""
        field = self.black + sum(QUAD[self.pixels[0]])
        return (sum(self.halves) + field % 2) // 2

    @property
    def place(self) -> int:
        return 16 * self.quad + sum(1 << p for p in self.pixels)


def clip_and_invert(depth, low, high, farthest):
    """Readings (H, W) in `low`..`farthest`, and the inverses of those up to `high`; 0 elsewhere."""
    with np.errstate(invalid="ignore", divide="ignore"):
        readings = np.where(
            np.isfinite(depth) & (depth >= np.float32(low)) & (depth <= np.float32(farthest)),
            depth,
            np.float32(0),
        )
        usable = (readings > 0) & (readings <= np.float32(high))
        return readings, np.where(usable, 1 / readings.astype(float), 0.0)


def make_patches(inverse, K, T_world_camera, radius, jump, cos_max_angle, least, weights=None):
    """The patches of an image of inverse depths, quad by quad, without those that count nothing.

    A pixel joins the patch of its quad if it lies on the same surface and is far enough away that
    pixels are coarse (`least`); else it begins another one, where it has a normal.
    """
    fx, fy, cx, cy = K
    height, width = inverse.shape
    found = []
    across = (width + 1) // 2
    for quad in range((height + 1) // 2 * across):
        top, left = 2 * (quad // across), 2 * (quad % across)
        fitted_at, known, patch = 0.0, False, None
        for p, (dv, du) in enumerate(QUAD):
            v, u = top + dv, left + du
            if v >= height or u >= width or inverse[v, u] == 0:
                continue
            q = inverse[v, u]
            other = abs(q - fitted_at) > 0.5 * jump * q
            if other or not known:
                fitted_at = q
                *slopes, known = inverse_depth_slope(inverse, v, u, radius, jump)
            if other or q < least:
                patch = None
            if patch is None and known:
                normal = normal_towards_camera(q, slopes, v, u, *K, cos_max_angle)
                if normal is not None:
                    patch = Patch(quad, T_world_camera[:3, :3] @ normal)
                    patch.black = quad // across + quad % across
                    found.append(patch)
            if patch is not None:
                patch.pixels.append(p)
                patch.points.append(np.array([(u - cx) / fx, (v - cy) / fy, 1]) / q)
                patch.halves.append(2 if weights is None else int(weights[v, u]))
    return [patch for patch in found if patch.count]


def position(patch, T_world_camera):
    """Mean of a patch's pixels (3,) world [m]."""
    return transform(np.average(patch.points, axis=0, weights=patch.halves), T_world_camera)


def pixels_of(place, width):
    """Rows and columns of the pixels that a place names."""
    across = (width + 1) // 2
    quad, bits = place // 16, place % 16
    return [
        (2 * (quad // across) + dv, 2 * (quad % across) + du)
        for p, (dv, du) in enumerate(QUAD)
        if bits >> p & 1
    ]


def average_color(places, color):
    """(N, 3) in [0, 1], mean over the pixels of each place."""
    return np.array(
        [np.mean([color[at] / 255 for at in pixels_of(n, color.shape[1])], axis=0) for n in places]
    )


def average_image(places, sizes, image):
    """(N, c) mean over the pixels of each place whose values are all finite, and (N,) their share of its
    size; 0 where there is none.
    """
    values, counts = np.zeros((len(places), image.shape[2])), np.zeros(len(places), int)
    for n, place in enumerate(places):
        seen = [image[at].astype(float) for at in pixels_of(place, image.shape[1])]
        finite = [value for value in seen if np.isfinite(value).all()]
        counts[n] = sizes[n] * len(finite) // len(seen)
        if finite:
            values[n] = np.mean(finite, axis=0)
    return values, counts
