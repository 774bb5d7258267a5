"""Poses for frames (Sec. V-A.1): as given, from a trajectory file, refined, or found from the
frames alone.

posed = track(frames, mode="rgbd")             # the frames with the poses found: PosedFrames
print(posed.tracking.counts)                   # a TrackingResult: poses, fitness, verdicts
pipeline.run(posed[::5])                       # the map is built from the final poses
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..errors import DatasetError, InputError, check_choice
from ..preprocessing import PreprocessSettings
from .base import (
    CurrentPoses,
    PoseSource,
    TrackedFrame,
    Tracker,
    TrackingResult,
    TrackingSettings,
    Verdict,
)

if TYPE_CHECKING:
    from ..datasets import Dataset
    from .sequence import PosedFrames

Mode = Literal["given", "external", "internal", "rgbd"]

TRACKERS: dict[Mode, tuple[str, str]] = {  # name -> module here, class
    "given": ("given", "GivenPoses"),
    "external": ("external", "ExternalPoseTracker"),
    "internal": ("internal", "InternalTracker"),
    "rgbd": ("rgbd", "RgbdTracker"),
}

__all__ = [
    "TRACKERS",
    "CurrentPoses",
    "Mode",
    "PoseSource",
    "TrackedFrame",
    "Tracker",
    "TrackingResult",
    "TrackingSettings",
    "Verdict",
    "check_poses",
    "make_tracker",
    "track",
]

logger = logging.getLogger(__name__)


def track(
    frames: Dataset,
    settings: TrackingSettings | None = None,
    preprocess: PreprocessSettings | None = None,
    *,
    mode: Mode = "rgbd",
    trajectory: str | Path | None = None,
    interpolate: bool = False,
    max_difference: float | None = None,
    body_camera: Path | None = None,
    stop: Callable[[], bool] = lambda: False,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> PosedFrames:
    """The frames with their final poses; `posed.tracking` says what was found.

    Track all frames of a recording and thin them afterwards: small steps are easier. `trajectory`
    is the file or folder for external, and for internal instead of given poses; `interpolate` fills
    short gaps in it, `max_difference` [s] is how far a pose may be from its frame, `body_camera` the
    file that says where the camera sits on the body of EuRoC's poses. `stop` is asked before every
    frame, `on_frame` told how many of them are done.

    Raises InputError for an unknown mode or a trajectory that is missing or not used, DatasetError
    where there are no poses and the mode needs them.
    """
    from .sequence import PosedFrames, track_sequence

    check_poses(frames, mode, trajectory)
    tracker = make_tracker(
        mode,
        settings,
        preprocess,
        trajectory=trajectory,
        interpolate=interpolate,
        max_difference=max_difference,
        body_camera=body_camera,
    )
    logger.info("tracking: %s", mode)
    return PosedFrames(frames, track_sequence(frames, tracker, stop=stop, on_frame=on_frame))


def make_tracker(
    mode: Mode,
    settings: TrackingSettings | None = None,
    preprocess: PreprocessSettings | None = None,
    *,
    trajectory: str | Path | None = None,
    interpolate: bool = False,
    max_difference: float | None = None,
    body_camera: Path | None = None,
) -> Tracker:
    """The tracker of that mode; arguments and errors as for `track`."""
    kind = _kind(mode)
    if not kind.reads_trajectory and (trajectory is not None or interpolate):
        readers = [name for name in TRACKERS if _kind(name).reads_trajectory]
        what = "--interpolate fills gaps of" if trajectory is None else "--trajectory names"
        raise InputError(
            f"tracking: {what} a trajectory file, which '{mode}' does not read; use "
            f"{' or '.join(readers)} with it"
        )
    source = PoseSource(trajectory, interpolate, max_difference, body_camera)
    return kind.make(settings or TrackingSettings(), preprocess or PreprocessSettings(), source)


def check_poses(frames: Dataset, mode: Mode, trajectory: str | Path | None = None) -> None:
    """Raise DatasetError where the mode needs the recording's poses and there are none."""
    if frames.no_poses and trajectory is None and _kind(mode).uses_given_poses:
        raise DatasetError(
            f"{frames.no_poses}, so the frames have no poses; find them from the frames alone with "
            "--tracking rgbd, or take another program's with --tracking external --trajectory FILE"
        )


def _kind(mode: Mode) -> type[Tracker]:
    check_choice("tracking", mode, TRACKERS)
    module, name = TRACKERS[mode]
    return getattr(import_module(f".{module}", __package__), name)
