"""Frames of one window whose intrinsics differ a little: each votes with its own."""

from __future__ import annotations

import numpy as np
import pytest
from windows import CAMERA, place_of, seen_from, stepped, windows

from taichi_unifusion import PinholeCamera
from taichi_unifusion.maps.kept_window import KeptViews
from taichi_unifusion.maps.lenses import lens_beside, nearly_same, through_lenses

FOCUS = [
    PinholeCamera(64, 48, 55.0 + 1.3 * n, 55.0 + 1.1 * n, 31.5 + 0.7 * n, 23.5 - 0.4 * n)
    for n in range(4)
]


@pytest.fixture(scope="module")
def frames():
    return [seen_from(place_of(n), n + 1, camera) for n, camera in enumerate(FOCUS)]


def test_pixels_and_depths_are_those_of_the_view():
    points = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 4), (50, 3))
    T = np.stack([place_of(n) for n in range(4)])
    lenses = np.stack([lens_beside(camera, CAMERA) for camera in FOCUS])
    for camera, T_view, moved in zip(FOCUS, T, through_lenses(T, lenses), strict=True):
        own = points @ T_view[:3, :3].T + T_view[:3, 3]
        seen = points @ moved[:, :3].T + moved[:, 3]
        np.testing.assert_allclose(CAMERA.project(seen), camera.project(own), rtol=1e-5)
        np.testing.assert_allclose(seen[:, 2], own[:, 2], rtol=1e-6)


def test_frames_of_an_autofocus_share_a_window_and_vote_each_with_its_own_camera(frames):
    """What views voted together, each takes back by itself, to the last vote."""
    assert windows(frames) == [1, 2, 3, 0]
    surface = stepped(frames).surface
    assert (surface.voxels().evidence > 0).any()
    for frame in frames:
        T = np.linalg.inv(frame.T_world_camera)[None, :3].astype(np.float32)
        depth = frame.depth[None]
        surface.vote(depth, frame.camera, np.ascontiguousarray(T), (0, len(surface)), sign=-1)
    assert not surface.voxels().evidence.any()


def test_kept_views_look_through_their_lenses(frames):
    lenses = np.stack([lens_beside(f.camera, CAMERA) for f in frames])
    T = np.stack([f.T_world_camera for f in frames])
    views = KeptViews(np.zeros((4, 24, 32), np.uint16), CAMERA.resized(32, 24), T, lenses)
    np.testing.assert_allclose(
        views.T_camera_world(np.eye(4)), through_lenses(np.linalg.inv(T), lenses), atol=1e-6
    )


def test_another_size_or_a_zoom_is_another_camera():
    assert nearly_same(CAMERA, FOCUS[3])
    assert not nearly_same(CAMERA, CAMERA.resized(32, 24))
    assert not nearly_same(CAMERA, PinholeCamera(64, 48, 70.0, 70.0, 31.5, 23.5))
