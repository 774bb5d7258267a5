"""f_posi and its derivatives at any point of the doubled voxel (Eq. 9-14)."""

import taichi as ti

from .voxels import Floats2

LOG2_E = 1.4426950408889634


@ti.func
def exp_negative(s: ti.f32) -> ti.f32:
    """exp(-s) for 0 <= s < 80, relative error below 2e-7, in arithmetic that vectorises (unlike
    ti.exp).
    """
    y = -s * LOG2_E
    whole = ti.floor(y)
    f = y - whole
    power = 1.0 + f * (
        0.6931471806
        + f
        * (
            0.2402264923
            + f
            * (
                0.0555033116
                + f * (0.0096181291 + f * (0.0013333558 + f * (0.000154353 + f * 1.52527e-5)))
            )
        )
    )
    return power * ti.bit_cast((ti.cast(whole, ti.i32) + 127) << 23, ti.f32)


@ti.func
def position_features(
    # in:
    t: ti.template(),  # encoder coordinates in [-0.5, 0.5]^3
    rank: ti.template(),
    anchors: ti.template(),  # (3, A), scaled by sqrt(7) / length scale
    projection: ti.template(),  # (l, A)
    scale: ti.f32,  # sqrt(7) / length scale
):
    """f_posi(t), a vector of length `rank`."""
    f = ti.Vector([0.0] * rank)
    u = t * scale
    for a in range(anchors.shape[1]):
        x, y, z = u[0] - anchors[0, a], u[1] - anchors[1, a], u[2] - anchors[2, a]
        s = ti.sqrt(x * x + y * y + z * z)
        k = (1.0 + s * (1.0 + s * (0.4 + s * (1.0 / 15.0)))) * exp_negative(s)
        for i in ti.static(range(rank)):
            f[i] += k * projection[i, a]
    return f


@ti.func
def position_gradient(
    # in: as position_features
    t: ti.template(),
    axis: ti.i32,
    rank: ti.template(),
    anchors: ti.template(),
    projection: ti.template(),
    scale: ti.f32,
):
    """d f_posi / d t_axis, a vector of length `rank`: k'(s) / s = -(1/5 + s/5 + s^2/15) e^-s, times
    the offset.
    """
    g = ti.Vector([0.0] * rank)
    u = t * scale
    for a in range(anchors.shape[1]):
        x, y, z = u[0] - anchors[0, a], u[1] - anchors[1, a], u[2] - anchors[2, a]
        s = ti.sqrt(x * x + y * y + z * z)
        along = u[axis] - anchors[axis, a]
        slope = -(0.2 + s * (0.2 + s * (1.0 / 15.0))) * exp_negative(s) * along * scale
        for i in ti.static(range(rank)):
            g[i] += slope * projection[i, a]
    return g


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
def encode_gradients(
    # in:
    rank: ti.template(),
    t: Floats2,  # (N, 3)
    anchors: Floats2,
    projection: Floats2,
    scale: ti.f32,
    # out:
    gradients: ti.types.ndarray(dtype=ti.f32, ndim=3),  # (N, 3, l)
):
    for n in range(t.shape[0]):
        for axis in range(3):
            g = position_gradient(
                ti.Vector([t[n, 0], t[n, 1], t[n, 2]]), axis, rank, anchors, projection, scale
            )
            for i in ti.static(range(rank)):
                gradients[n, axis, i] = g[i]
