"""Textured triangles at the pixels that see them: what the depth buffer of `raster.rasterize`
holds, shaded and read out.

A pixel is shaded once for every triangle that its samples see, at their mean, over the pixel's
footprint: mip levels along the footprint's short axis, several taps along its long one (Feline;
McCormack et al. 1999), so that colour aliases neither inside triangles nor at their edges.
"""

import taichi as ti

from ...kernels.arrays import Floats2, Ints1, Ints2, row3
from ...kernels.camera import Intrinsics, Pose, ray, rotate
from .raster import EMPTY, DepthBuffer, Image, Projection, depth_of, edge_functions, to_image

MAX_TAPS = 8  # along the long axis of a footprint; longer ones are blurred
SLACK = 0.05  # of a tap: a footprint that is square but for rounding takes one
SAMPLES = 2  # per pixel and axis
SHADE = 0.35  # how much darker a surface gets that faces away from the light

# (N, 3) RGB, levels of all textures one after the other, row by row
Texels = ti.types.ndarray(dtype=ti.u8, ndim=2)


@ti.func
def bilinear(texels: ti.template(), levels: ti.template(), level: ti.i32, st: ti.math.vec2):
    """Colour of one mip level at st, which repeats with period 1 and runs right and down; RGB in
    [0, 1].
    """
    offset, width, height = levels[level, 0], levels[level, 1], levels[level, 2]
    x, y = (st[0] - ti.floor(st[0])) * width - 0.5, (st[1] - ti.floor(st[1])) * height - 0.5
    x0, y0 = ti.floor(x, ti.i32), ti.floor(y, ti.i32)
    fx, fy = x - x0, y - y0
    rgb = ti.math.vec3(0.0)
    for i, j in ti.static(ti.ndrange(2, 2)):
        at = offset + (y0 + i + height) % height * width + (x0 + j + width) % width
        weight = (fy if i else 1.0 - fy) * (fx if j else 1.0 - fx)
        for k in ti.static(range(3)):
            rgb[k] += weight * texels[at, k]
    return rgb / 255.0


@ti.func
def sample_texture(
    texels: ti.template(),
    levels: ti.template(),
    first: ti.i32,
    count: ti.i32,
    st: ti.math.vec2,
    along_u: ti.math.vec2,
    along_v: ti.math.vec2,
):
    """Mean colour of a texture over the parallelogram around st that the two steps of st span."""
    size = ti.math.vec2(levels[first, 1], levels[first, 2])
    a, b = (along_u * size).norm(), (along_v * size).norm()  # [texels of level 0]
    long = along_u if a >= b else along_v
    major = ti.max(a, b, 1e-6)
    minor = ti.abs((along_u * size).cross(along_v * size)) / major
    taps = ti.math.clamp(ti.ceil(major / ti.max(minor, 1.0) - SLACK, ti.i32), 1, MAX_TAPS)
    lod = ti.math.clamp(ti.log(ti.max(major / taps, 1.0)) * 1.442695, 0.0, count - 1.0)
    level = ti.min(ti.floor(lod, ti.i32), ti.max(count - 2, 0))
    share = lod - level
    rgb = ti.math.vec3(0.0)
    for k in range(taps):
        at = st + ((k + 0.5) / taps - 0.5) * long
        rgb += (1.0 - share) * bilinear(texels, levels, first + level, at)
        if share > 0.0:
            rgb += share * bilinear(texels, levels, first + level + 1, at)
    return rgb / taps


@ti.func
def corner_rows(E: ti.template(), u: ti.f64, v: ti.f64):
    """Barycentric coordinates / depth at (u, v), clamped to the triangle."""
    return ti.max(E @ ti.Vector([u, v, ti.cast(1.0, ti.f64)]), 0.0)


@ti.func
def shade_triangle(
    vertices: ti.template(),
    faces: ti.template(),
    colors: ti.template(),
    corners: ti.template(),
    textures: ti.template(),
    face_texture: ti.template(),
    levels: ti.template(),
    texels: ti.template(),
    projection: ti.template(),
    light: ti.math.vec3,
    f: ti.i32,
    u: ti.f64,
    v: ti.f64,
):
    """Colour of triangle f around (u, v) of a depth buffer with SAMPLES x SAMPLES samples a pixel;
    RGB in [0, 1].
    """
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    p0, p1 = to_image(projection, row3(vertices, a)), to_image(projection, row3(vertices, b))
    p2 = to_image(projection, row3(vertices, c))
    E = edge_functions(p0, p1, p2, 1)
    w = corner_rows(E, u, v)
    D = w.sum()
    weights = ti.cast(w / D, ti.f32)
    rgb = weights[0] * row3(colors, a) + weights[1] * row3(colors, b) + weights[2] * row3(colors, c)
    if face_texture[f] >= 0:
        st, along_u, along_v = ti.math.vec2(0.0), ti.math.vec2(0.0), ti.math.vec2(0.0)
        slope_u, slope_v = E[0, 0] + E[1, 0] + E[2, 0], E[0, 1] + E[1, 1] + E[2, 1]
        for k in ti.static(range(2)):
            s0, s1, s2 = corners[f, k], corners[f, 2 + k], corners[f, 4 + k]
            s = (w[0] * s0 + w[1] * s1 + w[2] * s2) / D
            st[k] = ti.cast(s, ti.f32)
            along_u[k] = ti.cast(
                SAMPLES * (E[0, 0] * s0 + E[1, 0] * s1 + E[2, 0] * s2 - s * slope_u) / D, ti.f32
            )
            along_v[k] = ti.cast(
                SAMPLES * (E[0, 1] * s0 + E[1, 1] * s1 + E[2, 1] * s2 - s * slope_v) / D, ti.f32
            )
        t = face_texture[f]
        rgb *= sample_texture(texels, levels, textures[t, 0], textures[t, 1], st, along_u, along_v)
    n = (row3(vertices, b) - row3(vertices, a)).cross(row3(vertices, c) - row3(vertices, a))
    # towards the side that is seen
    n *= (1.0 if p0.dot(p1.cross(p2)) < 0.0 else -1.0) / (n.norm() + 1e-20)
    return rgb * (1.0 - SHADE * (0.5 - 0.5 * n.dot(light)))


@ti.kernel
def shade_textured(
    # in:
    vertices: Floats2,  # (V, 3) world [m]
    colors: Floats2,  # (V, 3) RGB in [0, 1], times the texture's
    faces: Ints2,  # (F, 3)
    corners: Floats2,  # (F, 6) texture coordinates of the three corners, right and down, period 1
    face_texture: Ints1,  # (F,) row of textures, -1: none
    textures: Ints2,  # (T, 2) first row of levels, how many
    levels: Ints2,  # (L, 3) first row of texels, width, height
    texels: Texels,  # (N, 3) RGB
    projection: Projection,  # (3, 4)
    light: ti.math.vec3,  # unit, towards the light in the world
    background: ti.math.vec3,  # RGB in [0, 1]
    nearest: DepthBuffer,  # (SAMPLES H, SAMPLES W)
    # out:
    color: Image,  # (H, W, 3) RGB
):
    """Colour of every pixel under a constant soft light: the mean over its samples."""
    for y, x in ti.ndrange(color.shape[0], color.shape[1]):
        seen = ti.Vector([ti.i64(0)] * SAMPLES**2)
        for i, j in ti.static(ti.ndrange(SAMPLES, SAMPLES)):
            value = nearest[y * SAMPLES + i, x * SAMPLES + j]
            seen[i * SAMPLES + j] = (
                value & ti.i64(0xFFFFFFFF) if value != ti.i64(EMPTY) else ti.i64(-1)
            )
        total = ti.math.vec3(0.0)
        for m in range(SAMPLES**2):
            first, count, u, v = 1, 0, ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            for o in range(SAMPLES**2):
                if seen[o] == seen[m]:
                    if o < m:
                        first = 0  # its triangle is shaded already
                    count += 1
                    u += x * SAMPLES + o % SAMPLES
                    v += y * SAMPLES + o // SAMPLES
            if first == 1:
                rgb = background
                if seen[m] >= 0:
                    rgb = shade_triangle(
                        vertices,
                        faces,
                        colors,
                        corners,
                        textures,
                        face_texture,
                        levels,
                        texels,
                        projection,
                        light,
                        ti.cast(seen[m], ti.i32),
                        u / count,
                        v / count,
                    )
                total += ti.math.clamp(rgb, 0.0, 1.0) * count
        for k in ti.static(range(3)):
            color[y, x, k] = ti.cast(total[k] / SAMPLES**2 * 255.0 + 0.5, ti.u8)


@ti.kernel
def read_surfaces(
    # in:
    vertices: Floats2,  # (V, 3) world [m]
    faces: Ints2,  # (F, 3)
    face_object: Ints1,  # (F,)
    T_world_camera: Pose,  # (3, 4)
    intrinsics: Intrinsics,
    nearest: DepthBuffer,  # (H, W)
    # out:
    depth: Floats2,  # (H, W) [m], 0 where nothing is seen
    cosine: Floats2,  # (H, W) of the angle between ray and normal
    object: Ints2,  # (H, W), -1 where nothing is seen
):
    """Depth, incidence and object at the centre of every pixel."""
    for v, u in nearest:
        depth[v, u], cosine[v, u], object[v, u] = 0.0, 0.0, -1
        if nearest[v, u] != ti.i64(EMPTY):
            f = ti.cast(nearest[v, u] & ti.i64(0xFFFFFFFF), ti.i32)
            a = row3(vertices, faces[f, 0])
            n = (row3(vertices, faces[f, 1]) - a).cross(row3(vertices, faces[f, 2]) - a)
            along = rotate(T_world_camera, ray(u, v, intrinsics))
            depth[v, u] = depth_of(nearest[v, u])
            cosine[v, u] = ti.abs(n.dot(along)) / (n.norm() * along.norm() + 1e-20)
            object[v, u] = face_object[f]
