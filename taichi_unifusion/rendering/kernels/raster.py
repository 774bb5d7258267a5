"""Software rasteriser: a coloured mesh as a picture, with no graphics library and no screen.

A triangle is set up in homogeneous image coordinates p = (u w, v w, w) (Olano and Greer 1997), so
none has to be clipped: the pixel ray q = (u, v, 1) meets it where q . (p1 x p2), q . (p2 x p0), q .
(p0 x p1) all have the sign of det(p0, p1, p2). The depth buffer holds depth and triangle in one
integer, so that the result does not depend on the order of threads.
"""

import math

import taichi as ti

from ...kernels.arrays import Floats2, Ints2, row3
from ...kernels.camera import Intrinsics, Pose, ray, rotate

EMPTY = (1 << 63) - 1  # depth buffer value where no triangle is seen
EDGE = 1e-7  # barycentric slack: pixels on a shared edge belong to both triangles, never to none
GOLDEN_ANGLE = 2.3999632
ONE_SURFACE = 0.02  # relative difference of depth between samples of one surface in a pixel
COS, SIN = math.cos(GOLDEN_ANGLE), math.sin(GOLDEN_ANGLE)

# Half Lambert under one light, and ambient occlusion: both mild, so that colours stay true
LIFT = 1.15  # factor that gives a surface at 60 degrees to the light about its own colour
OCCLUSION_GAIN = 2.0
OCCLUSION_BIAS = 0.15  # sine of the slope that noise on flat surfaces may have
OCCLUSION_SHARE = 0.5  # of its brightness that the deepest corner loses

# (3, 4) world [m] -> homogeneous image (u w, v w, w), w is depth [m]
Projection = ti.types.ndarray(dtype=ti.f64, ndim=2)
# (H, W) bits of the depth << 32 | triangle, or EMPTY
DepthBuffer = ti.types.ndarray(dtype=ti.i64, ndim=2)
Image = ti.types.ndarray(dtype=ti.u8, ndim=3)  # (H, W, 3) RGB


@ti.func
def to_image(projection: ti.template(), x: ti.template()):
    """Homogeneous image coordinates of world point x, in float64."""
    p = ti.Vector([0.0, 0.0, 0.0], ti.f64)
    for r in ti.static(range(3)):
        p[r] = (
            projection[r, 0] * x[0]
            + projection[r, 1] * x[1]
            + projection[r, 2] * x[2]
            + projection[r, 3]
        )
    return p


@ti.func
def edge_functions(p0: ti.template(), p1: ti.template(), p2: ti.template(), two_sided: ti.i32):
    """Rows E with E (u, v, 1) = barycentric coordinates / depth; all 0 edge-on and, unless
    two_sided, seen from behind.
    """
    det = p0.dot(p1.cross(p2))  # negative where the counter-clockwise side faces the camera
    scale = 1.0 / det if det < 0.0 or (two_sided == 1 and det > 0.0) else ti.cast(0.0, ti.f64)
    return ti.Matrix.rows([p1.cross(p2) * scale, p2.cross(p0) * scale, p0.cross(p1) * scale])


@ti.func
def image_box(
    p0: ti.template(),
    p1: ti.template(),
    p2: ti.template(),
    near: ti.f64,
    width: ti.i32,
    height: ti.i32,
):
    """First and last column and row of the pixels that the part of a triangle beyond the near plane
    may touch.
    """
    corners = ti.Matrix.rows([p0, p1, p2])
    low, high = ti.Vector([1e9, 1e9], ti.f64), ti.Vector([-1e9, -1e9], ti.f64)
    for k in ti.static(range(3)):
        a = ti.Vector([corners[k, 0], corners[k, 1], corners[k, 2]])
        b = ti.Vector([corners[(k + 1) % 3, 0], corners[(k + 1) % 3, 1], corners[(k + 1) % 3, 2]])
        if a[2] >= near:
            low, high = ti.min(low, a.xy / a[2]), ti.max(high, a.xy / a[2])
        if (a[2] >= near) != (b[2] >= near):  # the edge pierces the near plane
            cut = (a + (near - a[2]) / (b[2] - a[2]) * (b - a)).xy / near
            low, high = ti.min(low, cut), ti.max(high, cut)
    last = ti.Vector([width - 1.0, height - 1.0], ti.f64)
    first_pixel = ti.ceil(ti.math.clamp(low - 1e-6, 0.0, last + 1.0), ti.i32)
    last_pixel = ti.floor(ti.math.clamp(high + 1e-6, -1.0, last), ti.i32)
    return ti.Vector([first_pixel[0], last_pixel[0], first_pixel[1], last_pixel[1]])


@ti.kernel
def rasterize(
    # in:
    vertices: Floats2,  # (V, 3) world [m]
    faces: Ints2,  # (F, 3), counter-clockwise seen from the side that is drawn
    two_sided: ti.i32,  # 1: both sides are drawn
    projection: Projection,  # (3, 4)
    near: ti.f64,  # [m] nothing nearer is drawn
    # out:
    nearest: DepthBuffer,  # (H, W)
):
    """The nearest triangle that shows a drawn side at the centre of every pixel."""
    for v, u in nearest:
        nearest[v, u] = ti.i64(EMPTY)
    for f in range(faces.shape[0]):
        p0 = to_image(projection, row3(vertices, faces[f, 0]))
        p1 = to_image(projection, row3(vertices, faces[f, 1]))
        p2 = to_image(projection, row3(vertices, faces[f, 2]))
        E = edge_functions(p0, p1, p2, two_sided)
        if ti.max(p0[2], p1[2], p2[2]) >= near and E.norm_sqr() > 0.0:
            box = image_box(p0, p1, p2, near, nearest.shape[1], nearest.shape[0])
            for v in range(box[2], box[3] + 1):
                for u in range(box[0], box[1] + 1):
                    b = E @ ti.Vector(
                        [ti.cast(u, ti.f64), ti.cast(v, ti.f64), ti.cast(1.0, ti.f64)]
                    )
                    inverse_depth = b.sum()
                    if (
                        b.min() >= -EDGE * inverse_depth
                        and inverse_depth > 0.0
                        and inverse_depth * near <= 1.0
                    ):
                        # positive floats sort like integers
                        bits = ti.bit_cast(ti.cast(1.0 / inverse_depth, ti.f32), ti.i32)
                        ti.atomic_min(
                            nearest[v, u], (ti.cast(bits, ti.i64) << 32) | ti.cast(f, ti.i64)
                        )


@ti.func
def depth_of(value: ti.i64) -> ti.f32:
    """Depth [m] held by a value of the depth buffer that is not EMPTY."""
    return ti.bit_cast(ti.cast(value >> 32, ti.i32), ti.f32)


@ti.kernel
def thin_out(
    # in:
    nearest: DepthBuffer,  # (H, W)
    thinned: ti.i32,
    # out:
    depth: Floats2,  # (h, w) [m] of every `thinned`-th pixel, 0 where no triangle is seen
):
    """A small depth image: looking around in it stays within the cache."""
    for v, u in depth:
        value = nearest[v * thinned, u * thinned]
        depth[v, u] = 0.0 if value == ti.i64(EMPTY) else depth_of(value)


@ti.func
def occlusion(
    depth: ti.template(),
    v: ti.i32,
    u: ti.i32,
    z: ti.f32,
    n: ti.math.vec3,
    intrinsics: Intrinsics,
    radius: ti.f32,
    taps: ti.i32,
    thinned: ti.i32,
) -> ti.f32:
    """How much of the sky over a pixel's surface its surroundings within `radius` [m] hide, 0..1 (n
    in the camera frame); these are looked up in every `thinned`-th pixel.
    """
    at = z * ray(u, v, intrinsics)
    reach = ti.min(radius * intrinsics[0] / z, 0.25 * depth.shape[1] * thinned)  # [px]
    # a start angle for each pixel, so that few taps give noise rather than bands
    turn = 6.2831853 * ti.math.fract(52.9829189 * ti.math.fract(0.06711056 * u + 0.00583715 * v))
    way = ti.Vector([ti.cos(turn), ti.sin(turn)])  # of a tap; the next one is a golden angle on
    hidden = 0.0
    for k in range(taps):
        r = reach * (k + 0.5) / taps
        y = ti.math.clamp(ti.round((v + r * way[1]) / thinned, ti.i32), 0, depth.shape[0] - 1)
        x = ti.math.clamp(ti.round((u + r * way[0]) / thinned, ti.i32), 0, depth.shape[1] - 1)
        way = ti.Vector([COS * way[0] - SIN * way[1], SIN * way[0] + COS * way[1]])
        if depth[y, x] > 0.0:
            d = depth[y, x] * ray(x * thinned, y * thinned, intrinsics) - at
            length = d.norm() + 1e-6
            hidden += ti.max(0.0, n.dot(d) / length - OCCLUSION_BIAS) * ti.max(
                0.0, 1.0 - length / radius
            )
    return ti.min(1.0, OCCLUSION_GAIN * hidden / taps)


@ti.kernel
def shade_pixels(
    # in:
    vertices: Floats2,  # (V, 3) world [m]
    normals: Floats2,  # (V, 3) unit, world
    colors: Floats2,  # (V, 3) RGB in [0, 1]
    faces: Ints2,  # (F, 3)
    projection: Projection,  # (3, 4)
    T_camera_world: Pose,  # (3, 4)
    intrinsics: Intrinsics,  # of the depth buffer
    nearest: DepthBuffer,  # (s H, s W)
    depth: Floats2,  # (h, w) [m] of some pixels of it, 0: none
    light: ti.math.vec4,  # unit direction to it, camera frame; how much it changes colours, 0..1
    radius: ti.f32,  # of ambient occlusion [m]
    # depths looked at for it, a surface in a pixel, 0: none is wanted; every how many-th pixel has one
    taps: ti.math.ivec2,
    background: ti.math.vec3,  # RGB in [0, 1]
    # out:
    image: Image,  # (H, W, 3) RGB
):
    """Colour of every pixel: the mean over its s x s samples of interpolated vertex colour under
    soft light.
    """
    s = nearest.shape[0] // image.shape[0]
    for y, x in ti.ndrange(image.shape[0], image.shape[1]):
        total = ti.math.vec3(0.0)
        hidden, hidden_at = 0.0, 0.0  # samples of one surface share what is hidden at the first
        for i, j in ti.ndrange(s, s):
            v, u = y * s + i, x * s + j
            rgb = background
            if nearest[v, u] != ti.i64(EMPTY):
                f = ti.cast(nearest[v, u] & ti.i64(0xFFFFFFFF), ti.i32)
                a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
                E = edge_functions(
                    to_image(projection, row3(vertices, a)),
                    to_image(projection, row3(vertices, b)),
                    to_image(projection, row3(vertices, c)),
                    0,
                )
                w = E @ ti.Vector([ti.cast(u, ti.f64), ti.cast(v, ti.f64), ti.cast(1.0, ti.f64)])
                w = ti.max(w, 0.0) / ti.max(w, 0.0).sum()
                w0, w1, w2 = ti.cast(w[0], ti.f32), ti.cast(w[1], ti.f32), ti.cast(w[2], ti.f32)
                rgb = w0 * row3(colors, a) + w1 * row3(colors, b) + w2 * row3(colors, c)
                n = w0 * row3(normals, a) + w1 * row3(normals, b) + w2 * row3(normals, c)
                n = rotate(T_camera_world, n)
                n /= n.norm() + 1e-9
                lit = 0.5 + 0.5 * n.dot(light.xyz)  # half Lambert: nothing falls into black
                z = depth_of(nearest[v, u])
                if taps[0] > 0 and ti.abs(z - hidden_at) > ONE_SURFACE * z:
                    hidden = occlusion(depth, v, u, z, n, intrinsics, radius, taps[0], taps[1])
                    hidden_at = z
                rgb *= 1.0 - light[3] + light[3] * lit * LIFT
                rgb *= 1.0 - OCCLUSION_SHARE * hidden
            total += ti.math.clamp(rgb, 0.0, 1.0)
        for k in ti.static(range(3)):
            image[y, x, k] = ti.cast(total[k] / (s * s) * 255.0 + 0.5, ti.u8)
