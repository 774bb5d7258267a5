"""Colour of a scene of analytic primitives: solid textures and soft light, baked into the surface.

A colour depends on the surface point and its normal alone, never on the view, so that two frames
that see a point agree.
"""

import taichi as ti

from ...kernels.arrays import Floats2, Floats3, Ints1, Ints2
from ...kernels.camera import Intrinsics, Pose, move, ray, rotate
from .raster import Image
from .solids import CYLINDER, ROOM, SPHERE, TAU, multiply, to_local, uniform

PATTERNS = {
    name: i
    for i, name in enumerate(
        (
            "plain",
            "planks",
            "wallpaper",
            "weave",
            "bands",
            "landscape",
            "mosaic",
            "rug",
            "panels",
            "globe",
        )
    )
}
PLAIN, PLANKS, WALLPAPER, WEAVE, BANDS, LANDSCAPE, MOSAIC, RUG, PANELS, GLOBE = PATTERNS.values()

Corners = ti.types.matrix(2, 3, ti.f32)

# [m] lattice spacings of the three octaves of grain; the finest gives detail of about 1 cm
GRAIN_CELLS = (0.1, 0.033, 0.011)
GROUND = 0.02  # [m] height up to which surfaces that face up receive the furniture's shadow


@ti.func
def lattice(i: ti.i32, j: ti.i32, k: ti.i32, seed: ti.i32) -> ti.f32:
    """A number in (0, 1) for each corner of an integer lattice."""
    key = multiply(ti.cast(i, ti.u32), ti.u32(0x9E3779B1)) ^ multiply(
        ti.cast(j, ti.u32), ti.u32(0x85EBCA77)
    )
    key ^= multiply(ti.cast(k, ti.u32), ti.u32(0xC2B2AE3D)) ^ multiply(
        ti.cast(seed, ti.u32), ti.u32(0x27D4EB2F)
    )
    return uniform(key)


@ti.func
def grain_at(q: ti.math.vec3, seed: ti.i32):
    """Three octaves of solid value noise at q [m], coarse to fine, each in (0, 1)."""
    octaves = ti.math.vec3(0.0)
    for o in range(3):
        cell = GRAIN_CELLS[0]
        if o == 1:
            cell = GRAIN_CELLS[1]
        elif o == 2:
            cell = GRAIN_CELLS[2]
        base = ti.floor(q / cell)
        f = q / cell - base
        f = f * f * (3.0 - 2.0 * f)
        i = ti.cast(base, ti.i32)
        value = 0.0
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            w = (
                (a * f[0] + (1 - a) * (1 - f[0]))
                * (b * f[1] + (1 - b) * (1 - f[1]))
                * (c * f[2] + (1 - c) * (1 - f[2]))
            )
            value += w * lattice(i[0] + a, i[1] + b, i[2] + c, seed + o)
        for axis in ti.static(range(3)):
            octaves[axis] += value * ti.cast(o == axis, ti.f32)
    return octaves


@ti.func
def line(x: ti.f32, period: ti.f32, width: ti.f32) -> ti.f32:
    """1 on soft lines of the given width at the multiples of period, 0 between them [m]."""
    return 1.0 - ti.math.smoothstep(
        0.3 * width, 0.7 * width, ti.abs(x - period * ti.round(x / period))
    )


@ti.func
def unit_normal(shape: ti.i32, p: ti.math.vec3):
    """Gradient of the unit solid's surface at its point p: outward, into the room for the room; not
    normalised.
    """
    a = ti.abs(p)
    n = p
    if shape == CYLINDER:
        n = (
            ti.math.vec3(p[0], p[1], 0.0)
            if p[0] * p[0] + p[1] * p[1] > a[2]
            else ti.math.vec3(0.0, 0.0, p[2])
        )
    elif shape != SPHERE:
        n = ti.math.vec3(0.0)
        if a[0] >= a[1] and a[0] >= a[2]:
            n[0] = p[0]
        elif a[1] >= a[2]:
            n[1] = p[1]
        else:
            n[2] = p[2]
        if shape == ROOM:
            n = -n
    return n


@ti.func
def surface_coordinates(shape: ti.i32, n: ti.math.vec3, p: ti.math.vec3, half: ti.math.vec3):
    """Coordinates (s, t) on the face of p and its half extents (S, T) [m]; s runs along the longer
    side.
    """
    q = p * half
    st = ti.math.vec4(q[0], q[1], half[0], half[1])
    if (shape == CYLINDER and n[2] == 0.0) or shape == SPHERE:
        st = ti.math.vec4(ti.atan2(p[1], p[0]) * half[0], q[2], 0.5 * TAU * half[0], half[2])
    elif shape != CYLINDER:
        if n[0] != 0.0:
            st = ti.math.vec4(q[1], q[2], half[1], half[2])
        elif n[1] != 0.0:
            st = ti.math.vec4(q[0], q[2], half[0], half[2])
        if st[3] > st[2]:
            st = ti.math.vec4(st[1], st[0], st[3], st[2])
    return st


@ti.func
def pattern_weights(
    pattern: ti.i32, size: ti.f32, st: ti.math.vec4, grain: ti.math.vec3, seed: ti.i32
):
    """Weights of a material's second and third colour and a tone factor, at (s, t) on a face with
    half extents (S, T).
    """
    s, t = st[0], st[1]
    second, third, tone = grain[1], 0.0, 1.0
    if pattern == PLANKS:
        rank = ti.floor(t / size, ti.i32)
        along = s / (8.0 * size) + 0.37 * rank
        tone = 0.86 + 0.28 * lattice(rank, ti.floor(along, ti.i32), 0, seed)
        third = ti.max(line(t, size, 0.008), line(along * 8.0 * size, 8.0 * size, 0.008))
    elif pattern == WALLPAPER:
        rank = ti.floor(s / size + 0.5, ti.i32)
        second = 0.8 * ti.cast(rank % 2, ti.f32) + 0.2 * grain[1]
        a, b = (
            s - size * rank,
            t - size * (ti.round(t / size - 0.5 * (rank % 2)) + 0.5 * (rank % 2)),
        )
        r = ti.abs(a) + 0.7 * ti.abs(b)
        third = (
            line(r - 0.2 * size, 10.0, 0.016)
            + 1.0
            - ti.math.smoothstep(0.006, 0.012, ti.sqrt(a * a + b * b))
        )
    elif pattern == WEAVE:
        second = 0.5 + 0.25 * ti.sin(s * TAU / size) + 0.25 * ti.sin(t * TAU / size)
        third = 0.6 * ti.max(line(s, 6.0 * size, 0.4 * size), line(t, 6.0 * size, 0.4 * size))
    elif pattern == BANDS:
        second = line(t, size, 0.3 * size)
        third = line(t - 0.35 * size, size, 0.12 * size) * ti.math.smoothstep(0.3, 0.4, grain[2])
    elif pattern == LANDSCAPE:
        x, y = s / st[2], t / st[3]
        ridge = (
            0.35 * ti.sin(2.3 * x + seed)
            + 0.14 * ti.sin(7.1 * x + 2 * seed)
            + 0.25 * (grain[1] - 0.5)
        )
        second = ti.math.smoothstep(-0.04, 0.04, 0.1 + ridge - y)
        third = ti.math.smoothstep(-0.05, 0.05, -0.35 - 0.7 * ridge - y)
        tone = (
            1.0 + 0.25 * y - 0.35 * line(ti.min(st[2] - ti.abs(s), st[3] - ti.abs(t)), 10.0, 0.05)
        )
    elif pattern == MOSAIC:
        i, j = ti.floor(s / size, ti.i32), ti.floor(t / size, ti.i32)
        second = ti.floor(3.0 * lattice(i, j, 1, seed)) * 0.5
        third = ti.cast(lattice(i, j, 2, seed) > 0.72, ti.f32)
        tone = (0.8 + 0.3 * lattice(i, j, 3, seed)) * (
            1.0 - 0.4 * ti.max(line(s, size, 0.008), line(t, size, 0.008))
        )
    elif pattern == RUG:
        border = ti.min(st[2] - ti.abs(s), st[3] - ti.abs(t))
        inner = ti.math.smoothstep(0.16, 0.17, border)
        a, b = s - size * ti.round(s / size), t - size * ti.round(t / size)
        r = (ti.abs(a) + ti.abs(b)) / size
        motif = ti.max(line(r - 0.42, 10.0, 0.08), 1.0 - ti.math.smoothstep(0.14, 0.18, r))
        second = (1.0 - inner) * (0.5 + 0.5 * ti.sin(border * TAU / 0.08)) + inner * motif
        third = (1.0 - inner) * line(border - 0.12, 10.0, 0.03) + inner * line(r - 0.26, 10.0, 0.07)
        tone = 0.94 + 0.06 * ti.sin(t * TAU / 0.02)
    elif pattern == PANELS:
        a = ti.abs(ti.abs(s) - 0.5 * st[2]) - 0.38 * st[2]
        b = ti.abs(t) - 0.66 * st[3]
        rim = ti.max(a, b)
        third = line(rim, 10.0, 0.022)
        second = 0.6 * ti.math.smoothstep(0.0, -0.01, rim) + 0.4 * grain[1]
    elif pattern == GLOBE:
        second = ti.math.smoothstep(0.5, 0.54, 0.65 * grain[0] + 0.35 * grain[1])
        third = 0.7 * line(t, size, 0.008)
    return ti.math.vec3(ti.math.clamp(second, 0.0, 1.0), ti.math.clamp(third, 0.0, 1.0), tone)


@ti.func
def daylight(
    x: ti.math.vec3, n: ti.math.vec3, room_low: ti.math.vec3, room_high: ti.math.vec3
) -> ti.f32:
    """Soft diffuse light at world point x [m] with normal n: sky, a window to the west, a ceiling
    lamp, darker corners.
    """
    shade = 0.58 + 0.08 * n[2]
    for light in ti.static(((-1.5, 0.2, 1.9, 0.34), (0.4, 0.0, 2.3, 0.30))):
        way = ti.math.vec3(light[0], light[1], light[2]) - x
        facing = ti.max(0.0, 0.75 * n.dot(way.normalized()) + 0.25)
        shade += light[3] * facing / (0.6 + 0.12 * way.dot(way))
    wall = ti.min(x - room_low, room_high - x)
    for axis in ti.static(range(3)):
        shade *= 1.0 - 0.22 * (1.0 - ti.abs(n[axis])) * ti.exp(-ti.max(wall[axis], 0.0) / 0.16)
    return shade


@ti.func
def ground_light(ground: ti.template(), share: ti.math.vec3) -> ti.f32:
    """The floor's shadow, bilinear, at a place given as shares of the room's sides."""
    x, y = share[0] * (ground.shape[0] - 1), share[1] * (ground.shape[1] - 1)
    i, j = (
        ti.math.clamp(ti.cast(x, ti.i32), 0, ground.shape[0] - 2),
        ti.math.clamp(ti.cast(y, ti.i32), 0, ground.shape[1] - 2),
    )
    return ti.math.mix(
        ti.math.mix(ground[i, j], ground[i + 1, j], x - i),
        ti.math.mix(ground[i, j + 1], ground[i + 1, j + 1], x - i),
        y - j,
    )


@ti.kernel
def shade_surfaces(
    # in:
    intrinsics: Intrinsics,
    T_world_camera: Pose,  # (3, 4)
    room: Corners,  # (2, 3) lowest and highest inner corner of the room, world [m]
    depth: Floats2,  # (H, W) [m] of cast_rays
    hit: Ints2,  # (H, W) of cast_rays
    shapes: Ints1,  # (P,)
    T_local_camera: Floats3,  # (P, 3, 4)
    half_extents: Floats2,  # (P, 3) [m]
    materials: Ints2,  # (P, 4) row of looks for the faces across x, y, below, above
    patterns: Ints1,  # (M,) number in PATTERNS
    looks: Floats2,  # (M, 12) size [m], grain, stretch, three RGB colours
    ground: Floats2,  # (X, Y) shadow on the floor, 1 where none, corner to corner
    # out:
    color: Image,  # (H, W, 3) RGB
    cosine: Floats2,  # (H, W) between the normal and the direction to the camera
):
    """Colour of the surface that each pixel sees."""
    for v, u in depth:
        j = hit[v, u]
        rgb = ti.math.vec3(0.0)
        cosine[v, u] = 0.0
        if j >= 0:
            direction = ray(u, v, intrinsics)
            at = depth[v, u] * direction
            half = ti.math.vec3(half_extents[j, 0], half_extents[j, 1], half_extents[j, 2])
            p = to_local(T_local_camera, j, at)
            p += ti.math.vec3(
                T_local_camera[j, 0, 3], T_local_camera[j, 1, 3], T_local_camera[j, 2, 3]
            )
            n_local = unit_normal(shapes[j], p)
            n_camera = ti.math.vec3(0.0)
            for r in ti.static(range(3)):
                for c in ti.static(range(3)):
                    n_camera[c] += T_local_camera[j, r, c] * n_local[r]
            n_camera = n_camera.normalized()
            cosine[v, u] = ti.abs(n_camera.dot(direction.normalized()))
            n, x = rotate(T_world_camera, n_camera), move(T_world_camera, at)

            face = (
                0 if n_local[0] != 0.0 else (1 if n_local[1] != 0.0 else (2 if p[2] < 0.0 else 3))
            )
            m = materials[j, face]
            st = surface_coordinates(shapes[j], n_local, p, half)
            q = p * half
            if half[0] >= half[1] and half[0] >= half[2]:  # grain runs along the longest axis
                q[0] /= looks[m, 2]
            elif half[1] >= half[2]:
                q[1] /= looks[m, 2]
            else:
                q[2] /= looks[m, 2]
            grain = grain_at(q, 11 * j)
            weights = pattern_weights(patterns[m], looks[m, 0], st, grain, j)
            for c in ti.static(range(3)):
                rgb[c] = ti.math.mix(looks[m, 3 + c], looks[m, 6 + c], weights[0])
                rgb[c] = ti.math.mix(rgb[c], looks[m, 9 + c], weights[1])
            rgb *= weights[2] * (
                1.0 + looks[m, 1] * (0.5 * grain[0] + 0.8 * grain[1] + 0.7 * grain[2] - 1.0)
            )
            low, high = room[0, :], room[1, :]
            light = daylight(x, n, low, high)
            if x[2] < GROUND and n[2] > 0.5:
                light *= ground_light(ground, (x - low) / (high - low))
            rgb *= light
        for c in ti.static(range(3)):
            color[v, u, c] = ti.cast(ti.math.clamp(rgb[c], 0.0, 1.0) * 255.0 + 0.5, ti.u8)
