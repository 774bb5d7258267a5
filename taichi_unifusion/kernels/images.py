"""Preprocessing on the image grid, and rigid motion.

Real depth holds NaN, infinity and negatives; they are recognised by their bits, because fast math
may drop a test for NaN.
"""

import taichi as ti

from .arrays import Floats2, Floats3, Ints1, Ints2, row3
from .camera import Intrinsics, Pose, lift, move, ray

Bytes3 = ti.types.ndarray(dtype=ti.u8, ndim=3)
PIXEL_CHUNK = 64  # pixels that one thread compacts


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
def inverse_depth_slope(
    inverse: ti.template(), v: ti.i32, u: ti.i32, radius: ti.template(), jump: ti.f32
):
    """Least-squares slopes of 1/z by u and v over a window, from pairs of pixels on opposite sides
    of (v, u) and on its surface.

    A plane has an inverse depth that is linear in the image. Also returns the smaller sum of
    squares of the two fits.
    """
    q = inverse[v, u]
    near = jump * q
    along_u, along_v, square_u, square_v = 0.0, 0.0, 0.0, 0.0
    if (
        v >= radius
        and u >= radius
        and v < inverse.shape[0] - radius
        and u < inverse.shape[1] - radius
    ):
        for i in range(-radius, radius + 1):
            for k in ti.static(range(1, radius + 1)):
                right, left = inverse[v + i, u + k], inverse[v + i, u - k]
                below, above = inverse[v + k, u + i], inverse[v - k, u + i]
                with_u = ti.max(ti.abs(right - q), ti.abs(left - q)) < near
                with_v = ti.max(ti.abs(below - q), ti.abs(above - q)) < near
                along_u += ti.select(with_u, k * (right - left), 0.0)
                square_u += ti.select(with_u, 2.0 * k * k, 0.0)
                along_v += ti.select(with_v, k * (below - above), 0.0)
                square_v += ti.select(with_v, 2.0 * k * k, 0.0)
    return (
        along_u / ti.max(square_u, 1.0),
        along_v / ti.max(square_v, 1.0),
        ti.min(square_u, square_v),
    )


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
        slope_u, slope_v, found, of = 0.0, 0.0, 0.0, 0.0
        for part in range(4):  # a quad of pixels shares its slopes where it lies on one surface
            v, u = v2 * 2 + part // 2, u2 * 2 + part % 2
            if v < height and u < width:
                q = inverse[v, u]
                n = ti.Vector([0.0, 0.0, 0.0])
                if q > 0:
                    if found == 0.0 or ti.abs(q - of) > 0.5 * jump * q:
                        slope_u, slope_v, found = inverse_depth_slope(inverse, v, u, radius, jump)
                        of = q
                    if found >= 2 * radius * radius:
                        along_z = q - slope_u * (u - K[2]) - slope_v * (v - K[3])
                        m = ti.Vector([slope_u * K[0], slope_v * K[1], along_z]) / q
                        # m . ray = 1
                        if cos_max_angle * m.norm() * ray(u, v, K).norm() <= 1.0:
                            n = -m.normalized()
                for d in ti.static(range(3)):
                    normals[v, u, d] = n[d]


@ti.kernel
def count_points(
    # in:
    normals: Floats3,  # (H, W, 3)
    # out:
    counts: Ints1,  # (H W / PIXEL_CHUNK,) pixels with a normal
):
    width, size = normals.shape[1], normals.shape[0] * normals.shape[1]
    for chunk in range(counts.shape[0]):
        count = 0
        for p in range(chunk * PIXEL_CHUNK, ti.min((chunk + 1) * PIXEL_CHUNK, size)):
            count += ti.cast(normals[p // width, p % width, 2] != 0, ti.i32)
        counts[chunk] = count


@ti.kernel
def unproject(
    # in:
    depth: Floats2,  # (H, W) [m]
    normals: Floats3,  # (H, W, 3)
    K: Intrinsics,
    starts: Ints1,  # (H W / PIXEL_CHUNK,) first point of each chunk
    # out:
    points: Floats2,  # (N, 3) camera [m]
    point_normals: Floats2,  # (N, 3)
    pixels: Ints2,  # (N, 2) row and column
):
    width, size = depth.shape[1], depth.shape[0] * depth.shape[1]
    for chunk in range(starts.shape[0]):
        n = starts[chunk]
        for p in range(chunk * PIXEL_CHUNK, ti.min((chunk + 1) * PIXEL_CHUNK, size)):
            v, u = p // width, p % width
            z = depth[v, u]
            if normals[v, u, 2] != 0:
                x = lift(u, v, z, K)
                for d in ti.static(range(3)):
                    points[n, d], point_normals[n, d] = x[d], normals[v, u, d]
                pixels[n, 0], pixels[n, 1] = v, u
                n += 1


@ti.kernel
def sample_color(
    # in:
    pixels: Ints2,  # (N or more, 2)
    color: Bytes3,  # (H, W, 3)
    # out:
    values: Floats2,  # (N, 3) in [0, 1]
):
    for n in range(values.shape[0]):
        for c in ti.static(range(3)):
            values[n, c] = ti.cast(color[pixels[n, 0], pixels[n, 1], c], ti.f32) * (1.0 / 255.0)


@ti.kernel
def sample_image(
    # in:
    pixels: Ints2,  # (N or more, 2)
    image: Floats3,  # (H, W, c)
    # out:
    values: Floats2,  # (N, c)
):
    for n in range(values.shape[0]):
        for c in range(values.shape[1]):
            values[n, c] = image[pixels[n, 0], pixels[n, 1], c]


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
