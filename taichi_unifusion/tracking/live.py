"""Poses for frames that come live: each is tracked as it is taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from ..datasets.live import Arriving
from ..errors import FrameError, PoseError
from ..types import Frame
from .base import Tracker


class TrackedFrames(Arriving):
    """Frames as they arrive, with the pose that a tracker finds for each; one without raises PoseError
    that says why.

    Poses are those known at the time: a loop that is closed later moves the trajectory of
    `tracker.finish()`, not what is mapped already.
    """

    def __init__(self, frames: Arriving, tracker: Tracker) -> None:
        self.frames, self.tracker = frames, tracker
        self.name, self.warnings = frames.name, (*frames.warnings, *tracker.warnings)

    def __len__(self) -> int:
        return len(self.frames)

    def arriving(self) -> Iterator[Callable[[], Frame]]:
        for load in self.frames.arriving():
            yield lambda load=load: self._track(load)

    def _track(self, load: Callable[[], Frame]) -> Frame:
        try:
            frame = load()
        except FrameError as error:
            self.tracker.skip(len(self.frames) - 1, error)
            raise
        if self.tracker.uses_given_poses is False:
            frame = replace(frame, T_world_camera=None)
        tracked = self.tracker.track(frame)
        if tracked.T_world_camera is None:
            raise PoseError(f"{frame.label}: {tracked.verdict}, {tracked.message}")
        return replace(frame, T_world_camera=tracked.T_world_camera)
