"""Poses for frames (Sec. V-A.1): as given, from a trajectory file, refined, or found from the
frames alone.

tracker = make_tracker("rgbd", TrackingSettings())
result = track_sequence(frames, tracker)       # a TrackingResult: poses, fitness, verdicts
pipeline.run(PosedFrames(frames, result))      # the map is built from the final poses
"""

from __future__ import annotations

from pathlib import Path

from ..errors import InputError, check_choice
from ..preprocessing import PreprocessSettings
from .base import TrackedFrame, Tracker, TrackingResult, TrackingSettings, Verdict

MODES = ("given", "external", "internal", "rgbd")

__all__ = [
    "MODES",
    "TrackedFrame",
    "Tracker",
    "TrackingResult",
    "TrackingSettings",
    "Verdict",
    "make_tracker",
]


def make_tracker(
    mode: str,
    settings: TrackingSettings | None = None,
    preprocess: PreprocessSettings | None = None,
    *,
    trajectory: str | Path | None = None,
    interpolate: bool = False,
    max_difference: float | None = None,
) -> Tracker:
    """The tracker of that mode; `trajectory` is the file or folder for external, and for internal
    instead of given poses.

    Raises InputError for an unknown mode or a trajectory that is missing or not used, DatasetError
    where it holds no poses.
    """
    check_choice("tracking", mode, MODES)
    if mode == "external" and trajectory is None:
        raise InputError("tracking: external needs a trajectory file (--trajectory FILE)")
    if mode in ("given", "rgbd") and (trajectory is not None or interpolate):
        raise InputError(
            f"tracking: {mode} reads no trajectory file; use external or internal with it"
        )
    if mode == "rgbd":
        from .rgbd import RgbdTracker

        return RgbdTracker(settings, preprocess)
    prior = _prior(trajectory, interpolate, max_difference)
    if mode == "internal":
        from .internal import InternalTracker

        return InternalTracker(prior, settings, preprocess)
    return prior


def _prior(
    trajectory: str | Path | None, interpolate: bool, max_difference: float | None
) -> Tracker:
    """Poses as somebody else gives them."""
    if trajectory is None:
        from .given import GivenPoses

        return GivenPoses()
    from .external import MAX_DIFFERENCE, ExternalPoseTracker
    from .trajectory_files import read_poses

    return ExternalPoseTracker(
        read_poses(trajectory),
        interpolate,
        MAX_DIFFERENCE if max_difference is None else max_difference,
    )
