"""`--live`: frames are mapped as they come, of a camera or of a recording at its own frame rate."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import FlagCreatePairsOff, arg

from ..config import Config
from ..datasets.live import LiveFrames, Replay
from ..errors import InputError
from ..geometry.gravity import parse_up
from ..tracking import Mode, TrackingResult, check_poses, make_tracker
from ..tracking.live import TrackedFrames
from ..tracking.live import warm_up as warm_up_tracker
from .color_camera import AUTO, given_color
from .following import following, keep_store, open_store, settle
from .interrupts import INTERRUPTED
from .into import keep_keyframes
from .options import (
    OutputOptions,
    RecordingOptions,
    TrackingOptions,
    merged_options,
    open_recording,
    source_of,
)
from .replacing import say_what_is_replaced
from .terminal import report
from .viewing import WatchOptions, map_frames, run_watched

if TYPE_CHECKING:
    from ..results import RunFolder
    from ..results.record import Source
    from ..run_log import RunResult
    from ..viewer.null import Watcher

logger = logging.getLogger(__name__)
CAMERAS = ("realsense",)  # formats that are also cameras


@dataclass(frozen=True)
class LiveOptions:
    """Whether frames are mapped as they come."""

    live: FlagCreatePairsOff[bool] = False
    """Map frames as they come: of the camera that is connected (realsense without a path), or of a recording at
    its own frame rate. Of what comes meanwhile the newest frames wait, others are dropped and counted.
    Ctrl-C ends it, and everything is written.
    """
    live_speed: Annotated[float, arg(metavar="FACTOR")] = 1.0
    """How fast a recording comes with --live; 2 is twice its own frame rate."""


@dataclass(frozen=True)
class LiveSource:
    """What frames come from."""

    frames: Iterable[Any]
    name: str
    tracking: Mode
    record: Source | None  # None for a camera: nobody can open it again
    most: int | None = None  # frames to take


def reconstruct_live(
    recording: RecordingOptions,
    poses: TrackingOptions,
    output: OutputOptions,
    watch: WatchOptions,
    live: LiveOptions,
    settings: Config,
) -> int:
    """Frames -> tracker -> maps while they come, then mesh -> results folder."""
    from ..pipeline import warm_up
    from ..results.lock import lock_folder
    from ..results.writer import prepare_results

    if settings.tracking.depth_bias == "correct":
        raise InputError(
            "--live: how depth is wrong (--tracking.depth-bias) is known when all frames were seen; leave it out"
        )
    source = open_source(recording, poses, live.live_speed)
    folder = prepare_results(output.out)

    def map_and_write(watcher: Watcher, stop: Callable[[], bool]) -> int:
        # or the first frames would be dropped while kernels are compiled
        warm_up(settings)
        warm_up_tracker(make_tracker(source.tracking, settings.tracking, settings.preprocess))
        return _map(source, recording.strict, output, settings, folder, stop, watcher)

    with lock_folder(folder):
        say_what_is_replaced(folder, output, settings, False, source.tracking != "given")
        return run_watched(watch, folder, source.most or 0, map_and_write)


def open_source(asked: RecordingOptions, poses: TrackingOptions, speed: float) -> LiveSource:
    """The camera, or the recording to be played; InputError for options that do not go together."""
    mode = poses.mode
    if asked.path is None and asked.format in CAMERAS:
        if asked.start or asked.every != 1:
            raise InputError(
                "--live: a camera has no frames to start from or to leave out; drop it"
            )
        if mode not in ("given", "rgbd"):
            raise InputError(f"--live: a camera has no poses for --tracking {mode}; use rgbd")
        from ..datasets.realsense_camera import RealsenseCamera

        camera = RealsenseCamera(align=_align(asked))
        return LiveSource(camera, asked.format, "rgbd", None, asked.end)
    recording = open_recording(asked)
    mode = poses.for_recording(recording).mode
    if mode not in ("given", "rgbd"):
        raise InputError(f"--live: poses are given or found by rgbd, not by --tracking {mode}")
    check_poses(recording, mode)
    if mode == "rgbd":
        recording = recording.without_poses()
    recording, known = given_color(recording, asked.color_camera)
    frames = recording[:: asked.every]
    record = source_of(asked, len(frames), None if asked.color_camera == AUTO else known)
    return LiveSource(Replay(frames, speed), recording.name, mode, record)


def _align(asked: RecordingOptions) -> str:
    """The only option of the format that a camera has, too."""
    given = merged_options(asked.format, {}, asked.option)
    for name in given:
        if name != "align":
            raise InputError(f"--live: a camera has no option '{name}', only align")
    return given.get("align", "depth")


def _map(
    source: LiveSource,
    strict: bool,
    output: OutputOptions,
    settings: Config,
    folder: RunFolder,
    stop: Callable[[], bool],
    watcher: Watcher,
) -> int:
    from ..pipeline import Pipeline
    from ..results.summary import summarize
    from ..results.writer import write_results

    moves = source.tracking != "given"
    store = open_store(folder, output, settings, moves=True) if moves else None
    pipeline = Pipeline(settings, keep=store)
    tracker = make_tracker(source.tracking, settings.tracking, settings.preprocess)
    logger.info("live: %s, tracking: %s; Ctrl-C ends it", source.name, source.tracking)
    with LiveFrames(source.frames, source.name, stop=stop, most=source.most) as frames:
        run = map_frames(
            pipeline,
            TrackedFrames(frames, tracker, following(pipeline)),
            source.most or 0,
            strict=strict,
            stop=stop,
            watcher=watcher,
        )
    said = (
        f"{frames.received} frames came, {len(run.steps)} are mapped, {frames.dropped} were dropped"
    )
    logger.info("live: %s", said)
    if not run.steps:
        logger.warning("stopped before the first frame was done; nothing was written")
        return INTERRUPTED
    result = tracker.finish()
    run = settle(pipeline, run, tracker.current_poses())
    written = _write_tracking(folder, result) if source.tracking != "given" else ()
    windows = keep_store(folder, store, output)
    keyframes = keep_keyframes(folder, tracker.keyframes()) if windows else ()
    written = (*written, *windows, *keyframes)
    details = {
        **result.details,
        "mode": source.tracking,
        "live": {"received": frames.received, "dropped": frames.dropped},
        "verdicts": result.counts,
        "seconds": round(run.seconds, 3),
    }
    up = parse_up(output.up) if output.up else None
    results = write_results(folder.path, pipeline, run, source.record, details, written, up)
    print(
        json.dumps(results.record.to_json(), indent=2)
        if output.json
        else summarize(results.record, results.files, folder.path)
    )
    return _code(run, results.failures, stop)


def _code(run: RunResult, failures: Iterable[Exception], stop: Callable[[], bool]) -> int:
    code = report([error for error in (run.failure, *failures) if error])
    return INTERRUPTED if stop() else code


def _write_tracking(folder: RunFolder, result: TrackingResult) -> tuple:
    from ..files.trajectories import write_trajectory
    from ..tracking.sequence import write_tracking

    write_tracking(folder.tracking, result)
    write_trajectory(folder.tracked_poses, result.trajectory)
    return folder.tracking_files
