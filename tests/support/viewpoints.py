"""Cameras of small images, where they stand, and their rays."""

from __future__ import annotations

import numpy as np

from taichi_unifusion import PinholeCamera

VS = 0.05

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 79.5, 59.5)


def pose(position, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Rigid transform; angles [rad] about y, x and z."""
    T = np.eye(4)
    for angle, (i, j) in ((yaw, (2, 0)), (pitch, (1, 2)), (roll, (0, 1))):
        turn = np.eye(3)
        turn[[i, j, i, j], [i, j, j, i]] = (
            np.cos(angle),
            np.cos(angle),
            -np.sin(angle),
            np.sin(angle),
        )
        T[:3, :3] = T[:3, :3] @ turn
    T[:3, 3] = position
    return T


# pixels about as fine as a Kinect's: small steps on slanted planes
FINE = PinholeCamera(96, 72, 400.0, 410.0, 45.5, 36.0)


def rays(camera: PinholeCamera) -> np.ndarray:
    """(H, W, 3) directions of unit z."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1
    )
