"""Views of one window whose intrinsics differ a little, as a phone's autofocus makes them: each keeps
its own, though all are looked up with the keyframe's camera.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..types import PinholeCamera

ALIKE = 0.1  # of focal lengths, and of the image's size for its centre: by so much an autofocus changes them


def nearly_same(a: PinholeCamera, b: PinholeCamera) -> bool:
    """Whether two cameras are one, but for its focus."""
    if a == b or a.size != b.size:
        return a == b
    ratios = a.fx / b.fx, a.fy / b.fy
    shift = abs(a.cx - b.cx) / a.width, abs(a.cy - b.cy) / a.height
    return max(*ratios, *(1 / r for r in ratios)) < 1 + ALIKE and max(shift) < ALIKE


def lens_beside(camera: PinholeCamera, keyframe: PinholeCamera) -> NDArray[np.float64]:
    """(4,) sx, sy, tx, ty: the keyframe's camera has (sx x + tx z, sy y + ty z, z) in the pixel where
    the camera has (x, y, z).
    """
    return np.array(
        [
            camera.fx / keyframe.fx,
            camera.fy / keyframe.fy,
            (camera.cx - keyframe.cx) / keyframe.fx,
            (camera.cy - keyframe.cy) / keyframe.fy,
        ]
    )


def through_lenses(
    T_camera_world: NDArray[np.float64], lenses: NDArray[np.float64]
) -> NDArray[np.float32]:
    """(K, 3, 4) from world to where the keyframe's camera has what each view (K, 4, 4) has, by its lens
    (K, 4): pixels and depths are exactly the view's.
    """
    A = np.tile(np.eye(3), (len(lenses), 1, 1))
    A[:, 0, 0], A[:, 1, 1], A[:, 0, 2], A[:, 1, 2] = lenses.T
    return np.ascontiguousarray(A @ T_camera_world[:, :3], np.float32)
