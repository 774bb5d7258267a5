"""The rasteriser's kernels against their slow twins."""

from __future__ import annotations

import numpy as np
import pytest
import reference_raster as reference

from taichi_unifusion import PinholeCamera
from taichi_unifusion.rendering.depth_buffer import draw_depth_buffer

CAMERA = PinholeCamera(80, 60, 50, 52, 39.2, 30.1)
NEAR = 0.4
CLEAR = 1e-5  # of an edge in barycentric coordinates, and of the near plane [m]
DEPTH = 2e-6  # relative: float32 depth
STEP = 0.51  # of 255: colours are rounded to whole numbers
TAPS_MOVED = 0.02  # share of pixels where float32 rounds a sample's place to another pixel


def pose() -> np.ndarray:
    T_world_camera = np.eye(4)
    a = np.radians(25)
    T_world_camera[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    T_world_camera[:3, 3] = 0.3, -0.2, 0.1
    return T_world_camera


def soup(count: int, spread: float, seed: int = 0):
    """Vertices and faces of triangles anywhere around the camera."""
    rng = np.random.default_rng(seed)
    center = rng.uniform((-3, -2, -2), (3, 2, 6), (count, 1, 3))
    vertices = (center + rng.normal(0, spread, (count, 3, 3))).reshape(-1, 3).astype(np.float32)
    return vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def drawn(vertices, faces, camera, *, two_sided: bool):
    """The depth buffer that `rasterize` fills."""
    return draw_depth_buffer(vertices, faces, camera, pose(), NEAR, two_sided=two_sided)


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize(("count", "spread"), [(1000, 0.3), (100, 4.0)])
def test_rasterize_equals_its_twin(count, spread, two_sided):
    vertices, faces = soup(count, spread)
    found = drawn(vertices, faces, CAMERA, two_sided=two_sided)
    depth, face, margin, plane = reference.rasterize(
        vertices, faces, two_sided, CAMERA, pose(), NEAR
    )
    sure = (margin > CLEAR) & (plane > CLEAR)
    assert sure.mean() > 0.95 and (face >= 0).mean() > 0.3
    np.testing.assert_array_equal(found.triangle()[sure], face[sure])
    np.testing.assert_allclose(found.depth(0.0)[sure], depth[sure], rtol=DEPTH)


@pytest.mark.parametrize("radius", [1e-9, 0.4])
def test_shade_pixels_equals_its_twin(radius):
    """Nothing occludes within a nanometre: there every pixel agrees."""
    from taichi_unifusion.rendering.kernels.raster import shade_pixels, thin_out

    samples, thinned, (vertices, faces) = 2, 4, soup(150, 0.6, seed=1)
    finer = CAMERA.resized(CAMERA.width * samples, CAMERA.height * samples)
    buffer = drawn(vertices, faces, finer, two_sided=False)
    rng = np.random.default_rng(2)
    normals = rng.normal(size=vertices.shape).astype(np.float32)
    colors = rng.uniform(size=vertices.shape).astype(np.float32)
    light = np.array([-0.4, -0.8, -0.4]) / np.linalg.norm([-0.4, -0.8, -0.4])
    look = {
        "light": light,
        "shading": 0.5,
        "radius": radius,
        "taps": 4,
        "background": (0.9, 0.8, 0.7),
    }
    depth = np.empty((-(-finer.height // thinned), -(-finer.width // thinned)), np.float32)
    thin_out(buffer.nearest, thinned, depth)
    np.testing.assert_array_equal(depth, reference.thin_out(buffer.depth(0.0), thinned))
    image = np.empty((CAMERA.height, CAMERA.width, 3), np.uint8)
    shade_pixels(
        vertices,
        normals,
        colors,
        faces,
        buffer.projection,
        np.linalg.inv(pose())[:3],
        finer.intrinsics,
        buffer.nearest,
        depth,
        (*light, look["shading"]),
        look["radius"],
        (look["taps"], thinned),
        look["background"],
        image,
    )
    expected = reference.shade_pixels(
        vertices,
        normals,
        colors,
        faces,
        finer,
        pose(),
        buffer.triangle(),
        buffer.depth(0.0).astype(float),
        look,
        samples,
        thinned,
    )
    error = np.abs(image - expected).max(axis=2)
    assert (buffer.triangle() >= 0).mean() > 0.2
    assert (error > STEP).mean() <= (TAPS_MOVED if radius > 1e-3 else 0)
