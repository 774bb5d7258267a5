"""Poses over time: where something was between the times at which that is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import se3
from .quaternions import quaternion_to_rotation

LONGEST_GAP = 1.0  # [s] between two known poses; what happens in a longer one nobody knows


@dataclass(frozen=True)
class PoseTrack:
    """Known poses of frame b in frame a, ascending in time."""

    times: NDArray[np.float64]  # (N,) [s]
    T_a_b: NDArray[np.float64]  # (N, 4, 4)

    @classmethod
    def of(cls, rows: NDArray) -> PoseTrack | None:
        """The track of rows time, tx ty tz, qx qy qz qw, in any order; those that are no poses are
        left out, and of equal times the first counts. None where nothing is left.
        """
        rows = np.asarray(rows, np.float64).reshape(-1, 8)
        with np.errstate(over="ignore"):  # of numbers that are no quaternions
            length = np.linalg.norm(rows[:, 4:], axis=1)
        rows = rows[np.isfinite(rows).all(axis=1) & (np.abs(length - 1) < 0.1)]
        times, first = np.unique(rows[:, 0], return_index=True)
        if not len(times):
            return None
        T = np.tile(np.eye(4), (len(times), 1, 1))
        T[:, :3, :3] = quaternion_to_rotation(rows[first, 4:])
        T[:, :3, 3] = rows[first, 1:4]
        return cls(times, T)

    @property
    def moves(self) -> bool:
        """Whether it is not the same pose all the time."""
        return bool(np.abs(self.T_a_b - self.T_a_b[0]).max() > 1e-6)

    def at(self, time: float, max_difference: float) -> NDArray[np.float64] | None:
        """T_a_b then (4, 4): between two poses at most LONGEST_GAP apart, turned and moved evenly; else
        the nearest within `max_difference` [s]; None where there is none.
        """
        right = int(np.searchsorted(self.times, time))
        left = right - 1
        if left >= 0 and right < len(self.times):
            gap = self.times[right] - self.times[left]
            if gap <= LONGEST_GAP:
                return between(self.T_a_b[left], self.T_a_b[right], (time - self.times[left]) / gap)
        nearest = min(
            (i for i in (left, right) if 0 <= i < len(self.times)),
            key=lambda i: abs(self.times[i] - time),
        )
        if abs(self.times[nearest] - time) <= max_difference:
            return self.T_a_b[nearest]
        return None


def between(T_from: NDArray, T_to: NDArray, share: float) -> NDArray[np.float64]:
    """The pose (4, 4) at `share` of the way from one to another, evenly turned and moved."""
    turn = np.eye(4)
    turn[:3, :3] = T_from[:3, :3].T @ T_to[:3, :3]
    twist = se3.log(turn)
    twist[:3] = 0
    T = np.eye(4)
    T[:3, :3] = T_from[:3, :3] @ se3.exp(share * twist)[:3, :3]
    T[:3, 3] = (1 - share) * T_from[:3, 3] + share * T_to[:3, 3]
    return T
