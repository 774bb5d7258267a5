"""Poses from a trajectory file of any SLAM system, joined to the frames by time stamp or number
(Sec. V-A.1).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, InputError
from ..files.frame_files import number_of
from ..geometry import se3
from ..geometry.time_stamps import check_max_difference, nearest
from ..preprocessing import PreprocessSettings
from ..types import Frame
from .base import (
    CurrentPoses,
    PoseSource,
    TrackedFrame,
    Tracker,
    TrackingResult,
    TrackingSettings,
    Verdict,
)
from .trajectory_files import ExternalPoses, read_poses

MAX_DIFFERENCE = 0.02  # [s] between a frame and its pose, as TUM's benchmark has it
# [s], frames: a longer gap is not interpolated, as the camera may have gone anywhere in it
LONGEST_GAP = 1.0, 30.0


class ExternalPoseTracker(Tracker):
    """Takes poses from a file; frames without one have none, unless `interpolate` fills short gaps."""

    uses_given_poses = False
    reads_trajectory = True

    @classmethod
    def make(
        cls, settings: TrackingSettings, preprocess: PreprocessSettings, source: PoseSource
    ) -> ExternalPoseTracker:
        if source.trajectory is None:
            raise InputError("tracking: external needs a trajectory file (--trajectory FILE)")
        difference = source.max_difference
        return cls(
            read_poses(source.trajectory, source.body_camera),
            source.interpolate,
            MAX_DIFFERENCE if difference is None else difference,
        )

    def __init__(
        self,
        poses: ExternalPoses,
        interpolate: bool = False,
        max_difference: float = MAX_DIFFERENCE,
    ) -> None:
        check_max_difference(max_difference)
        self.poses, self.interpolate, self.max_difference = poses, interpolate, max_difference
        self.warnings = poses.warnings
        self.numbered = bool((poses.keys == np.rint(poses.keys)).all())
        self.frames: list[TrackedFrame] = []
        self.keys: list[float] = []  # number or time stamp of every frame

    def track(self, frame: Frame) -> TrackedFrame:
        verdict, pose, message = self.pose_of(frame)
        self.frames.append(
            TrackedFrame(frame.index, verdict, pose, frame.timestamp, message=message)
        )
        return self.frames[-1]

    def pose_of(self, frame: Frame) -> tuple[Verdict, NDArray[np.float64] | None, str]:
        """Verdict and T_world_camera of a frame, or None and why there is none."""
        poses = self.poses
        key, unit, tolerance, longest = self._key(frame)
        self.keys.append(key)
        if unit == "frames" and poses.by_time and not self.numbered:
            message = (
                f"{poses.source}: its time stamps are no frame numbers, and the frame has no time"
            )
            return Verdict.MISSING, None, message
        at = int(nearest(poses.keys, np.array([key]))[0])
        gap = abs(poses.keys[at] - key)
        if gap <= tolerance:
            return Verdict.GIVEN, poses.T_world_camera[at], ""
        after = int(np.searchsorted(poses.keys, key))
        inside = 0 < after < len(poses.keys)
        if self.interpolate and inside and poses.keys[after] - poses.keys[after - 1] <= longest:
            between = poses.T_world_camera[after - 1], poses.T_world_camera[after]
            share = (key - poses.keys[after - 1]) / (poses.keys[after] - poses.keys[after - 1])
            return Verdict.INTERPOLATED, interpolate(*between, share), ""
        if gap == 1 and unit == "frames":
            unit = "frame"
        message = f"{poses.source}: the nearest pose is {gap:g} {unit} away"
        return Verdict.MISSING, None, message

    def _key(self, frame: Frame) -> tuple[float, str, float, float]:
        """What to look for: number or time stamp, its unit, how far off it may be, the longest gap
        to interpolate.
        """
        if not self.poses.by_time:
            return float(self._number(frame)), "frames", 0.0, LONGEST_GAP[1]
        # frame numbers stand in for time stamps, as in a trajectory.txt of ours
        if frame.timestamp is None:
            return float(frame.index), "frames", 1e-6, LONGEST_GAP[1]
        return frame.timestamp, "s", self.max_difference, LONGEST_GAP[0]

    def _number(self, frame: Frame) -> int:
        """A frame's number as the poses have it: in the name of its image, or its place in the
        recording.
        """
        number = number_of(frame.name) if self.poses.by_name else None
        return frame.index if number is None else number

    def skip(self, index: int, error: Exception) -> TrackedFrame:
        self.frames.append(super().skip(index, error))
        return self.frames[-1]

    def current_poses(self) -> CurrentPoses:
        return CurrentPoses.fixed(self.frames)  # `finish` would complain about none so far

    def finish(self) -> TrackingResult:
        if not any(frame.T_world_camera is not None for frame in self.frames) and self.frames:
            raise DatasetError(
                f"{self.poses.source}: none of its {len(self.poses.keys)} poses belongs to a frame; its "
                f"{'time stamps' if self.poses.by_time else 'frame numbers'} run from {self.poses.keys[0]:g} to "
                f"{self.poses.keys[-1]:g}, those of the frames from {min(self.keys, default=0):g} to "
                f"{max(self.keys, default=0):g}"
            )
        return TrackingResult(
            tuple(self.frames), details={"trajectory": self.poses.source, "gaps": gaps(self.frames)}
        )


def interpolate(T_a: NDArray, T_b: NDArray, share: float) -> NDArray[np.float64]:
    """The pose at `share` (0..1) of the way from T_a to T_b at constant velocity: a screw motion."""
    return se3.normalized(T_a @ se3.exp(share * se3.log(se3.inverse(T_a) @ T_b)))


def gaps(frames: Sequence[TrackedFrame]) -> list[str]:
    """Runs of frames without a pose, as 'first-last' or a single number."""
    return runs(frames, lambda frame: frame.T_world_camera is None)


def runs(frames: Sequence[TrackedFrame], belongs: Callable[[TrackedFrame], bool]) -> list[str]:
    """Runs of neighbouring frames of a kind, as 'first-last' or a single number."""
    found: list[list[int]] = []
    inside = False
    for frame in frames:
        if belongs(frame):
            if not inside:
                found.append([frame.index, frame.index])
            found[-1][1] = frame.index
        inside = belongs(frame)
    return [str(first) if first == last else f"{first}-{last}" for first, last in found]
