"""Quaternions and rotation matrices: the textbook's rotation, and there and back."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.geometry.quaternions import quaternion_to_rotation, rotation_to_quaternion

ROTATION_TOLERANCE = 1e-12  # float64 rounding of a few products


def random_rotations(count: int, seed: int = 0) -> np.ndarray:
    q = np.random.default_rng(seed).normal(size=(count, 4))
    return quaternion_to_rotation(q)


def half_turns() -> np.ndarray:
    """180 degrees about the axes, the face diagonals and some other axes, where trace-based
    formulas divide by zero.
    """
    axes = np.array(
        [
            [1, 0, 0],
            [0, 1, 0],
            [0, 0, 1],
            [1, 1, 0],
            [1, 0, -1],
            [0, -1, 1],
            [1, 1, 1],
            [1, -2, 3],
            [1e-9, 1, 0],
        ]
    )
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)


@pytest.mark.parametrize(
    "R",
    [random_rotations(200), half_turns(), np.eye(3)[None]],
    ids=["random", "half turns", "identity"],
)
def test_quaternions_round_trip(R):
    q = rotation_to_quaternion(R)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=ROTATION_TOLERANCE)
    assert (q[:, 3] >= 0).all()
    np.testing.assert_allclose(quaternion_to_rotation(q), R, atol=ROTATION_TOLERANCE)


def test_quaternion_convention():
    s = np.sqrt(0.5)
    quarter_turn_about_z = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(
        rotation_to_quaternion(quarter_turn_about_z[None]), [[0, 0, s, s]], atol=ROTATION_TOLERANCE
    )
    unnormalised = quaternion_to_rotation([[0, 0, 2 * s, 2 * s]])
    np.testing.assert_allclose(unnormalised, quarter_turn_about_z[None], atol=ROTATION_TOLERANCE)


def test_quaternion_to_rotation_is_the_textbook_rotation():
    rng = np.random.default_rng(2)
    for q in rng.normal(size=(20, 4)):
        q /= np.linalg.norm(q)
        R, v = quaternion_to_rotation(q[None])[0], rng.normal(size=3)
        u, w = q[:3], q[3]
        rotated = 2 * (u @ v) * u + (w * w - u @ u) * v + 2 * w * np.cross(u, v)  # q v q*
        np.testing.assert_allclose(R @ v, rotated, rtol=0, atol=ROTATION_TOLERANCE)
        np.testing.assert_allclose(R.T @ R, np.eye(3), rtol=0, atol=ROTATION_TOLERANCE)
