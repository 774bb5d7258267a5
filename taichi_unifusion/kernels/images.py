"""Preprocessing on the image grid, and rigid motion.

Real depth holds NaN, infinity and negatives; they are recognised by their bits, because fast math
may drop a test for NaN.
"""

import taichi as ti

from .arrays import Floats2, Floats3, row3
from .camera import Intrinsics, Pose, move, ray

NARROW_PAIRS = 4  # of direct neighbours, that say as much as one pair at radius 2


def segment_length() -> int:
    """Pixels of a row that one task takes: on the CPU a loop over single pixels spends 15 ns on
    each for finding out which one it is, and whole rows are too few to share out.
    """
    return 80 if ti.lang.impl.current_cfg().arch in (ti.x64, ti.arm64) else 1


@ti.func
def segments(width: ti.i32) -> ti.i32:
    """How many segments a row has."""
    return (width + ti.static(segment_length()) - 1) // ti.static(segment_length())


@ti.func
def segment(part: ti.i32, width: ti.i32):
    """Row, first pixel and end of segment `part` of an image."""
    v, first = part // segments(width), part % segments(width) * ti.static(segment_length())
    return v, first, ti.min(first + ti.static(segment_length()), width)


@ti.kernel
def clip_depth(
    # in:
    depth: Floats2,  # (H, W) [m], with any values
    depth_min: ti.f32,
    depth_max: ti.f32,
    # out:
    clipped: Floats2,  # (H, W) [m], 0 where there is no reading in range
):
    low, high = ti.bit_cast(depth_min, ti.i32), ti.bit_cast(depth_max, ti.i32)
    height, width = depth.shape[0], depth.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            # ordered as positive floats are; NaN and inf lie above, negatives below
            bits = ti.bit_cast(depth[v, u], ti.i32)
            clipped[v, u] = depth[v, u] if bits >= low and bits <= high else 0.0


@ti.kernel
def drop_flying_pixels(
    # in:
    depth: Floats2,  # (H, W) [m], 0: none
    jump: ti.f32,  # pixels whose depths differ by at most this share lie on one surface
    support: ti.i32,  # how many of its 8 neighbours must lie on a pixel's surface
    # out:
    inverse: Floats2,  # (H, W) [1/m], 0 where there is no reading or a flying pixel
):
    height, width = depth.shape[0], depth.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            z = depth[v, u]
            close = 0
            if z > 0 and v > 0 and u > 0 and v < height - 1 and u < width - 1:
                for dv, du in ti.static(ti.ndrange((-1, 2), (-1, 2))):
                    if ti.static(dv != 0 or du != 0):
                        close += ti.cast(ti.abs(depth[v + dv, u + du] - z) <= jump * z, ti.i32)
            inverse[v, u] = 1.0 / z if z > 0 and close >= support else 0.0


@ti.func
def slope_along(
    inverse: ti.template(),
    v: ti.i32,
    u: ti.i32,
    dv: ti.i32,
    du: ti.i32,
    step: ti.i32,
    radius: ti.template(),
    near: ti.f32,
):
    """Mean slope of 1/z along (dv, du), from pairs of pixels `step` to both sides of a line through
    (v, u) across it, all on its surface; and how many pairs.
    """
    q, along, pairs = inverse[v, u], 0.0, 0.0
    for i in range(-radius, radius + 1):
        # across the direction is (du, dv)
        row, column = v + i * du, u + i * dv
        ahead = inverse[row + step * dv, column + step * du]
        behind = inverse[row - step * dv, column - step * du]
        together = ti.max(ti.abs(ahead - q), ti.abs(behind - q)) < near
        along += ti.select(together, ahead - behind, 0.0)
        pairs += ti.select(together, 1.0, 0.0)
    return along / (2.0 * step * ti.max(pairs, 1.0)), pairs


@ti.func
def inverse_depth_slope(
    inverse: ti.template(), v: ti.i32, u: ti.i32, radius: ti.template(), jump: ti.f32
):
    """Slopes of 1/z by u and v in a window around (v, u), and whether they are known.

    A plane has an inverse depth that is linear in the image. Pairs of pixels on opposite edges of
    the window tell most of what all pairs do; on things so thin that there is none, pairs of direct
    neighbours stand in, if they are NARROW_PAIRS.
    """
    near = jump * inverse[v, u]
    slope_u, slope_v, known = 0.0, 0.0, False
    if (
        v >= radius
        and u >= radius
        and v < inverse.shape[0] - radius
        and u < inverse.shape[1] - radius
    ):
        slope_u, pairs_u = slope_along(inverse, v, u, 0, 1, radius, radius, near)
        slope_v, pairs_v = slope_along(inverse, v, u, 1, 0, radius, radius, near)
        known = pairs_u > 0 and pairs_v > 0
        if not known:
            known = True
            if pairs_u == 0:
                slope_u, pairs_u = slope_along(inverse, v, u, 0, 1, 1, radius, near)
                known = pairs_u >= NARROW_PAIRS
            if pairs_v == 0:
                slope_v, pairs_v = slope_along(inverse, v, u, 1, 0, 1, radius, near)
                known = known and pairs_v >= NARROW_PAIRS
    return slope_u, slope_v, known


@ti.kernel
def estimate_normals(
    # in:
    inverse: Floats2,  # (H, W) 1/z [1/m], 0: none
    K: Intrinsics,
    radius: ti.template(),  # of the window [pixels]
    jump: ti.f32,  # as in drop_flying_pixels
    cos_max_angle: ti.f32,  # least cosine between the normal and the ray back to the camera
    # out:
    normals: Floats3,  # (H, W, 3) unit, towards the camera; z component 0 where there is none
):
    height, width = inverse.shape[0], inverse.shape[1]
    for v2, u2 in ti.ndrange((height + 1) // 2, (width + 1) // 2):
        slope_u, slope_v, known, of = 0.0, 0.0, False, 0.0
        for part in range(4):  # a quad of pixels shares its slopes where it lies on one surface
            v, u = v2 * 2 + part // 2, u2 * 2 + part % 2
            if v < height and u < width:
                q = inverse[v, u]
                n = ti.Vector([0.0, 0.0, 0.0])
                if q > 0:
                    if not known or ti.abs(q - of) > 0.5 * jump * q:
                        slope_u, slope_v, known = inverse_depth_slope(inverse, v, u, radius, jump)
                        of = q
                    if known:
                        along_z = q - slope_u * (u - K[2]) - slope_v * (v - K[3])
                        m = ti.Vector([slope_u * K[0], slope_v * K[1], along_z]) / q
                        # m . ray = 1
                        if cos_max_angle * m.norm() * ray(u, v, K).norm() <= 1.0:
                            n = -m.normalized()
                for d in ti.static(range(3)):
                    normals[v, u, d] = n[d]


@ti.kernel
def transform(
    # in:
    points: Floats2,  # (N, 3) in a
    T_b_a: Pose,
    # out:
    moved: Floats2,  # (N, 3) in b
):
    for n in range(points.shape[0]):
        x = move(T_b_a, row3(points, n))
        for d in ti.static(range(3)):
            moved[n, d] = x[d]
