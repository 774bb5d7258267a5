"""Slow twins of rendering/kernels/raster.py: every ray against every triangle, in float64 NumPy."""

from __future__ import annotations

import numpy as np

from taichi_unifusion.rendering.kernels.raster import (
    GOLDEN_ANGLE,
    LIFT,
    OCCLUSION_BIAS,
    OCCLUSION_GAIN,
    OCCLUSION_SHARE,
    ONE_SURFACE,
)
from taichi_unifusion.types import PinholeCamera


def in_camera(vertices: np.ndarray, T_world_camera: np.ndarray) -> np.ndarray:
    """Vertices (V, 3) in the camera frame."""
    return (vertices.astype(float) - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]


def barycentric(corners: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth (N,) and barycentric coordinates (N, 3) at which rays (N, 3) meet the plane of a
    triangle (3, 3), camera frame.
    """
    a, b, c = corners
    n = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (n @ a) / (rays @ n)
    p = rays * z[:, None]
    return z, np.stack(
        [np.cross(q - p, r - p) @ n for q, r in ((b, c), (c, a), (a, b))], axis=1
    ) / (n @ n)


def rasterize(
    vertices: np.ndarray,
    faces: np.ndarray,
    two_sided: bool,
    camera: PinholeCamera,
    T_world_camera: np.ndarray,
    near: float,
):
    """Depth (0: no hit), triangle (-1: no hit), how near to an edge of a triangle in barycentric
    coordinates, and how near to the near plane [m], each (H, W), at the pixels' centres.
    """
    rays = camera.rays().reshape(-1, 3)
    depth, face = np.full(len(rays), np.inf), np.full(len(rays), -1)
    margin, plane = np.full(len(rays), np.inf), np.full(len(rays), np.inf)
    for f, corners in enumerate(in_camera(vertices, T_world_camera)[faces]):
        z, weights = barycentric(corners, rays)
        n = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        drawn = np.isfinite(z) & (z > 0) & (two_sided | (rays @ n < 0))
        margin = np.where(drawn, np.minimum(margin, np.abs(weights).min(axis=1)), margin)
        plane = np.where(drawn, np.minimum(plane, np.abs(z - near)), plane)
        nearer = drawn & (z >= near) & (weights.min(axis=1) >= 0) & (z < depth)
        depth, face = np.where(nearer, z, depth), np.where(nearer, f, face)
    shape = camera.height, camera.width
    return tuple(x.reshape(shape) for x in (np.where(face < 0, 0, depth), face, margin, plane))


def thin_out(depth: np.ndarray, thinned: int) -> np.ndarray:
    """Every `thinned`-th pixel of a depth image (H, W), along both axes."""
    rows, columns = (range(0, size, thinned) for size in depth.shape)
    return np.array([[depth[v, u] for u in columns] for v in rows])


def shade_pixels(
    vertices, normals, colors, faces, camera, T_world_camera, seen, depth, look, samples, thinned
):
    """Colour (H, W, 3) of every pixel, 0..255, whose samples see triangles `seen` at `depth`, both
    (samples H, samples W) of `camera`. `look` has light, shading, radius, taps and background. What
    is hidden is looked up in every `thinned`-th sample, and shared by samples of one surface.
    """
    image = np.zeros((*seen.shape, 3))
    rays, local = camera.rays(), in_camera(vertices, T_world_camera)
    R_camera_world = T_world_camera[:3, :3].T
    hidden = np.zeros((seen.shape[0] // samples, seen.shape[1] // samples, 2))  # and where, [m]
    for v, u in np.ndindex(seen.shape):
        pixel = v // samples, u // samples
        image[v, u] = look["background"]
        if seen[v, u] >= 0:
            corner = faces[seen[v, u]]
            w = np.clip(barycentric(local[corner], rays[v, u][None])[1][0], 0, None)
            w /= w.sum()
            n = R_camera_world @ (w @ normals[corner])
            n /= np.linalg.norm(n) + 1e-9
            lit = (0.5 + 0.5 * n @ look["light"]) * LIFT
            image[v, u] = w @ colors[corner]
            image[v, u] *= 1 - look["shading"] + look["shading"] * lit
            if abs(depth[v, u] - hidden[pixel][1]) > ONE_SURFACE * depth[v, u]:
                share = occlusion(depth, v, u, n, camera, look, thinned)
                hidden[pixel] = share, depth[v, u]
            image[v, u] *= 1 - OCCLUSION_SHARE * hidden[pixel][0]
    height, width = (size // samples for size in seen.shape)
    blocks = np.clip(image, 0, 1).reshape(height, samples, width, samples, 3)
    return 255 * blocks.mean(axis=(1, 3))


def occlusion(depth, v, u, n, camera, look, thinned) -> float:
    """How much of the sky over a sample its surroundings hide, 0..1."""
    rays, radius, taps = camera.rays(), look["radius"], look["taps"]
    at = depth[v, u] * rays[v, u]
    reach = min(
        radius * camera.fx / depth[v, u], 0.25 * -(-depth.shape[1] // thinned) * thinned
    )  # [px]
    turn = 2 * np.pi * np.modf(52.9829189 * np.modf(0.06711056 * u + 0.00583715 * v)[0])[0]
    hidden = 0.0
    for k in range(taps):
        r, angle = reach * (k + 0.5) / taps, turn + k * GOLDEN_ANGLE
        last_y, last_x = ((size - 1) // thinned for size in depth.shape)
        y = int(np.clip(np.rint((v + r * np.sin(angle)) / thinned), 0, last_y)) * thinned
        x = int(np.clip(np.rint((u + r * np.cos(angle)) / thinned), 0, last_x)) * thinned
        if depth[y, x] > 0:
            d = depth[y, x] * rays[y, x] - at
            length = np.linalg.norm(d) + 1e-6
            hidden += max(0.0, n @ d / length - OCCLUSION_BIAS) * max(0.0, 1 - length / radius)
    return min(1.0, OCCLUSION_GAIN * hidden / taps)
