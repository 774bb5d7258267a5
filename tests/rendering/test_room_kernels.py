"""The kernels of the synthetic room against their slow twins."""

from __future__ import annotations

import numpy as np
import pytest
import reference_room as reference

from taichi_unifusion import PinholeCamera, runtime
from taichi_unifusion.datasets.synthetic import SyntheticRoom

ROOM = SyntheticRoom(frames=7, width=96, height=72)
DEPTH = 2e-5  # [m] float32 against float64 at up to 6 m
SAME_SOLID = 0.99  # share of pixels: in the others two solids touch, at the same depth
SAME_READING = 0.999  # share of pixels: the others lie between two steps of a rounding
SAME_COLOR = 0.995  # share of pixels: the others lie on an edge within a pattern
STEP = 1.0  # of 255: colours are rounded to whole numbers
COSINE = 2e-5


@pytest.mark.parametrize("index", [0, 3, 5])
def test_cast_rays_equals_its_twin(index):
    T_world_camera = ROOM.T_world_camera[index]
    depth, hit = ROOM._scene.cast(ROOM.camera, T_world_camera)
    expected, solid = reference.cast_rays(
        ROOM.camera, ROOM._scene.shapes, (ROOM._scene.T_local_world @ T_world_camera)[:, :3]
    )
    np.testing.assert_allclose(depth, expected, atol=DEPTH)
    assert (hit == solid).mean() > SAME_SOLID


def test_kinect_depth_equals_its_twin():
    """On slopes, steps, a shadow of the projector and a hole."""
    runtime.current()
    from taichi_unifusion.rendering.kernels.solids import kinect_depth

    v, u = np.mgrid[:48, :64]
    exact = (1.5 + 0.02 * u + 0.01 * v).astype(np.float32)
    exact[10:30, 20:34], exact[:5, :9] = 0.9, 0
    cosine = (0.05 + 0.95 * u / 63).astype(np.float32)
    depth = np.zeros_like(exact)
    kinect_depth(exact, cosine, 0.9, 7, 11, 60.0, depth)
    expected = reference.kinect_depth(exact, cosine, 0.9, 7, 11, 60.0)
    assert (np.abs(depth - expected) < DEPTH).mean() > SAME_READING
    assert 0.3 < (expected > 0).mean() < 0.95


@pytest.mark.parametrize("index", [0, 3])
def test_shade_surfaces_equals_its_twin(index):
    scene, T_world_camera = ROOM._scene, ROOM.T_world_camera[index]
    camera = PinholeCamera(64, 48, 58, 58, 31.5, 23.5)
    depth, hit = scene.cast(camera, T_world_camera)
    color, cosine = scene.shade(camera, T_world_camera, depth, hit)
    expected, expected_cosine = reference.shade_surfaces(
        camera,
        T_world_camera,
        (scene.corners[0, 0], scene.corners[0, -1]),
        depth.astype(float),
        hit,
        scene,
        (scene.T_local_world @ T_world_camera)[:, :3],
    )
    same = np.abs(color - expected).max(axis=2) < STEP
    assert same.mean() > SAME_COLOR
    assert (np.abs(cosine - expected_cosine) < COSINE).mean() > SAME_COLOR
