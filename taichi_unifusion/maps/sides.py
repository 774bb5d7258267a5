"""Whether voxels see surface from two sides, of boards thinner than they can keep apart."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

CLEAR = 0.5  # slope of a field that has a surface: 1 is a distance
# points of a voxel, from its centre [voxels]: the centre, and towards the corners
LOOKED_AT = 0.35 * np.array([(0, 0, 0), *product((-1, 1), repeat=3)])
OPPOSITE = -0.7  # cosine between normals that face away from each other


@dataclass(frozen=True)
class Sides:
    """How often voxels were seen again, and how often from the other side."""

    seen: int
    opposite: int

    def __add__(self, other: Sides) -> Sides:
        return Sides(self.seen + other.seen, self.opposite + other.opposite)


def steepest(latents: NDArray, slopes: NDArray) -> NDArray[np.float32]:
    """The steepest slope (N, 3) by voxel units of fields (N, l), of those at some points of a voxel: the
    normal where its surface is, if it has any.
    """
    points, _, rank = slopes.shape
    fields = (latents @ slopes.reshape(-1, rank).T.astype(np.float32)).reshape(-1, points, 3)
    best = np.linalg.norm(fields, axis=2).argmax(axis=1) if len(fields) else np.zeros(0, int)
    return fields[np.arange(len(fields)), best]


def count_sides(before: NDArray, after: NDArray) -> Sides:
    """How many of the voxels whose fields' steepest slopes (N, 3) by voxel units are clear, before and in
    a window, face the other way.
    """
    steep = [np.linalg.norm(each, axis=1) for each in (before, after)]
    both = (steep[0] > CLEAR) & (steep[1] > CLEAR)
    cosine = np.einsum("ni,ni->n", before, after) / np.maximum(steep[0] * steep[1], 1e-9)
    return Sides(int(both.sum()), int((both & (cosine < OPPOSITE)).sum()))
