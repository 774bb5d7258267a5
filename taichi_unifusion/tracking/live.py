"""Poses for frames that come live: each is tracked as it is taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from ..datasets.live import Arriving
from ..errors import FrameError
from ..types import Frame, PinholeCamera
from .base import CurrentPoses, Tracker
from .online import as_tracked


def warm_up(tracker: Tracker) -> None:
    """Compile what a tracker runs, which takes seconds, by two frames of a wall; it is of no use afterwards."""
    camera = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    depth = (1.5 + 0.1 * np.sin(u / 15) + 0.1 * np.cos(v / 11)).astype(np.float32)
    grey = ((u // 12 + v // 9) % 2 * 160 + 40).astype(np.uint8)
    for i in range(2):
        tracker.track(Frame(depth, camera, np.dstack([grey] * 3), np.eye(4), i))


class TrackedFrames(Arriving):
    """Frames as they arrive, with the pose that a tracker finds for each, maybe apart from the world;
    one without any raises PoseError that says why.

    Poses are those known at the time; `on_moved` is told where all frames are whenever a loop has
    moved earlier ones.
    """

    def __init__(
        self,
        frames: Arriving,
        tracker: Tracker,
        on_moved: Callable[[CurrentPoses], None] = lambda poses: None,
    ) -> None:
        self.frames, self.tracker, self.on_moved = frames, tracker, on_moved
        self._version = tracker.version
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
        if self.tracker.version != self._version:
            self._version = self.tracker.version
            self.on_moved(self.tracker.current_poses())
        return as_tracked(frame, tracked)
