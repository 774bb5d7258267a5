"""The camera of a window: turns around a point, flies, jumps; up stays up. NumPy alone, no screen."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

TURN = math.pi  # [rad] by a drag over the width or height of the window
STEEPEST = 0.995  # |cosine| of the view and up
ZOOM = 1.12  # by a step
NEAREST, FARTHEST = 0.05, 500.0  # [m] from the point that the camera turns around


@dataclass(frozen=True)
class Orbit:
    """Where a camera is, the point it turns around, and which way is up; all (3,), scene [m]."""

    eye: NDArray[np.float64]
    target: NDArray[np.float64]
    up: NDArray[np.float64]  # unit

    @classmethod
    def of_pose(cls, T_world_camera: NDArray, distance: float, up: NDArray) -> Orbit:
        """At a pose (4, 4), turning around a point so far ahead of it."""
        eye = np.array(T_world_camera[:3, 3], np.float64)
        return cls(eye, eye + distance * T_world_camera[:3, 2], up)

    @property
    def distance(self) -> float:
        """From the eye to the point [m]."""
        return float(np.linalg.norm(self.target - self.eye))

    @property
    def forward(self) -> NDArray[np.float64]:
        """(3,) unit, what the camera looks along."""
        return (self.target - self.eye) / max(self.distance, 1e-9)

    @property
    def right(self) -> NDArray[np.float64]:
        """(3,) unit and level."""
        right = np.cross(self.forward, self.up)
        length = float(np.linalg.norm(right))
        if length < 1e-6:
            right = np.cross(np.eye(3)[np.abs(self.up).argmin()], self.up)
            length = float(np.linalg.norm(right))
        return right / length

    def turned(self, across: float, along: float) -> Orbit:
        """Turned around the point by a drag of the mouse, in shares of the window to the right and
        upwards: the scene follows the mouse.
        """
        back = self._turn(self.eye - self.target, across, along)
        return replace(self, eye=self.target + back)

    def looked_around(self, across: float, along: float) -> Orbit:
        """The view turned on the spot by a drag of the mouse."""
        return replace(self, target=self.eye + self._turn(self.target - self.eye, -across, -along))

    def _turn(self, arm: NDArray, across: float, along: float) -> NDArray[np.float64]:
        arm = _rotated(arm, self.up, -TURN * across)
        lifted = _rotated(arm, self.right, TURN * along)
        steep = abs(lifted @ self.up) > STEEPEST * np.linalg.norm(lifted)
        return arm if steep else lifted

    def flown(self, right: float, up: float, forward: float) -> Orbit:
        """Moved so far [m] to the right, upwards and ahead; the point moves along."""
        by = right * self.right + up * self.up + forward * self.forward
        return replace(self, eye=self.eye + by, target=self.target + by)

    def zoomed(self, steps: float) -> Orbit:
        """Nearer to the point by so many steps, or farther from it."""
        distance = float(np.clip(self.distance * ZOOM**-steps, NEAREST, FARTHEST))
        return replace(self, eye=self.target - distance * self.forward)


def _rotated(v: NDArray, axis: NDArray, angle: float) -> NDArray[np.float64]:
    """v turned about a unit axis (Rodrigues' formula)."""
    c, s = math.cos(angle), math.sin(angle)
    return c * v + s * np.cross(axis, v) + (1 - c) * (axis @ v) * axis
