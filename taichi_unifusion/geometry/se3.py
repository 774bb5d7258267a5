"""Rigid motions: exponential, logarithm and adjoint of SE(3), twists in the order translation,
rotation.

All take one or many: (..., 4, 4) motions, (..., 6) twists.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# camera axes of OpenGL and ARKit (y up, z backward) to ours (y down, z forward), and back
FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
SMALL_ANGLE = 1e-4  # [rad] below it the first terms of a series are exact to float64
HALF_TURN = 1e-6  # of the sine of the angle: above it the axis is read off R - R^T


def hat(v: NDArray) -> NDArray[np.float64]:
    """(..., 3, 3) matrices of the cross product with v."""
    W = np.zeros((*v.shape[:-1], 3, 3))
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return W - W.swapaxes(-1, -2)


def exp(xi: NDArray) -> NDArray[np.float64]:
    """The motion of the twist xi = (translation [m], rotation [rad])."""
    xi = np.asarray(xi, np.float64)
    angle = np.linalg.norm(xi[..., 3:], axis=-1)[..., None, None]
    small, safe = angle < SMALL_ANGLE, np.maximum(angle, SMALL_ANGLE)
    a = np.where(small, 1 - angle**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    W = hat(xi[..., 3:])
    W2 = W @ W
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + a * W + b * W2
    T[..., :3, 3:] = (np.eye(3) + b * W + c * W2) @ xi[..., :3, None]
    T[..., 3, 3] = 1
    return T


def log(T: NDArray) -> NDArray[np.float64]:
    """The twist whose exponential is T, with a rotation of at most half a turn."""
    R = T[..., :3, :3]
    axis = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]],
        axis=-1,
    )
    sine = np.linalg.norm(axis, axis=-1)[..., None]
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1)[..., None] - 1)
    angle = np.arctan2(sine, cosine)
    outer = R + np.eye(3)  # at half a turn: twice the axis times itself
    longest = np.argmax(np.einsum("...ii->...i", outer), axis=-1)[..., None, None]
    column = np.take_along_axis(outer, longest, axis=-1)[..., 0]
    half = angle * column / np.maximum(np.linalg.norm(column, axis=-1, keepdims=True), SMALL_ANGLE)
    w = np.where(
        sine > HALF_TURN,
        axis * (angle / np.maximum(sine, HALF_TURN)),
        np.where(cosine > 0, axis, half),
    )
    angle = angle[..., None]
    small, safe = angle < SMALL_ANGLE, np.maximum(angle, SMALL_ANGLE)
    d = np.where(small, 1 / 12 + angle**2 / 720, (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    W = hat(w)
    translation = (np.eye(3) - 0.5 * W + d * (W @ W)) @ T[..., :3, 3:]
    return np.concatenate([translation[..., 0], w], axis=-1)


def inverse(T: NDArray) -> NDArray[np.float64]:
    """T_a_b of T_b_a."""
    inverted = np.zeros_like(T, dtype=np.float64)
    transposed = T[..., :3, :3].swapaxes(-1, -2)
    inverted[..., :3, :3] = transposed
    inverted[..., :3, 3:] = -transposed @ T[..., :3, 3:]
    inverted[..., 3, 3] = 1
    return inverted


def adjoint(T: NDArray) -> NDArray[np.float64]:
    """(..., 6, 6) matrices that carry a twist in b to a, of T_a_b: T exp(xi) = exp(adjoint(T) xi)
    T.
    """
    A = np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = T[..., :3, :3]
    A[..., :3, 3:] = hat(T[..., :3, 3]) @ T[..., :3, :3]
    return A


def normalized(T: NDArray) -> NDArray[np.float64]:
    """T with the rotation nearest to its own. `inverse` relies on it: errors of long products would
    grow exponentially.
    """
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    rigid = np.array(T, np.float64)
    rigid[..., :3, :3] = U @ Vt
    return rigid


def distance(T_a: NDArray, T_b: NDArray) -> tuple[float, float]:
    """How far two poses are apart: metres, radians."""
    turn = log(inverse(T_a) @ T_b)[3:]
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), float(np.linalg.norm(turn))
