"""How cameras and poses reach a kernel, both by value, and what is computed of them in float32.

Pixel centres lie at integers. Where a pixel's centre must not change sides by rounding, as when
triangles are drawn, a kernel takes a float64 projection matrix instead.
"""

import taichi as ti

Intrinsics = ti.types.vector(4, ti.f32)  # fx, fy, cx, cy [px]; give PinholeCamera.intrinsics
Pose = ti.types.matrix(3, 4, ti.f32)  # T_a_b without its last row; give T_a_b[:3]


@ti.func
def ray(u: ti.f32, v: ti.f32, K: ti.template()):
    """The direction of pixel (u, v), with z = 1."""
    return ti.Vector([(u - K[2]) / K[0], (v - K[3]) / K[1], 1.0])


@ti.func
def lift(u: ti.f32, v: ti.f32, z: ti.f32, K: ti.template()):
    """The point at depth z [m] of pixel (u, v)."""
    return ti.Vector([(u - K[2]) / K[0] * z, (v - K[3]) / K[1] * z, z])


@ti.func
def project(p: ti.template(), K: ti.template()):
    """Column and row of a point p in the camera frame, which lies in front of it."""
    return K[0] * p[0] / p[2] + K[2], K[1] * p[1] / p[2] + K[3]


@ti.func
def rotate(T_a_b: ti.template(), direction: ti.template()):
    """A direction in b, in a."""
    return T_a_b[:3, :3] @ direction


@ti.func
def move(T_a_b: ti.template(), p: ti.template()):
    """A point in b, in a."""
    return T_a_b[:3, :3] @ p + T_a_b[:, 3]
