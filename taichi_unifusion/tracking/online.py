"""Frames of a recording that are tracked one by one while they are mapped: one pass."""

from __future__ import annotations

import logging
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

logger = logging.getLogger(__name__)


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
    which that was found is handed out. Of a run that goes on, the first `done` frames that it had handed
    out are tracked once more, unless `stop` says so, and not handed out. With `later` all frames are handed
    out as apart from the world: their windows are kept, and fused when poses are final.
    """

    def __init__(
        self,
        recording: Dataset,
        tracker: Tracker,
        every: int = 1,
        on_moved: Callable[[CurrentPoses], None] = lambda poses: None,
        *,
        later: bool = False,
        done: int = 0,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        self.frames = recording if tracker.uses_given_poses else recording.without_poses()
        self.tracker, self.every, self.on_moved = tracker, every, on_moved
        self.name, self.warnings = self.frames.name, self.frames.without_poses().warnings
        self.depth_scale = getattr(recording_of(recording), "depth_scale", None)
        self.later, self.done, self.stop = later, done, stop
        self._version, self._apart = tracker.version, False

    def __len__(self) -> int:
        return len(range(0, len(self.frames), self.every))

    def arriving(self) -> Iterator[Callable[[], Frame]]:
        first = self.done * self.every
        if first:
            logger.info("tracking the first %d frames once more, to go on from there", first)
        for i, load in enumerate(load_ahead(self.frames)):
            if i < first:
                if self.stop():
                    yield load  # nobody takes it
                    return
                with suppress(FrameError):
                    self._track(i, load, tell=False)
            elif i % self.every:
                with suppress(FrameError):  # it is not mapped; the tracker knows
                    self._track(i, load)
            else:
                yield partial(self._track, i, load)

    def place_of(self, number: int) -> int:
        """Place in the recording of a frame that was handed out."""
        return index_in_recording(self.frames, number * self.every)

    def _track(self, i: int, load: Callable[[], Frame], *, tell: bool = True) -> Frame:
        try:
            frame = load()
        except FrameError as error:
            self.tracker.skip(index_in_recording(self.frames, i), error)
            raise
        tracked = self.tracker.track(frame)
        apart = tracked.T_apart_camera is not None
        if tell and (self.tracker.version != self._version or apart != self._apart):
            self._version, self._apart = self.tracker.version, apart
            self.on_moved(self.tracker.current_poses())
        frame = as_tracked(frame, tracked)
        return replace(frame, apart=True) if self.later else frame
