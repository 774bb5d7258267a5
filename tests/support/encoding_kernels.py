"""Kernels around the functions of the position encoding, which other kernels have inlined."""

import taichi as ti

from taichi_unifusion.kernels.arrays import Floats2, Floats3
from taichi_unifusion.kernels.encoding import (
    position_features,
    position_gradient,
    table_features,
)


@ti.kernel
def encode_positions(
    # in:
    rank: ti.template(),
    t: Floats2,  # (N, 3)
    anchors: Floats2,  # (3, A)
    projection: Floats2,  # (l, A)
    scale: ti.f32,
    # out:
    features: Floats2,  # (N, l)
):
    for n in range(t.shape[0]):
        f = position_features(
            ti.Vector([t[n, 0], t[n, 1], t[n, 2]]), rank, anchors, projection, scale
        )
        for i in ti.static(range(rank)):
            features[n, i] = f[i]


@ti.kernel
def interpolate_positions(
    # in:
    rank: ti.template(),
    t: Floats2,  # (N, 3)
    table: Floats2,  # (nodes^3, l)
    nodes: ti.i32,
    # out:
    features: Floats2,  # (N, l)
):
    for n in range(t.shape[0]):
        f = table_features(ti.Vector([t[n, 0], t[n, 1], t[n, 2]]), rank, table, nodes)
        for i in ti.static(range(rank)):
            features[n, i] = f[i]


@ti.kernel
def encode_gradients(
    # in:
    rank: ti.template(),
    t: Floats2,  # (N, 3)
    anchors: Floats2,  # (3, A)
    projection: Floats2,  # (l, A)
    scale: ti.f32,
    # out:
    gradients: Floats3,  # (N, 3, l)
):
    for n in range(t.shape[0]):
        for axis in range(3):
            g = position_gradient(
                ti.Vector([t[n, 0], t[n, 1], t[n, 2]]), axis, rank, anchors, projection, scale
            )
            for i in ti.static(range(rank)):
                gradients[n, axis, i] = g[i]
