"""Which side the surface in a voxel was seen from: in a window, and in the windows before."""

import taichi as ti

from .arrays import Floats1, Floats3, Ints1, Ints2, row3
from .index import find

CLEAR = 0.5  # slope of a field that has a surface: 1 is a distance
OPPOSITE = -0.7  # cosine between normals that face away from each other


@ti.func
def steepest(rank: ti.template(), v: ti.i32, latents: ti.template(), slopes: ti.template()):
    """The steepest slope by voxel units of field v, of those at some points of a voxel: the normal
    where its surface is, if it has any.
    """
    best = ti.Vector([0.0, 0.0, 0.0])
    for point in range(slopes.shape[0]):
        slope = ti.Vector([0.0, 0.0, 0.0])
        for a in range(rank):
            for d in ti.static(range(3)):
                slope[d] += slopes[point, d, a] * latents[v, a, 0]
        if slope.norm_sqr() > best.norm_sqr():
            best = slope
    return best


@ti.kernel
def count_sides(
    # in:
    rank: ti.template(),
    voxels: ti.i32,
    keys: Ints2,  # (B, 3 or more) of a local LIM
    weights: Floats1,  # (B,) 0: not encoded
    encoded: Floats3,  # (B, l or more, 1) F'
    index: ti.template(),
    latents: Floats3,  # (S, l or more, 1) F of the map
    slopes: Floats3,  # (P, 3, l) gradient of f_posi by voxel units at P points of a voxel
    # in and out:
    counts: Ints1,  # (2,) += [voxels that both have a clear surface in, those whose normals are opposite]
):
    for b in range(voxels):
        if weights[b] > 0:
            s = find(index, row3(keys, b))
            if s >= 0:
                before, after = (
                    steepest(rank, s, latents, slopes),
                    steepest(rank, b, encoded, slopes),
                )
                steep = before.norm(), after.norm()
                if steep[0] > CLEAR and steep[1] > CLEAR:
                    ti.atomic_add(counts[0], 1)
                    if before.dot(after) < OPPOSITE * steep[0] * steep[1]:
                        ti.atomic_add(counts[1], 1)
