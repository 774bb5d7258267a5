"""Slow twins of rendering/kernels/solids.py and textures.py: every ray against every solid, in
float64 NumPy, without tiles.
"""

from __future__ import annotations

import numpy as np

from taichi_unifusion.rendering.kernels import solids
from taichi_unifusion.rendering.kernels.solids import BOX, CYLINDER, ROOM, SPHERE
from taichi_unifusion.rendering.kernels.textures import GRAIN_CELLS, GROUND, PATTERNS

TAU = 2 * np.pi
LAMPS = ((-1.5, 0.2, 1.9, 0.34), (0.4, 0.0, 2.3, 0.30))  # world [m], strength


# ---- Solids ----


def cast_rays(camera, shapes, T_local_camera):
    """Depth (0: no hit) and solid (-1: no hit), each (H, W)."""
    rays = camera.rays().reshape(-1, 3)
    best, winner = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for j, (shape, T) in enumerate(zip(shapes, T_local_camera.astype(float), strict=True)):
        t = hit_parameter(shape, T[:, 3], rays @ T[:, :3].T)
        best, winner = np.where(t < best, t, best), np.where(t < best, j, winner)
    size = camera.height, camera.width
    return np.where(winner < 0, 0, best).reshape(size), winner.reshape(size)


def hit_parameter(shape, o, d):
    """First t > 0 (N,) at which rays o + t d (N, 3) enter the unit solid (leave it, for the room),
    inf if they do not.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort([(-1 - o) / d, (1 - o) / d], axis=0)  # (2, N, 3)
        if shape in (ROOM, BOX):
            enter, leave = ends[0].max(axis=1), ends[1].min(axis=1)
        else:
            flat = np.array([1.0, 1.0, 1.0 if shape == SPHERE else 0.0])
            a, b, c = ((d * flat) ** 2).sum(1), (d * flat) @ (o * flat), (o * flat) @ (o * flat) - 1
            root = np.sqrt(b * b - a * c)
            enter, leave = (-b - root) / a, (-b + root) / a
            if shape == CYLINDER:
                enter, leave = np.maximum(enter, ends[0, :, 2]), np.minimum(leave, ends[1, :, 2])
        t = leave if shape == ROOM else enter
        return np.where((enter < leave) & (t > 0), t, np.inf)


def hash32(x):
    """A well-mixed 32-bit integer of a 32-bit integer."""
    x = np.asarray(x, np.uint64) & 0xFFFFFFFF
    x = (x ^ x >> np.uint64(16)) * np.uint64(0x7FEB352D) & np.uint64(0xFFFFFFFF)
    x = (x ^ x >> np.uint64(15)) * np.uint64(0x846CA68B) & np.uint64(0xFFFFFFFF)
    return x ^ x >> np.uint64(16)


def uniform(x):
    """A number in (0, 1) of a 32-bit integer."""
    return ((hash32(x) >> np.uint64(9)) + 0.5) / 2**23


def gaussians(key):
    """Two independent standard normal numbers of a 32-bit key (Box-Muller)."""
    radius = np.sqrt(-2 * np.log(uniform(key)))
    angle = TAU * uniform(key ^ np.uint64(0x68E31DA4))
    return radius * np.cos(angle), radius * np.sin(angle)


def kinect_depth(exact, cosine, closest, seed, frame, fx):
    """What a Kinect v1 would read, (H, W) [m], 0 where no reading."""
    height, width = exact.shape
    stream = hash32(np.uint64(seed) ^ hash32(np.uint64(frame ^ 0x9E3779B9)))
    depth = np.zeros(exact.shape)
    for v, u in np.ndindex(exact.shape):
        key = hash32(stream ^ np.uint64(v * width + u))
        down, right = gaussians(key)
        y = int(np.clip(np.rint(v + solids.LATERAL * down), 0, height - 1))
        x = int(np.clip(np.rint(u + solids.LATERAL * right), 0, width - 1))
        if abs(exact[y, x] - exact[v, u]) < solids.EDGE_GAP * exact[v, u]:
            y, x = v, u
        z, theta = float(exact[y, x]), np.arccos(np.clip(cosine[y, x], 0, 1))
        seen = np.clip((theta - 1.2) / (1.48 - 1.2), 0, 1)
        seen = 1 - seen * seen * (3 - 2 * seen)
        dark = in_projector_shadow(exact, y, x, solids.BASELINE * fx, closest)
        if z > 0 and not dark and uniform(key ^ np.uint64(0xB5297A4D)) < seen:
            sigma = solids.AXIAL[0] + solids.AXIAL[1] * (z - 0.4) ** 2
            if theta > 1.05:
                sigma += solids.GRAZING / np.sqrt(z) * (theta / (1.5708 - theta)) ** 2
            z += sigma * gaussians(key ^ np.uint64(0x1B56C4E9))[0]
            steps = np.rint(solids.DISPARITY_STEPS / max(z, 0.1))
            reading = np.rint(1000 * solids.DISPARITY_STEPS / steps) / 1000
            if solids.NEAR_LIMIT <= reading <= solids.FAR_LIMIT:
                depth[v, u] = reading
    return depth


def in_projector_shadow(exact, y, x, baseline_focal, closest) -> bool:
    """Whether something to the right hides the point at (y, x) from the projector on that side."""
    z = float(exact[y, x])
    reach = int(baseline_focal * (1 / closest - 1 / max(z, closest)))
    beside = exact[y, x + 1 : x + 1 + max(reach, 0)].astype(float)
    k = np.arange(1, len(beside) + 1)
    return bool(((beside > 0) & (beside * (baseline_focal + k * z) <= baseline_focal * z)).any())


# ---- Textures ----


def shade_surfaces(camera, T_world_camera, room, depth, hit, arrays, T_local_camera):
    """Colour (H, W, 3), 0..255, and cosine of incidence (H, W) of what every pixel sees. `room` is
    its lowest and highest corner; `arrays` has shapes, half_extents, materials, patterns, looks and
    ground, as the kernel takes them.
    """
    color, cosine = np.zeros((*depth.shape, 3)), np.zeros(depth.shape)
    rays, low, high = camera.rays(), *room
    for v, u in zip(*np.nonzero(hit >= 0), strict=True):
        j, ray = hit[v, u], rays[v, u]
        at, half = depth[v, u] * ray, arrays.half_extents[j].astype(float)
        A, b = T_local_camera[j, :, :3].astype(float), T_local_camera[j, :, 3].astype(float)
        p = A @ at + b
        n_local = unit_normal(arrays.shapes[j], p)
        n_camera = A.T @ n_local / np.linalg.norm(A.T @ n_local)
        cosine[v, u] = abs(n_camera @ ray) / np.linalg.norm(ray)
        n = T_world_camera[:3, :3] @ n_camera
        x = T_world_camera[:3, :3] @ at + T_world_camera[:3, 3]
        face = 0 if n_local[0] else 1 if n_local[1] else 2 if p[2] < 0 else 3
        m = arrays.materials[j, face]
        look = arrays.looks[m].astype(float)
        q = p * half
        q[longest_axis(half)] /= look[2]  # grain runs along it
        grain = grain_at(q, 11 * j)
        second, third, tone = pattern_weights(
            arrays.patterns[m],
            look[0],
            surface_coordinates(arrays.shapes[j], n_local, p, half),
            grain,
            int(j),
        )
        rgb = mix(mix(look[3:6], look[6:9], second), look[9:12], third)
        rgb *= tone * (1 + look[1] * (np.array([0.5, 0.8, 0.7]) @ grain - 1))
        rgb *= daylight(x, n, low, high)
        if x[2] < GROUND and n[2] > 0.5:
            rgb *= bilinear(arrays.ground, (x - low)[:2] / (high - low)[:2])
        color[v, u] = 255 * np.clip(rgb, 0, 1)
    return color, cosine


def longest_axis(half) -> int:
    """The first of the longest half axes, as the kernel chooses."""
    return int(np.argmax(half))


def mix(a, b, share):
    return a * (1 - share) + b * share


def smoothstep(low, high, x):
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def lattice(i, j, k, seed):
    """A number in (0, 1) for each corner of an integer lattice."""
    factors = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F)
    key = 0
    for number, factor in zip((i, j, k, seed), factors, strict=True):
        key ^= int(number) * factor & 0xFFFFFFFF
    return float(uniform(np.uint64(key)))


def grain_at(q, seed):
    """Three octaves of solid value noise at q [m], coarse to fine, each in (0, 1)."""
    octaves = []
    for o, cell in enumerate(GRAIN_CELLS):
        base = np.floor(q / cell)
        f = q / cell - base
        f = f * f * (3 - 2 * f)
        octaves.append(
            sum(
                np.prod(np.where(corner, f, 1 - f)) * lattice(*(base + corner), seed + o)
                for corner in np.ndindex(2, 2, 2)
            )
        )
    return np.array(octaves)


def line(x, period, width):
    """1 on soft lines of the given width at the multiples of period, 0 between them [m]."""
    return 1 - smoothstep(0.3 * width, 0.7 * width, abs(x - period * np.rint(x / period)))


def unit_normal(shape, p):
    """Normal of the unit solid's surface at its point p, not normalised; into the room for it."""
    if shape == SPHERE:
        return p
    if shape == CYLINDER:
        return np.array([p[0], p[1], 0]) if p[0] ** 2 + p[1] ** 2 > abs(p[2]) else p * (0, 0, 1)
    n = np.zeros(3)
    axis = np.argmax(np.abs(p))
    n[axis] = p[axis]
    return -n if shape == ROOM else n


def surface_coordinates(shape, n, p, half):
    """Coordinates (s, t) on the face of p and its half extents (S, T) [m]; s runs along the longer
    side.
    """
    q = p * half
    if (shape == CYLINDER and n[2] == 0) or shape == SPHERE:
        return np.arctan2(p[1], p[0]) * half[0], q[2], TAU / 2 * half[0], half[2]
    if shape == CYLINDER:
        return q[0], q[1], half[0], half[1]
    i, k = [axis for axis in range(3) if n[axis] == 0]
    s, t, S, T = q[i], q[k], half[i], half[k]
    return (t, s, T, S) if T > S else (s, t, S, T)


def pattern_weights(pattern, size, st, grain, seed):
    """Weights of a material's second and third colour and a tone factor."""
    s, t, S, T = st
    second, third, tone = grain[1], 0.0, 1.0
    name = list(PATTERNS)[pattern]
    if name == "planks":
        rank = np.floor(t / size)
        along = s / (8 * size) + 0.37 * rank
        tone = 0.86 + 0.28 * lattice(rank, np.floor(along), 0, seed)
        third = max(line(t, size, 0.008), line(along * 8 * size, 8 * size, 0.008))
    elif name == "wallpaper":
        rank = np.floor(s / size + 0.5)
        odd = rank % 2
        second = 0.8 * odd + 0.2 * grain[1]
        a, b = s - size * rank, t - size * (np.rint(t / size - 0.5 * odd) + 0.5 * odd)
        third = line(abs(a) + 0.7 * abs(b) - 0.2 * size, 10, 0.016)
        third += 1 - smoothstep(0.006, 0.012, np.hypot(a, b))
    elif name == "weave":
        second = 0.5 + 0.25 * np.sin(s * TAU / size) + 0.25 * np.sin(t * TAU / size)
        third = 0.6 * max(line(s, 6 * size, 0.4 * size), line(t, 6 * size, 0.4 * size))
    elif name == "bands":
        second = line(t, size, 0.3 * size)
        third = line(t - 0.35 * size, size, 0.12 * size) * smoothstep(0.3, 0.4, grain[2])
    elif name == "landscape":
        x, y = s / S, t / T
        ridge = 0.35 * np.sin(2.3 * x + seed) + 0.14 * np.sin(7.1 * x + 2 * seed)
        ridge += 0.25 * (grain[1] - 0.5)
        second = smoothstep(-0.04, 0.04, 0.1 + ridge - y)
        third = smoothstep(-0.05, 0.05, -0.35 - 0.7 * ridge - y)
        tone = 1 + 0.25 * y - 0.35 * line(min(S - abs(s), T - abs(t)), 10, 0.05)
    elif name == "mosaic":
        i, j = np.floor(s / size), np.floor(t / size)
        second = np.floor(3 * lattice(i, j, 1, seed)) / 2
        third = float(lattice(i, j, 2, seed) > 0.72)
        joint = max(line(s, size, 0.008), line(t, size, 0.008))
        tone = (0.8 + 0.3 * lattice(i, j, 3, seed)) * (1 - 0.4 * joint)
    elif name == "rug":
        border = min(S - abs(s), T - abs(t))
        inner = smoothstep(0.16, 0.17, border)
        r = sum(abs(c - size * np.rint(c / size)) for c in (s, t)) / size
        motif = max(line(r - 0.42, 10, 0.08), 1 - smoothstep(0.14, 0.18, r))
        second = mix(0.5 + 0.5 * np.sin(border * TAU / 0.08), motif, inner)
        third = mix(line(border - 0.12, 10, 0.03), line(r - 0.26, 10, 0.07), inner)
        tone = 0.94 + 0.06 * np.sin(t * TAU / 0.02)
    elif name == "panels":
        rim = max(abs(abs(s) - 0.5 * S) - 0.38 * S, abs(t) - 0.66 * T)
        third = line(rim, 10, 0.022)
        second = 0.6 * (1 - smoothstep(-0.01, 0, rim)) + 0.4 * grain[1]
    elif name == "globe":
        second = smoothstep(0.5, 0.54, 0.65 * grain[0] + 0.35 * grain[1])
        third = 0.7 * line(t, size, 0.008)
    return np.clip(second, 0, 1), np.clip(third, 0, 1), tone


def daylight(x, n, low, high):
    """Soft diffuse light at world point x [m] with normal n."""
    shade = 0.58 + 0.08 * n[2]
    for *place, strength in LAMPS:
        ray = np.array(place) - x
        facing = max(0.0, 0.75 * n @ ray / np.linalg.norm(ray) + 0.25)
        shade += strength * facing / (0.6 + 0.12 * ray @ ray)
    wall = np.maximum(np.minimum(x - low, high - x), 0)
    return shade * np.prod(1 - 0.22 * (1 - np.abs(n)) * np.exp(-wall / 0.16))


def bilinear(values, share):
    """Values (X, Y) at a place given as shares of both sides."""
    at = share * (np.array(values.shape) - 1)
    i, j = np.clip(at.astype(int), 0, np.array(values.shape) - 2)
    a, b = at - (i, j)
    corner = values[i : i + 2, j : j + 2].astype(float)
    return np.array([1 - a, a]) @ corner @ np.array([1 - b, b])
