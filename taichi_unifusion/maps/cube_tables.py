"""Which triangles marching cubes puts into a cell, built from the cell's faces (Lorensen and Cline)."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

STEPS = np.array(list(product((0, 1), repeat=3)))  # (8, 3) corners of a cube, x slowest


@lru_cache(maxsize=1)
def marching_cubes_tables() -> tuple[NDArray[np.int32], ...]:
    """Triangles of the 256 cases: counts (256,), edge flags (256,), edges (256, 15), and the edges'
    corner and axis (12, 4).

    Built, not copied: on every face of the cell, segments keep the corners behind the surface
    together on their own side (also on ambiguous faces, so that neighbours agree); the segments
    close to loops, and each loop becomes a fan. Triangles are counter-clockwise seen from in front
    of the surface.
    """
    edges = [(o, d) for d in range(3) for o in range(8) if not STEPS[o][d]]  # lower corner, axis
    edge_of = {frozenset((o, o + (4 >> d))): e for e, (o, d) in enumerate(edges)}
    counts, flags, table = (
        np.zeros(256, np.int32),
        np.zeros(256, np.int32),
        np.zeros((256, 15), np.int32),
    )
    for case in range(256):
        follow = {}
        for corners in _faces():
            behind = [case >> o & 1 for o in corners]
            # a segment enters where the walk goes behind the surface and leaves where it comes out
            # next
            for k in range(4):
                if not behind[k] and behind[(k + 1) % 4]:
                    out = next(
                        j for j in range(k + 1, k + 5) if behind[j % 4] and not behind[(j + 1) % 4]
                    )
                    follow[edge_of[frozenset((corners[k], corners[(k + 1) % 4]))]] = edge_of[
                        frozenset((corners[out % 4], corners[(out + 1) % 4]))
                    ]
        triangles = []
        while follow:
            loop = [next(iter(follow))]
            while (after := follow.pop(loop[-1])) != loop[0]:
                loop.append(after)
            triangles += [(loop[0], loop[k], loop[k + 1]) for k in range(1, len(loop) - 1)]
        counts[case] = len(triangles)
        flat = [e for triangle in triangles for e in triangle]
        flags[case] = sum(1 << e for e in set(flat))
        table[case, : len(flat)] = flat
    return counts, flags, table, np.array([[*STEPS[o], d] for o, d in edges], np.int32)


def _faces() -> list[list[int]]:
    """The cell's six faces as corner cycles, counter-clockwise seen from outside."""
    faces = []
    for d in range(3):
        u, v = (d + 1) % 3, (d + 2) % 3
        square = [
            sum(4 >> a for a, on in ((u, i), (v, j)) if on)
            for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))
        ]
        faces += [[o + (4 >> d) for o in square], square[::-1]]
    return faces
