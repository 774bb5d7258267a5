"""How a camera moves at each of its poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from . import se3

FRAME_RATE = 30.0  # [Hz] of recordings without time stamps: what most RGB-D cameras have
LONGEST_GAP = 0.25  # [s] between neighbouring frames; what happens in a longer one nobody knows


def velocities(
    timestamps: NDArray[np.float64],  # (N,) [s]
    T_world_camera: Sequence[NDArray | None],  # N of (4, 4), None: unknown
) -> NDArray[np.float64]:
    """Twists a second (N, 6), [m/s] and [rad/s] in the camera's own frame, from the pose before to
    the one after each; 0 where there is no pose near in time.
    """
    twists = np.zeros((len(timestamps), 6))
    posed = [(i, T) for i, T in enumerate(T_world_camera) if T is not None]
    for k, (i, _) in enumerate(posed):
        near = [
            (j, T)
            for j, T in posed[max(k - 1, 0) : k + 2]
            if abs(j - i) <= 1 and abs(timestamps[j] - timestamps[i]) <= LONGEST_GAP
        ]
        (first, T_before), (last, T_after) = near[0], near[-1]
        if timestamps[last] > timestamps[first]:
            elapsed = timestamps[last] - timestamps[first]
            twists[i] = se3.log(se3.inverse(T_before) @ T_after) / elapsed
    return twists
