"""Analytic ray casting of a scene of boxes, cylinders and spheres, and the noise of a Kinect's
depth.

Every primitive is a *unit* solid (|x|, |y|, |z| <= 1; x^2 + y^2 <= 1 and |z| <= 1; |x| <= 1) under
an affine map, and one of them is the room, seen from within. Noise depends on (seed, frame, pixel)
alone, never on the order of evaluation.
"""

import taichi as ti

from ...kernels.arrays import Floats1, Floats2, Floats3, Ints1, Ints2
from ...kernels.camera import Intrinsics, ray

ROOM, BOX, CYLINDER, SPHERE = range(4)

TILE = 16  # pixels per side of a culling tile
FAR = 1e9  # no hit
TAU = 6.2831853

# Kinect v1: axial noise after Nguyen et al. 2012 (Eq. 3 and its grazing term), lateral noise 0.7 px
# at edges
LATERAL = 0.7  # [px]
AXIAL = (0.0012, 0.0019)  # [m], [1/m]: sigma = a + b (z - 0.4)^2
GRAZING = 0.0001  # [m^1.5]: + c / sqrt(z) * theta^2 / (pi/2 - theta)^2
EDGE_GAP = 0.03  # a neighbour nearer or farther by this share of z is another surface
BASELINE = 0.075  # [m] between the projector, on the right, and the camera
# [m] divided by depth: disparity in steps of 1/8 px, in the sensor's image (640 px, focal length 575 px)
DISPARITY_STEPS = 8 * 575 * BASELINE
NEAR_LIMIT, FAR_LIMIT = 0.4, 5.5  # [m] no reading outside


@ti.func
def multiply(a: ti.u32, b: ti.u32) -> ti.u32:
    """The product modulo 2^32, by way of 64 bits: Taichi's debug mode reports every 32-bit
    overflow.
    """
    return ti.cast(ti.cast(a, ti.u64) * ti.cast(b, ti.u64) & ti.u64(0xFFFFFFFF), ti.u32)


@ti.func
def hash32(x: ti.u32) -> ti.u32:
    """A well-mixed 32-bit integer of a 32-bit integer."""
    x = multiply(x ^ ti.bit_shr(x, 16), ti.u32(0x7FEB352D))
    x = multiply(x ^ ti.bit_shr(x, 15), ti.u32(0x846CA68B))
    return x ^ ti.bit_shr(x, 16)


@ti.func
def uniform(x: ti.u32) -> ti.f32:
    """A number in (0, 1) of a 32-bit integer."""
    return (ti.cast(ti.bit_shr(hash32(x), 9), ti.f32) + 0.5) * (1.0 / 8388608.0)


@ti.func
def slab(o: ti.f32, d: ti.f32):
    """Parameters at which o + t d enters and leaves [-1, 1]."""
    inverse = 1.0 / (d if ti.abs(d) > 1e-9 else 1e-9)
    a, b = (-1.0 - o) * inverse, (1.0 - o) * inverse
    return ti.math.vec2(ti.min(a, b), ti.max(a, b))


@ti.func
def overlap(a: ti.math.vec2, b: ti.math.vec2):
    """The intersection of two intervals, empty if its first exceeds its second."""
    return ti.math.vec2(ti.max(a[0], b[0]), ti.min(a[1], b[1]))


@ti.func
def hit_parameter(shape: ti.i32, o: ti.math.vec3, d: ti.math.vec3) -> ti.f32:
    """First t > 0 at which the ray o + t d enters the unit solid (leaves it, for the room), FAR if
    it does not.
    """
    span = ti.math.vec2(-FAR, FAR)
    if shape == ROOM or shape == BOX:  # noqa: SIM109 (Taichi compiles no `in`)
        span = overlap(overlap(slab(o[0], d[0]), slab(o[1], d[1])), slab(o[2], d[2]))
    else:
        flat = ti.math.vec3(1.0, 1.0, 1.0 if shape == SPHERE else 0.0)
        a, b = o * flat, d * flat
        bb = ti.max(b.dot(b), 1e-18)
        nearest = -a.dot(b) / bb
        p = a + nearest * b  # the foot of the perpendicular: exact where b^2 - 4 a c would cancel
        half = 1.0 - p.dot(p)
        if half > 0.0:
            half = ti.sqrt(half / bb)
            span = ti.math.vec2(nearest - half, nearest + half)
            if shape == CYLINDER:
                span = overlap(span, slab(o[2], d[2]))
        else:
            span = ti.math.vec2(FAR, -FAR)
    t = span[1] if shape == ROOM else span[0]
    return t if span[0] < span[1] and t > 0.0 else FAR


@ti.func
def to_local(T_local_camera: ti.template(), j: ti.i32, x: ti.math.vec3):
    """Linear part of primitive j's map applied to x."""
    y = ti.math.vec3(0.0)
    for r in ti.static(range(3)):
        y[r] = (
            T_local_camera[j, r, 0] * x[0]
            + T_local_camera[j, r, 1] * x[1]
            + T_local_camera[j, r, 2] * x[2]
        )
    return y


@ti.kernel
def cast_rays(
    # in:
    intrinsics: Intrinsics,
    shapes: Ints1,  # (P,) ROOM, BOX, CYLINDER or SPHERE
    T_local_camera: Floats3,  # (P, 3, 4) camera [m] -> unit solid
    nearest: Floats1,  # (P,) smallest depth of any of its points [m]
    tile_starts: Ints1,  # (tiles + 1,) first row of tile_members, tiles row by row
    tile_members: Ints1,  # (M,) primitives that may show in a tile, nearest first
    # out:
    depth: Floats2,  # (H, W) [m], 0 where nothing is hit
    hit: Ints2,  # (H, W) primitive, -1 where nothing is hit
):
    """First surface along the ray of every pixel; t is depth, because rays have unit z."""
    tiles_x = (depth.shape[1] + TILE - 1) // TILE
    for v, u in depth:
        direction = ray(u, v, intrinsics)
        best, winner = FAR, -1
        tile = v // TILE * tiles_x + u // TILE
        row, end = tile_starts[tile], tile_starts[tile + 1]
        while row < end:
            j = tile_members[row]
            row += 1
            if nearest[j] > best:
                row = end
            else:
                o = ti.math.vec3(
                    T_local_camera[j, 0, 3], T_local_camera[j, 1, 3], T_local_camera[j, 2, 3]
                )
                t = hit_parameter(shapes[j], o, to_local(T_local_camera, j, direction))
                if t < best:
                    best, winner = t, j
        depth[v, u] = best if winner >= 0 else 0.0
        hit[v, u] = winner


@ti.func
def gaussians(key: ti.u32):
    """Two independent standard normal numbers of a 32-bit key (Box-Muller)."""
    radius = ti.sqrt(-2.0 * ti.log(uniform(key)))
    angle = TAU * uniform(key ^ ti.u32(0x68E31DA4))
    return ti.math.vec2(radius * ti.cos(angle), radius * ti.sin(angle))


@ti.kernel
def kinect_depth(
    # in:
    exact: Floats2,  # (H, W) [m], 0 where nothing is hit
    cosine: Floats2,  # (H, W) of the angle of incidence
    closest: ti.f32,  # smallest exact depth of a hit [m]: bounds the projector's shadow
    seed: ti.i32,
    frame: ti.i32,
    fx: ti.f32,  # [px]
    # out:
    depth: Floats2,  # (H, W) [m] in whole millimetres, 0 where no reading
):
    """What a Kinect v1 would read: lateral and axial noise, projector shadow, grazing drop-outs,
    disparity and mm steps.
    """
    height, width = exact.shape[0], exact.shape[1]
    baseline_focal = BASELINE * fx
    stream = hash32(ti.cast(seed, ti.u32) ^ hash32(ti.cast(frame, ti.u32) ^ ti.u32(0x9E3779B9)))
    for v, u in exact:
        key = hash32(stream ^ ti.cast(v * width + u, ti.u32))
        offset = LATERAL * gaussians(key)
        y = ti.math.clamp(ti.round(v + offset[0], ti.i32), 0, height - 1)
        x = ti.math.clamp(ti.round(u + offset[1], ti.i32), 0, width - 1)
        if ti.abs(exact[y, x] - exact[v, u]) < EDGE_GAP * exact[v, u]:
            y, x = v, u  # the same surface: the axial term holds all its noise
        z = exact[y, x]
        lit = 1
        reach = ti.min(
            ti.cast(baseline_focal * (1.0 / closest - 1.0 / ti.max(z, closest)), ti.i32),
            width - 1 - x,
        )
        k = 1
        # an occluder k pixels to the right hides the point from the projector on that side
        while k <= reach:
            if (
                exact[y, x + k] > 0.0
                and exact[y, x + k] * (baseline_focal + k * z) <= baseline_focal * z
            ):
                lit = 0
                k = reach
            k += 1
        theta = ti.acos(ti.math.clamp(cosine[y, x], 0.0, 1.0))
        reading = 0.0
        seen = 1.0 - ti.math.smoothstep(1.2, 1.48, theta)  # 69 to 85 degrees
        if z > 0.0 and lit == 1 and uniform(key ^ ti.u32(0xB5297A4D)) < seen:
            sigma = AXIAL[0] + AXIAL[1] * (z - 0.4) ** 2
            if theta > 1.05:
                sigma += GRAZING / ti.sqrt(z) * (theta / (1.5708 - theta)) ** 2
            z += sigma * gaussians(key ^ ti.u32(0x1B56C4E9))[0]
            steps = ti.round(DISPARITY_STEPS / ti.max(z, 0.1))
            reading = ti.round(1000.0 * DISPARITY_STEPS / steps) / 1000.0
            if reading < NEAR_LIMIT or reading > FAR_LIMIT:
                reading = 0.0
        depth[v, u] = reading
