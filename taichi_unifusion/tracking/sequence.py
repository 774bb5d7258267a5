"""A tracker over a whole sequence, and the sequence with the poses that it found."""

from __future__ import annotations

import csv
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..datasets import Dataset, DatasetView
from ..datasets.loading import index_in_recording, load_ahead
from ..errors import DatasetError, FrameError, PoseError
from ..files.atomic import read_bytes, write_text
from ..files.trajectories import read_trajectory
from ..types import Frame
from .base import TrackedFrame, Tracker, TrackingResult, Verdict
from .depth_bias import corrected
from .external import runs

if TYPE_CHECKING:
    from ..datasets import ColorCamera

logger = logging.getLogger(__name__)

COLUMNS = ("frame", "timestamp", "verdict", "fitness", "rmse_m", "keyframe", "message")
NO_POSE = (Verdict.LOST, Verdict.APART, Verdict.MISSING, Verdict.UNREADABLE)


def track_sequence(
    sequence: Dataset,
    tracker: Tracker,
    *,
    stop: Callable[[], bool] = lambda: False,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> TrackingResult:
    """Poses of all frames, final; frames that cannot be loaded or tracked are in it with their
    reason. What is odd is said, and in `details["warnings"]`.
    """
    started, interrupted = time.perf_counter(), False
    frames = sequence if tracker.uses_given_poses else sequence.without_poses()
    warnings = say_warnings(frames, tracker)
    for i, load in enumerate(load_ahead(frames)):
        if interrupted := stop():
            break
        try:
            tracked = tracker.track(load())
        except FrameError as error:  # of loading: trackers do not raise for a bad frame
            tracked = tracker.skip(index_in_recording(frames, i), error)
        if tracked.verdict is Verdict.RELOCALISED:
            logger.info("frame %d: found again at keyframe %s", tracked.index, tracked.keyframe)
        on_frame(i + 1, len(sequence))
    return concluded(tracker, time.perf_counter() - started, warnings, interrupted)


def concluded(
    tracker: Tracker, seconds: float, warnings: list[str], interrupted: bool
) -> TrackingResult:
    """What a tracker that has seen all frames gives, and what is to be said of it."""
    result = tracker.finish()
    details = {
        **result.details,
        "verdicts": result.counts,
        "seconds": round(seconds, 3),
        "warnings": warnings + _said(_not_tracked(result)),
    }
    return replace(result, details=details, interrupted=interrupted)


def say_warnings(frames: Dataset, tracker: Tracker) -> list[str]:
    """Say what is odd about the poses of a recording and of a tracker, before it starts."""
    return _said([*_pose_warnings(frames), *tracker.warnings])


def _said(sentences: list[str]) -> list[str]:
    for sentence in sentences:
        logger.warning("%s", sentence)
    return sentences


def _pose_warnings(frames: Dataset) -> list[str]:
    """What a recording has to say of its own poses: the map, which gets others, will not say it."""
    others = frames.without_poses().warnings
    return [sentence for sentence in frames.warnings if sentence not in others]


def _not_tracked(result: TrackingResult) -> list[str]:
    """For every reason, which frames have no pose, and which kept one that was not refined."""
    sentences = []
    for verdict in (*NO_POSE, Verdict.PRIOR_KEPT):
        members = [frame for frame in result.frames if frame.verdict is verdict]
        if not members:
            continue
        where = runs(result.frames, lambda frame, verdict=verdict: frame.verdict is verdict)
        what = (
            "keep the pose that was given"
            if verdict is Verdict.PRIOR_KEPT
            else f"are not mapped ({verdict})"
        )
        sentences.append(
            f"tracking: {len(members)} of {len(result.frames)} frames {what}: {_shortened(where)} "
            f"(first: {members[0].message})"
        )
    return sentences


def _shortened(where: list[str], most: int = 8) -> str:
    return ", ".join(where[:most]) + (f" and {len(where) - most} more" if len(where) > most else "")


class PosedFrames(DatasetView):
    """The frames of a sequence with the poses of `tracking`, and with their depth corrected if it was for
    these; a frame without one raises PoseError that says why.
    """

    def __init__(self, sequence: Dataset, tracking: TrackingResult) -> None:
        frames = sequence.without_poses()
        super().__init__(frames, range(len(tracking.frames)))
        self.tracking = tracking

    def load(self, index: int) -> Frame:
        frame, tracked = super().load(index), self.tracking.frames[index]
        if tracked.T_world_camera is None:
            raise PoseError(f"{frame.label}: {tracked.verdict}, {tracked.message}")
        if "depth_bias" in self.tracking.details:
            frame = corrected(frame, np.array(self.tracking.details["depth_bias"], np.float64))
        return replace(frame, T_world_camera=tracked.T_world_camera)

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        return super().pose_at(index)[0], self.tracking.frames[index].T_world_camera

    def with_color_camera(
        self, camera: ColorCamera | None, velocities: NDArray[np.float64] | None = None
    ) -> PosedFrames:
        """As for every data set; the velocities are those of the poses found."""
        return super().with_color_camera(
            camera, self.velocities() if velocities is None else velocities
        )


def with_poses(frames: Dataset, T_world_camera: Mapping[int, NDArray[np.float64]]) -> PosedFrames:
    """Frames with these poses, by place in the recording; those of others are missing."""
    tracked = []
    for i in range(len(frames)):
        place = index_in_recording(frames, i)
        T, timestamp = T_world_camera.get(place), frames.pose_at(i)[0]
        verdict = Verdict.MISSING if T is None else Verdict.GIVEN
        message = "no pose is known" if T is None else ""
        tracked.append(TrackedFrame(place, verdict, T, timestamp, message=message))
    return PosedFrames(frames, TrackingResult(tuple(tracked)))


def write_tracking(path: Path, result: TrackingResult) -> None:
    """Write what is known about every frame as CSV, atomically."""
    text = StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for frame in result.frames:
        table.writerow(
            [
                frame.index,
                _number(frame.timestamp, "r"),
                frame.verdict,
                _number(frame.fitness, ".4f"),
                _number(frame.rmse, ".6f"),
                "" if frame.keyframe is None else frame.keyframe,
                frame.message,
            ]
        )
    write_text(path, text.getvalue())


def read_tracked_poses(table: Path, poses: Path) -> dict[int, NDArray[np.float64]]:
    """The poses that a run found and wrote, by place in the recording: `poses` has them by time stamp, or
    by number where a frame had none, and `table` says which frame that is.

    Raises FileError, DatasetError where one is missing or damaged.
    """
    rows = list(csv.DictReader(StringIO(read_bytes(table).decode("utf-8", "replace"))))
    try:
        numbers = [int(row["frame"]) for row in rows]
        stamps = [float(row["timestamp"] or "nan") for row in rows]
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{table}: not a table of tracked frames ({error})") from None
    found = read_trajectory(poses)
    keys = numbers if np.isnan(stamps).any() else stamps
    place = {float(key): number for key, number in zip(keys, numbers, strict=True)}
    return {
        place[float(stamp)]: T
        for stamp, T in zip(found.timestamps, found.T_world_camera, strict=True)
        if float(stamp) in place
    }


def _number(value: float | None, form: str) -> str:
    if value is None:
        return ""
    return repr(float(value)) if form == "r" else format(value, form)
