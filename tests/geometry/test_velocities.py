"""Velocities of a camera from its poses."""

from __future__ import annotations

import numpy as np

from taichi_unifusion.geometry import se3
from taichi_unifusion.geometry.velocities import velocities

TWIST = np.array([0.3, -0.2, 0.1, 0.4, 0.2, -0.5])  # [m/s], [rad/s]
START = se3.exp(np.array([1.0, 2.0, 3.0, 0.5, -0.4, 0.3]))
ROUNDING = 1e-12


def at(time: float) -> np.ndarray:
    return START @ se3.exp(time * TWIST)


def test_a_steady_motion_is_found_at_every_frame():
    times = np.array([0.0, 0.03, 0.07, 0.1])
    np.testing.assert_allclose(
        velocities(times, [at(time) for time in times]), np.tile(TWIST, (4, 1)), atol=ROUNDING
    )


def test_frames_without_a_pose_or_a_near_neighbour_stand_still():
    times = np.array([0.0, 0.03, 0.06, 1.0, 1.03])
    poses = [at(time) for time in times]
    poses[1] = None
    found = velocities(times, poses)
    np.testing.assert_array_equal(found[[0, 1, 2]], 0)  # frame 2 is a second before frame 3
    np.testing.assert_allclose(found[[3, 4]], np.tile(TWIST, (2, 1)), atol=ROUNDING)


def test_equal_time_stamps_tell_nothing():
    np.testing.assert_array_equal(velocities(np.zeros(2), [at(0), at(1)]), 0)
