"""The camera of a window: what turns, what flies, and that up stays up."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.datasets.synthetic import look_at
from taichi_unifusion.viewer.orbit import FARTHEST, NEAREST, Orbit

UPS = [np.array([0, 0, 1.0]), np.array([0, -1.0, 0]), np.array([0.6, 0, 0.8])]


def orbit(up) -> Orbit:
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    return Orbit(2.5 * side / np.linalg.norm(side) + up, np.array([0.1, 0.2, 0.3]), up)


@pytest.mark.parametrize("up", UPS)
def test_turning_keeps_distance_target_and_height(up):
    before = orbit(up)
    after = before.turned(0.2, 0.0)
    assert np.isclose(after.distance, before.distance)
    assert np.array_equal(after.target, before.target)
    assert np.isclose(after.eye @ up, before.eye @ up) and not np.allclose(after.eye, before.eye)
    assert np.allclose(after.turned(-0.2, 0.0).eye, before.eye)
    # the scene follows the mouse: dragged to the right, the eye goes to the left
    assert (after.eye - before.eye) @ before.right < 0
    raised = before.turned(0.0, -0.1)
    assert raised.eye @ up > before.eye @ up  # dragged downwards, one looks from higher up


@pytest.mark.parametrize("up", UPS)
def test_no_drag_turns_over_the_top(up):
    view = orbit(up)
    for _ in range(50):
        view = view.turned(0.03, -0.07)
        assert abs(view.forward @ up) < 0.999 and np.isclose(view.right @ up, 0)
        assert np.isclose(np.linalg.norm(view.right), 1)
    for _ in range(100):
        view = view.turned(0.0, 0.07)
    assert view.forward @ up > 0.8  # and all the way down again


def test_looking_around_keeps_the_eye():
    before = orbit(UPS[0])
    after = before.looked_around(0.1, 0.05)
    assert np.array_equal(after.eye, before.eye) and np.isclose(after.distance, before.distance)
    assert (after.forward - before.forward) @ before.right < 0  # the picture follows the mouse


def test_flying_moves_eye_and_target():
    before = orbit(UPS[0])
    after = before.flown(1.0, 0.5, 2.0)
    assert np.allclose(after.eye - before.eye, after.target - before.target)
    assert np.isclose(np.linalg.norm(before.flown(0, 0, 2).eye - before.eye), 2)
    assert np.isclose((before.flown(0, 1, 0).eye - before.eye) @ UPS[0], 1)


def test_zoom_has_ends():
    view = orbit(UPS[0])
    assert view.zoomed(1).distance < view.distance < view.zoomed(-1).distance
    assert np.isclose(view.zoomed(3).zoomed(-3).distance, view.distance)
    assert np.isclose(view.zoomed(1000).distance, NEAREST)
    assert np.isclose(view.zoomed(-1000).distance, FARTHEST)


def test_from_a_pose():
    T = look_at((1, 2, 3), (4, 2, 1))
    view = Orbit.of_pose(T, 1.5, UPS[0])
    assert np.allclose(view.eye, (1, 2, 3)) and np.allclose(view.forward, T[:3, 2])
    assert np.allclose(view.right, T[:3, 0])
    straight_down = Orbit(np.array([0, 0, 3.0]), np.zeros(3), UPS[0])
    assert np.isclose(np.linalg.norm(straight_down.right), 1)
