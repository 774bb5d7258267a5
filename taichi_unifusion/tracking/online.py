"""Frames of a recording that are tracked one by one while they are mapped: one pass."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial

from ..datasets import Dataset
from ..datasets.live import Arriving
from ..datasets.loading import index_in_recording, load_ahead, recording_of
from ..errors import FrameError, PoseError
from ..types import Frame
from .base import CurrentPoses, TrackedFrame, Tracker


def as_tracked(frame: Frame, tracked: TrackedFrame) -> Frame:
    """The frame with the pose that was found, maybe apart from the world; raises PoseError where there
    is none.
    """
    if tracked.T_world_camera is not None:
        return replace(frame, T_world_camera=tracked.T_world_camera)
    if tracked.T_apart_camera is not None:
        return replace(frame, T_world_camera=tracked.T_apart_camera, apart=True)
    raise PoseError(f"{frame.label}: {tracked.verdict}, {tracked.message}")


class OnlineFrames(Arriving):
    """Every `every`-th frame of a recording with the pose that the tracker, which sees all of them,
    knows when its turn comes, or with one apart from the world; a frame without any raises PoseError
    that says why.

    `on_moved` is told where all frames are whenever earlier ones have moved, before the frame at
    which that was found is handed out.
    """

    def __init__(
        self,
        recording: Dataset,
        tracker: Tracker,
        every: int = 1,
        on_moved: Callable[[CurrentPoses], None] = lambda poses: None,
    ) -> None:
        self.frames = recording if tracker.uses_given_poses else recording.without_poses()
        self.tracker, self.every, self.on_moved = tracker, every, on_moved
        self.name, self.warnings = self.frames.name, self.frames.without_poses().warnings
        self.depth_scale = getattr(recording_of(recording), "depth_scale", None)
        self._version = tracker.version

    def __len__(self) -> int:
        return len(range(0, len(self.frames), self.every))

    def arriving(self) -> Iterator[Callable[[], Frame]]:
        for i, load in enumerate(load_ahead(self.frames)):
            if i % self.every:
                with suppress(FrameError):  # it is not mapped; the tracker knows
                    self._track(i, load)
            else:
                yield partial(self._track, i, load)

    def place_of(self, number: int) -> int:
        """Place in the recording of a frame that was handed out."""
        return index_in_recording(self.frames, number * self.every)

    def _track(self, i: int, load: Callable[[], Frame]) -> Frame:
        try:
            frame = load()
        except FrameError as error:
            self.tracker.skip(index_in_recording(self.frames, i), error)
            raise
        tracked = self.tracker.track(frame)
        if self.tracker.version != self._version:
            self._version = self.tracker.version
            self.on_moved(self.tracker.current_poses())
        return as_tracked(frame, tracked)
