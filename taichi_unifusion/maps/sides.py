"""Whether voxels see surface from two sides, of boards thinner than they can keep apart."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

# points of a voxel, from its centre [voxels]: the centre, and towards the corners
LOOKED_AT = 0.35 * np.array([(0, 0, 0), *product((-1, 1), repeat=3)])


@dataclass(frozen=True)
class Sides:
    """How often voxels were seen again, and how often from the other side."""

    seen: int
    opposite: int

    def __add__(self, other: Sides) -> Sides:
        return Sides(self.seen + other.seen, self.opposite + other.opposite)
