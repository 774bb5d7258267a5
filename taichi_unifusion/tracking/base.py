"""What every tracker is, its settings, and what it returns (Sec. V-A.1)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, PoseError, check_types, strict
from ..geometry import se3
from ..preprocessing import PreprocessSettings
from ..types import Frame, Trajectory

if TYPE_CHECKING:
    from .keyframes import Keyframes


@strict
@dataclass(frozen=True)
class TrackingSettings:
    """How poses are found and refined."""

    photometric_weight: float = 0.1
    """Weight of colour against geometry when frames are aligned; it decides what geometry leaves
    open. 0: geometry alone.
    """
    depth_max: float = 6.0
    """Farthest reading that tracking uses, in metres."""
    keyframe_distance: float = 0.10
    """A new keyframe is made when the camera is this far from the last one, in metres ..."""
    keyframe_angle: float = 7.0
    """... or has turned by this angle, in degrees ..."""
    keyframe_fitness: float = 0.8
    """... or less than this share of the frame lies on it."""
    window: int = 1
    """How many recent keyframes a frame is aligned to; internal tracking uses at least 3."""
    loops: bool = True
    """Recognise places seen before, and distribute the drift over the trajectory."""
    depth_bias: Literal["off", "say", "correct"] = "say"
    """rgbd: look for depth that is wrong by its place in the image, in views that overlap; say so, or correct
    it, in the map too.
    """
    prior_distance: float = 0.10
    """internal: a refinement that moves a pose further than this from the given one, in metres, is
    not trusted ...
    """
    prior_angle: float = 5.0
    """... nor one that turns it by more than this, in degrees."""

    def __post_init__(self) -> None:
        check_types(self)
        if not self.depth_max > 0.1:
            raise InputError(f"tracking: depth_max must be above 0.1 m, got {self.depth_max}")
        positive = ("keyframe_distance", "keyframe_angle", "prior_distance", "prior_angle")
        for name in positive:
            if not getattr(self, name) > 0:
                raise InputError(f"tracking: {name} must be positive, got {getattr(self, name)}")
        if (
            not 0 <= self.photometric_weight <= 100
            or not 0 < self.keyframe_fitness < 1
            or self.window < 1
        ):
            raise InputError(
                f"tracking: need photometric_weight in 0..100, keyframe_fitness in (0, 1) and window >= 1, got "
                f"{self.photometric_weight}, {self.keyframe_fitness} and {self.window}"
            )


class Verdict(StrEnum):
    """Where a frame's pose comes from, or why there is none."""

    GIVEN = "given"  # as read, not touched
    INTERPOLATED = "interpolated"  # between two poses as read
    TRACKED = "tracked"  # aligned to earlier frames
    RELOCALISED = "relocalised"  # after a loss: found at some keyframe by its features
    REFINED = "refined"  # aligned to earlier frames, close to the pose that was given
    PRIOR_KEPT = "prior kept"  # the pose that was given: the refinement could not be trusted
    APART = "apart"  # no pose in the world yet: in a sub-map that has not met the first
    LOST = "lost"  # no pose: the frame does not fit what was seen before
    MISSING = "no pose"  # none was given
    UNREADABLE = "unreadable"  # the frame could not be loaded


@dataclass(frozen=True)
class TrackedFrame:
    """The pose of one frame, where it comes from and how well it fits."""

    index: int  # place in its recording
    verdict: Verdict
    T_world_camera: NDArray[np.float64] | None = None  # (4, 4); None: the frame must not be mapped
    timestamp: float | None = None  # [s]
    fitness: float | None = None  # share of its surfels that lie on what it was aligned to
    rmse: float | None = None  # of their distances [m]
    keyframe: int | None = None  # place in the recording of the frame that it was aligned to
    message: str = ""  # why a pose is missing or not trusted
    # (4, 4) of a frame that is apart: where it lies in its sub-map, whose place is a mere guess
    T_apart_camera: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class TrackingResult:
    """All frames of a pass, with their final poses."""

    frames: tuple[TrackedFrame, ...]
    keyframes: tuple[int, ...] = ()  # indices in the recording
    loops: tuple[tuple[int, int], ...] = ()  # pairs of them that closed a loop
    details: Mapping[str, Any] = field(default_factory=dict)  # JSON values, for the metrics
    interrupted: bool = False

    @property
    def counts(self) -> dict[str, int]:
        """How many frames had which verdict."""
        return {
            str(verdict): count
            for verdict, count in Counter(frame.verdict for frame in self.frames).most_common()
        }

    @property
    def trajectory(self) -> Trajectory:
        """Of the frames that have a pose; frame numbers stand in for time stamps where a recording
        has none.
        """
        posed = [(frame, T) for frame in self.frames if (T := frame.T_world_camera) is not None]
        return Trajectory.of(
            [frame.timestamp for frame, _ in posed],
            [frame.index for frame, _ in posed],
            [T for _, T in posed],
        )


@dataclass(frozen=True, eq=False)
class CurrentPoses:
    """Where all frames so far are, as far as it is known now: keyframes have poses, and a frame
    moves with its keyframe.

    Poses may change (a loop), disappear (the frame is lost after all) and appear (a sub-map joins
    the first); whenever one did, `version` has grown. Arrays are copies of the tracker's.
    """

    version: int
    keyframes: NDArray[np.int64]  # (K,) places in the recording
    T_world_keyframe: NDArray[np.float64]  # (K, 4, 4); of a sub-map apart: in its own world
    joined: NDArray[np.bool_]  # (K,) False: in a sub-map that has not joined the first yet
    frames: NDArray[np.int64]  # (F,) places in the recording, in the order in which they came
    keyframe: NDArray[np.int64]  # (F,) row of `keyframes` that the frame moves with; -1: no pose
    T_keyframe_camera: NDArray[np.float64]  # (F, 4, 4)

    @classmethod
    def fixed(cls, frames: Sequence[TrackedFrame]) -> Self:
        """Of frames whose poses never change: each is a keyframe of its own."""
        poses = [T for frame in frames if (T := frame.T_world_camera) is not None]
        posed = np.array([frame.T_world_camera is not None for frame in frames], bool)
        indices = np.array([frame.index for frame in frames], np.int64)
        return cls(
            0,
            indices[posed],
            np.array(poses, np.float64).reshape(-1, 4, 4),
            np.ones(len(poses), bool),
            indices,
            np.where(posed, np.cumsum(posed) - 1, -1),
            np.broadcast_to(np.eye(4), (len(frames), 4, 4)).copy(),
        )

    @property
    def posed(self) -> NDArray[np.bool_]:
        """(F,) whether a frame has a pose in the world."""
        if not len(self.joined):
            return np.zeros(len(self.frames), bool)
        return (self.keyframe >= 0) & self.joined[self.keyframe]

    @property
    def T_world_camera(self) -> NDArray[np.float64]:
        """(F, 4, 4) poses of the frames; NaN for those that have none."""
        poses, posed = np.full((len(self.frames), 4, 4), np.nan), self.posed
        poses[posed] = se3.normalized(
            self.T_world_keyframe[self.keyframe[posed]] @ self.T_keyframe_camera[posed]
        )
        return poses

    @property
    def by_frame(self) -> dict[int, NDArray[np.float64]]:
        """The poses of frames that have one, by their place in the recording."""
        posed = self.posed
        return dict(zip(self.frames[posed].tolist(), self.T_world_camera[posed], strict=True))


@dataclass(frozen=True)
class PoseSource:
    """Where poses come from that are not the recording's, and how they are joined to frames."""

    trajectory: str | Path | None = None  # file or folder
    interpolate: bool = False  # between its poses, over short gaps
    max_difference: float | None = None  # [s] between a frame and its pose; None: the usual
    body_camera: Path | None = None  # file: where the camera sits on the body of EuRoC's poses


class Tracker(ABC):
    """Poses for frames that come in order: `track` each of them, then `finish` once.

    A tracker for another source of poses (a SLAM system, a ROS topic) is one more subclass, and a
    line in `TRACKERS`. `warnings` holds sentences on what was odd but usable; `track_sequence` says
    them when it starts.
    """

    uses_given_poses = True  # False: frames are handed over without the poses of their recording
    reads_trajectory = False  # whether it makes use of a PoseSource
    warnings: tuple[str, ...] = ()

    @classmethod
    @abstractmethod
    def make(
        cls, settings: TrackingSettings, preprocess: PreprocessSettings, source: PoseSource
    ) -> Self:
        """A tracker that has seen nothing yet; takes what it needs."""

    @abstractmethod
    def track(self, frame: Frame) -> TrackedFrame:
        """The pose as far as it is known now; later frames and `finish` may still change it. Never
        raises for a bad frame.
        """

    def skip(self, index: int, error: Exception) -> TrackedFrame:
        """Note a frame that could not be loaded."""
        verdict = Verdict.MISSING if isinstance(error, PoseError) else Verdict.UNREADABLE
        return TrackedFrame(index, verdict, message=str(error))

    @property
    def version(self) -> int:
        """Grows whenever the pose of an earlier frame has changed, as `CurrentPoses.version`; cheap
        to ask after every frame.
        """
        return 0

    def current_poses(self) -> CurrentPoses:
        """Where all frames so far are now; after `finish`, at their final poses.

        A tracker that changes earlier poses overrides this and `version`; for others `finish` must
        bear being asked early.
        """
        return CurrentPoses.fixed(self.finish().frames)

    def keyframes(self) -> Keyframes | None:
        """What another recording of the place can be aligned to, at their present poses; None: the tracker
        keeps none.
        """
        return None

    @abstractmethod
    def finish(self) -> TrackingResult:
        """All frames that were tracked, in order, with their final poses."""
