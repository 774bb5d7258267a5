"""Rotations as unit quaternions, in the order x y z w."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def rotation_to_quaternion(R: NDArray) -> NDArray[np.float64]:
    """Unit quaternions (N, 4), in the order x y z w with w >= 0, of rotation matrices (N, 3, 3).

    The quaternion is the dominant eigenvector of a symmetric matrix that is linear in R
    (Bar-Itzhack 2000): no special case at half turns, and the nearest rotation where R is rounded.
    """
    R = np.asarray(R, np.float64)
    K = np.empty((len(R), 4, 4))
    trace = np.trace(R, axis1=1, axis2=2)
    K[:, :3, :3] = R + R.transpose(0, 2, 1) - trace[:, None, None] * np.eye(3)
    K[:, 3, :3] = K[:, :3, 3] = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    K[:, 3, 3] = trace
    q = np.linalg.eigh(K)[1][:, :, -1]  # eigenvalues come in ascending order
    return np.where(q[:, 3:] < 0, -q, q)


def quaternion_to_rotation(q: NDArray) -> NDArray[np.float64]:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) in the order x y z w, normalised first."""
    q = np.asarray(q, np.float64)
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y - z * w),
            2 * (x * z + y * w),
            2 * (x * y + z * w),
            1 - 2 * (x * x + z * z),
            2 * (y * z - x * w),
            2 * (x * z - y * w),
            2 * (y * z + x * w),
            1 - 2 * (x * x + y * y),
        ],
        axis=1,
    ).reshape(-1, 3, 3)
