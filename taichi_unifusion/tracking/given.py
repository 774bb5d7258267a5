"""The poses of the recording, as they are."""

from __future__ import annotations

from ..preprocessing import PreprocessSettings
from ..types import Frame
from .base import PoseSource, TrackedFrame, Tracker, TrackingResult, TrackingSettings, Verdict


class GivenPoses(Tracker):
    """Takes what the recording says."""

    @classmethod
    def make(
        cls, settings: TrackingSettings, preprocess: PreprocessSettings, source: PoseSource
    ) -> GivenPoses:
        return cls()

    def __init__(self) -> None:
        self.frames: list[TrackedFrame] = []

    def track(self, frame: Frame) -> TrackedFrame:
        if frame.T_world_camera is None:
            tracked = TrackedFrame(
                frame.index,
                Verdict.MISSING,
                None,
                frame.timestamp,
                message="the recording has none",
            )
        else:
            tracked = TrackedFrame(
                frame.index, Verdict.GIVEN, frame.T_world_camera, frame.timestamp
            )
        self.frames.append(tracked)
        return tracked

    def skip(self, index: int, error: Exception) -> TrackedFrame:
        self.frames.append(super().skip(index, error))
        return self.frames[-1]

    def finish(self) -> TrackingResult:
        return TrackingResult(tuple(self.frames))
