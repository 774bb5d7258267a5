"""Ways of a camera through a scene: smooth, level, and everything stays in the picture."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.datasets.synthetic import look_at
from taichi_unifusion.viewer.paths import (
    circle_round,
    flight_along,
    flight_seconds,
    is_short,
    level,
    sway,
)
from taichi_unifusion.viewer.render import camera_of

UP = np.array([0.0, 0, 1])
CAMERA = camera_of((160, 90), 50)


def shaky_walk(count: int = 60, shake: float = 0.02) -> np.ndarray:
    """Along x at eye height, looking ahead and a little down, shaken and rolled."""
    rng = np.random.default_rng(0)
    eyes = np.stack([np.linspace(0, 4, count), np.zeros(count), np.full(count, 1.5)], axis=1)
    eyes += rng.normal(0, shake, eyes.shape)
    poses = np.stack([look_at(eye, eye + (1, 0.2, -0.3)) for eye in eyes])
    for T, roll in zip(poses, rng.normal(0, 0.1, count), strict=True):
        c, s = np.cos(roll), np.sin(roll)
        T[:3, :3] = T[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return poses


def is_level(poses: np.ndarray) -> bool:
    return bool(np.abs(poses[:, :3, 0] @ UP).max() < 1e-9)


def are_rigid(poses: np.ndarray) -> bool:
    R = poses[:, :3, :3]
    return bool(np.allclose(R @ R.swapaxes(1, 2), np.eye(3)) and np.allclose(np.linalg.det(R), 1))


def test_a_flight_is_smooth_level_and_near_what_was_walked():
    walked = shaky_walk()
    flown = flight_along(walked, UP, 200)
    assert flown.shape == (200, 4, 4) and are_rigid(flown) and is_level(flown)
    steps = np.diff(flown[:, :3, 3], axis=0)
    assert np.linalg.norm(np.diff(steps, axis=0), axis=1).max() < 0.002  # [m] a step, squared
    pace = np.linalg.norm(steps[10:-10], axis=1)
    assert pace.max() < 2 * pace.min()
    nearest = np.linalg.norm(flown[:, None, :3, 3] - walked[None, :, :3, 3], axis=2).min(axis=1)
    assert nearest.max() < 0.15
    ahead = walked[:, :3, 2].mean(axis=0)
    assert (flown[:, :3, 2] @ ahead / np.linalg.norm(ahead)).min() > 0.98


def test_a_flight_turns_as_its_camera_did():
    """On the spot, once around."""
    poses = np.stack(
        [look_at((0, 0, 1), (np.cos(a), np.sin(a), 0.8)) for a in np.linspace(0, 6, 30)]
    )
    flown = flight_along(poses, UP, 100)
    headings = np.unwrap(np.arctan2(flown[:, 1, 2], flown[:, 0, 2]))
    assert (np.diff(headings) > 0).all() and headings[-1] - headings[0] > 5
    assert np.linalg.norm(flown[:, :3, 3] - (0, 0, 1), axis=1).max() < 1e-9


def test_few_poses_and_poses_that_stay():
    one = shaky_walk()[:1]
    assert flight_along(one, UP, 5).shape == (5, 4, 4)
    assert flight_along(np.repeat(one, 3, axis=0), UP, 4).shape == (4, 4, 4)
    assert is_short(np.repeat(one, 3, axis=0)) and not is_short(shaky_walk())
    assert flight_seconds(one) == 4 and 10 < flight_seconds(shaky_walk(shake=0)) < 20


@pytest.mark.parametrize("up", [UP, np.array([0, -1.0, 0]), np.array([0.6, 0, 0.8])])
def test_a_circle_keeps_everything_in_the_picture(up):
    rng = np.random.default_rng(1)
    points = rng.uniform((-3, -1, 0), (3, 1, 2), (3000, 3))
    poses = circle_round(points, up, CAMERA, 40, start=np.array([1.0, 0.2, 0.3]))
    assert len(poses) == 40 and are_rigid(poses)
    assert np.abs(poses[:, :3, 0] @ up).max() < 1e-9 and (poses[:, :3, 2] @ up < -0.4).all()
    filled = 0.0
    for T in poses:
        seen = CAMERA.project((points - T[:3, 3]) @ T[:3, :3])
        inside = (seen >= -0.5).all(axis=1) & (seen <= (159.5, 89.5)).all(axis=1)
        assert inside.mean() > 0.99
        filled = max(filled, (np.ptp(seen, axis=0) / (160, 90)).max())
    assert filled > 0.7  # no farther off than it has to be
    start = np.array([1.0, 0.2, 0.3])
    level_start, first = (way - way @ up * up for way in (start, poses[0, :3, 2]))
    assert np.allclose(np.cross(first, level_start), 0) and first @ level_start > 0


def test_a_sway_looks_at_one_point_from_both_sides():
    camera = look_at((-2, 0, 1.5), (0, 0, 0.5))
    target = camera[:3, 3] + 2.2 * camera[:3, 2]
    poses = sway(camera, 2.2, UP, 24)
    to_target = target - poses[:, :3, 3]
    assert np.allclose(np.linalg.norm(to_target, axis=1), 2.2) and is_level(poses)
    assert np.allclose(to_target / 2.2, poses[:, :3, 2])
    assert np.allclose(poses[0], camera, atol=1e-9)
    assert poses[:, 1, 3].max() > 0.3 and poses[:, 1, 3].min() < -0.3


def test_looking_straight_down_keeps_the_cameras_own_up():
    forwards = np.array([[0, 0, -1.0]])
    T = level(np.zeros((1, 3)), forwards, np.array([[0, 1.0, 0]]), UP)
    assert are_rigid(T) and np.allclose(T[0, :3, 1], (0, -1, 0))
