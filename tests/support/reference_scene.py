"""Slow twins of rendering/kernels/texturing.py: every ray against every triangle, in float64 NumPy."""

from __future__ import annotations

import numpy as np
from reference_raster import barycentric, in_camera, rasterize

from taichi_unifusion.rendering.kernels.texturing import MAX_TAPS, SAMPLES, SHADE, SLACK
from taichi_unifusion.rendering.textured_scene import BACKGROUND, LIGHT, TexturedScene, mip_levels
from taichi_unifusion.types import PinholeCamera

STEP = 1e-4  # [px] of the finite differences


def cast(scene: TexturedScene, camera: PinholeCamera, T_world_camera: np.ndarray):
    """Depth (0: no hit), triangle (-1) and how near to an edge of any triangle, each (H, W), at the
    pixels' centres.
    """
    return rasterize(scene.vertices, scene.faces, True, camera, T_world_camera, 0.0)[:3]


def read_surfaces(scene: TexturedScene, camera: PinholeCamera, T_world_camera: np.ndarray):
    """Depth, cosine of incidence and object at the pixels' centres, and the margin of `cast`, each
    (H, W).
    """
    depth, face, margin = cast(scene, camera, T_world_camera)
    rays = camera.rays()
    corners = in_camera(scene.vertices, T_world_camera)[scene.faces]
    n = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[face]
    cosine = (
        np.abs((n * rays).sum(axis=-1)) / np.linalg.norm(n, axis=-1) / np.linalg.norm(rays, axis=-1)
    )
    return (
        depth,
        np.where(face < 0, 0, cosine),
        np.where(face < 0, -1, scene.face_object[face]),
        margin,
    )


def shade_textured(scene: TexturedScene, camera: PinholeCamera, T_world_camera: np.ndarray):
    """Colour (H, W, 3) of every pixel, 0..255, and whether (H, W) all its samples are clear of
    edges.
    """
    finer = camera.resized(camera.width * SAMPLES, camera.height * SAMPLES)
    _, face, margin = cast(scene, finer, T_world_camera)
    sure = blocks(margin > 1e-4).all(axis=-1)
    pyramids = [[level / 255.0 for level in mip_levels(texture)] for texture in scene.textures]
    local = in_camera(scene.vertices, T_world_camera)
    image = np.zeros((camera.height, camera.width, 3))
    seen = blocks(face)  # (H, W, SAMPLES^2)
    for y, x in np.ndindex(image.shape[:2]):
        for f, count in zip(*np.unique(seen[y, x], return_counts=True), strict=True):
            i = np.flatnonzero(seen[y, x] == f)
            at = x * SAMPLES + (i % SAMPLES).mean(), y * SAMPLES + (i // SAMPLES).mean()
            rgb = (
                np.array(BACKGROUND)
                if f < 0
                else shade_triangle(scene, pyramids, finer, local, T_world_camera, f, *at)
            )
            image[y, x] += np.clip(rgb, 0, 1) * count / SAMPLES**2
    return 255 * image, sure


def blocks(samples: np.ndarray) -> np.ndarray:
    """(s H, s W) as (H, W, s^2)."""
    height, width = (size // SAMPLES for size in samples.shape)
    return (
        samples.reshape(height, SAMPLES, width, SAMPLES).swapaxes(1, 2).reshape(height, width, -1)
    )


def shade_triangle(scene, pyramids, camera, local, T_world_camera, f, u, v):
    """Colour of triangle f around the point (u, v) of the finer image."""
    corners = local[scene.faces[f]]

    def weights_at(u, v):
        return np.clip(barycentric(corners, camera.rays([u], [v]))[1][0], 0, None)

    w = weights_at(u, v)
    w /= w.sum()
    rgb = w @ scene.colors[scene.faces[f]]
    if scene.face_texture[f] >= 0:
        uv = scene.corners[f].reshape(3, 2).astype(float)

        def uv_at(u, v):
            return barycentric(corners, camera.rays([u], [v]))[1][0] @ uv

        along_u = SAMPLES * (uv_at(u + STEP, v) - uv_at(u - STEP, v)) / (2 * STEP)
        along_v = SAMPLES * (uv_at(u, v + STEP) - uv_at(u, v - STEP)) / (2 * STEP)
        rgb = rgb * sample_texture(pyramids[scene.face_texture[f]], w @ uv, along_u, along_v)
    n = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    n = T_world_camera[:3, :3] @ n * -np.sign(n @ corners[0]) / np.linalg.norm(n)
    return rgb * (1 - SHADE * (0.5 - 0.5 * n @ np.array(LIGHT) / np.linalg.norm(LIGHT)))


def sample_texture(pyramid, st, along_u, along_v):
    """Mean colour of a texture over the parallelogram around st that the two steps span."""
    size = np.array(pyramid[0].shape[1::-1])
    a, b = along_u * size, along_v * size
    long = along_u if np.linalg.norm(a) >= np.linalg.norm(b) else along_v
    major = max(np.linalg.norm(a), np.linalg.norm(b), 1e-6)
    minor = abs(a[0] * b[1] - a[1] * b[0]) / major
    taps = int(np.clip(np.ceil(major / max(minor, 1.0) - SLACK), 1, MAX_TAPS))
    lod = np.clip(np.log2(max(major / taps, 1.0)), 0, len(pyramid) - 1)
    level = min(int(lod), max(len(pyramid) - 2, 0))
    total = np.zeros(3)
    for k in range(taps):
        at = st + ((k + 0.5) / taps - 0.5) * long
        total += (1 - (lod - level)) * bilinear(pyramid[level], at)
        if lod > level:
            total += (lod - level) * bilinear(pyramid[level + 1], at)
    return total / taps


def bilinear(level: np.ndarray, st: np.ndarray) -> np.ndarray:
    """Colour of one mip level at st, which repeats with period 1."""
    height, width = level.shape[:2]
    x, y = (st - np.floor(st)) * (width, height) - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    return sum(
        wy * wx * level[(y0 + i) % height, (x0 + j) % width]
        for i, wy in ((0, 1 - fy), (1, fy))
        for j, wx in ((0, 1 - fx), (1, fx))
    )
