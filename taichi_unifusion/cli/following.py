"""One pass: frames are tracked and fused as they come, and the map follows when a loop moves them."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..config import Config
from ..datasets import Dataset
from ..errors import PoseError
from ..types import Trajectory
from .color_camera import AUTO
from .into import Addition, remembered
from .options import OutputOptions, RunOptions
from .resuming import make_pipeline
from .run import Mapped, Run
from .terminal import frame_progress
from .viewing import map_frames

if TYPE_CHECKING:
    from ..maps.window_store import WindowStore
    from ..pipeline import Pipeline
    from ..results import RunFolder
    from ..results.saver import RunSaver
    from ..run_log import RunResult
    from ..tracking import CurrentPoses, TrackingResult

logger = logging.getLogger(__name__)


def in_one_pass(recording: Dataset, options: RunOptions) -> bool:
    """Whether frames are tracked and fused in one pass: asked for, and possible."""
    poses = options.poses
    if not poses.tracked or poses.tracking_passes == 2:
        return False
    obstacle = _obstacle(options.settings)
    if options.output.into is not None:
        obstacle = "the place of the recording in the map (--into) is found from all frames"
    if options.settings.tracking.depth_bias == "correct":
        obstacle = "how depth is wrong (--tracking.depth-bias) is known when all frames were seen"
    if options.recording.color_camera == AUTO and not recording.registered:
        obstacle = (
            "the colour camera is found from the poses of all frames; --color-camera knows it"
        )
    if obstacle:
        logger.info("tracking all frames before any is mapped: %s", obstacle)
    return not obstacle


def _obstacle(settings: Config) -> str:
    """Why maps of these settings cannot follow a trajectory that changes; "" if they can."""
    if settings.map_memory:
        return "a map in tiles, with map_memory, cannot follow a loop"
    if "points" in (settings.surface.sampling, settings.color.sampling):
        return "maps that take every point (sampling: points) cannot follow a loop"
    return ""


def open_store(
    folder: RunFolder,
    options: OutputOptions,
    settings: Config,
    *,
    moves: bool,
    added: Addition | None = None,
    saver: RunSaver | None = None,
) -> WindowStore | None:
    """A file for what windows are fused from, under a name for the time being; where it is not
    wanted, None unless the map `moves`, and then memory, if no `saver` needs it in a file. A recording
    that is `added` to a map goes on with its file, a run that was ended with its own.
    """
    from ..maps.window_store import WindowStore

    if _obstacle(settings) or (options.forget and not moves):
        return None
    if saver is not None and saver.resumed is not None and saver.resumed.state.windows is not None:
        from ..results.safe_windows import windows_then

        return windows_then(folder, saver.resumed.state.windows)
    if options.forget and (saver is None or not saver.seconds):
        return WindowStore()
    folder.new_windows.unlink(missing_ok=True)
    if added and added.windows:
        from ..results.merging import continued

        return continued(added.windows, folder)
    return WindowStore(folder.new_windows)


def keep_store(
    folder: RunFolder, store: WindowStore | None, options: OutputOptions
) -> tuple[Path, ...]:
    """Give the file of windows its name, unless it is to be forgotten; the files that are there then."""
    if store is None or store.path is None:
        return ()
    store.sync()
    store.close()
    if options.forget:
        folder.new_windows.unlink(missing_ok=True)  # what safe points hold is removed with them
        return ()
    store.path.replace(folder.windows)
    store.moved_to(folder.windows)
    return (folder.windows,)


def keep_tracking(folder: RunFolder, result: TrackingResult) -> None:
    """Write what a tracker found; the folder is that of a run that is not done, until its record is
    written.
    """
    from ..files.trajectories import write_trajectory
    from ..results.ownership import mark_unfinished, owned_files
    from ..tracking.sequence import write_tracking

    mark_unfinished(folder, owned_files(folder) | set(map(folder.relative, folder.tracking_files)))
    write_tracking(folder.tracking, result)
    write_trajectory(folder.tracked_poses, result.trajectory)


def map_in_one_pass(recording: Dataset, made: Run) -> Mapped:
    """Track and fuse frames as they come, let the map follow, while it is watched or in the end, and
    end with all of it at the final poses.
    """
    from .. import runtime
    from ..tracking.online import OnlineFrames
    from ..tracking.sequence import concluded, say_warnings

    options, folder, saver, started = made.options, made.folder, made.saver, time.perf_counter()
    poses, settings = options.poses, options.settings
    watched = options.watch.view or options.watch.view_window
    runtime.init(settings.device, threads=settings.threads or None)
    tracker = _tracker(options)
    store = open_store(folder, options.output, settings, moves=True, saver=saver)
    pipeline = make_pipeline(options, made.encoder, folder, saver, store)
    assert pipeline.follower is not None
    if not watched:  # nobody sees the map before its end
        pipeline.follower.budget = 0.0
    before = saver.resumed and saver.resumed.so_far
    frames = OnlineFrames(
        recording,
        tracker,
        options.recording.every,
        following(pipeline),
        later=not watched,
        done=before.done if before else 0,
        stop=made.stop,
    )
    logger.info("tracking: %s, in one pass with mapping", poses.mode)
    warnings = say_warnings(frames.frames, tracker)
    strict = options.recording.strict
    run = map_frames(
        pipeline,
        frames,
        len(frames),
        strict=strict,
        stop=made.stop,
        watcher=made.watcher,
        on_border=saver.at_border,
        before=before,
    )
    result = concluded(tracker, time.perf_counter() - started, warnings, run.interrupted)
    run = replace(
        run, skipped=tuple(replace(each, index=frames.place_of(each.index)) for each in run.skipped)
    )
    run = settle(pipeline, run, tracker.current_poses())
    keep_tracking(folder, result)
    details = {
        "mode": poses.mode,
        **result.details,
        "passes": 1,
        "following": {
            name: round(value, 4) for name, value in asdict(pipeline.follower.summary()).items()
        },
    }
    every, lasting = options.recording.every, None if options.output.forget else store
    kept = remembered(folder, recording[::every], run, lasting, None, pipeline.config, made.stop)
    written = (*folder.tracking_files, *keep_store(folder, store, options.output), *kept)
    return Mapped(pipeline, run, details, written)


def _tracker(options: RunOptions) -> Any:
    from ..tracking import make_tracker

    poses, settings = options.poses, options.settings
    return make_tracker(
        poses.mode,
        settings.tracking,
        settings.preprocess,
        trajectory=poses.trajectory,
        interpolate=poses.interpolate,
        max_difference=options.recording.max_difference,
        body_camera=poses.body_camera,
    )


def following(pipeline: Pipeline) -> Callable[[CurrentPoses], None]:
    """What ends the open window and lets the map follow when a tracker has moved earlier frames."""

    def on_moved(poses: CurrentPoses) -> None:
        if pipeline.follower is not None:
            pipeline.fusion.close()
            pipeline.follower.follow(poses.by_frame)

    return on_moved


def settle(pipeline: Pipeline, run: RunResult, poses: CurrentPoses) -> RunResult:
    """Move all windows to the final poses, if they were kept; returns the run with these."""
    from ..run_log import SKIP_REASONS, SkippedFrame

    if pipeline.follower is None:
        return run
    final = poses.by_frame
    pipeline.follower.follow(final)
    with frame_progress(len(pipeline.follower.store), "window") as on_window:
        pipeline.follower.on_window = on_window
        followed = pipeline.follower.finish(alone=True)
    if followed.moved or followed.moves:
        logger.info(
            "the map followed: %d of %d windows lie elsewhere than they were tracked at first, up to %.1f cm; "
            "%d moves, %d fused in the end, %.1f s",
            followed.moved,
            followed.windows,
            100 * followed.farthest,
            followed.moves,
            followed.anew,
            followed.seconds,
        )
    used = [i for i, step in enumerate(run.steps) if step.index in final]
    lost = [
        SkippedFrame(step.index, SKIP_REASONS[PoseError], "its place in the map was never sure")
        for step in run.steps
        if step.index not in final
    ]
    skipped = sorted((*run.skipped, *lost), key=lambda each: each.index)
    T = [final[run.steps[i].index] for i in used]
    return replace(
        run,
        steps=tuple(run.steps[i] for i in used),
        skipped=tuple(skipped),
        trajectory=Trajectory(run.trajectory.timestamps[used], _stacked(T)),
    )


def _stacked(T: list) -> Any:
    import numpy as np

    return np.array(T, np.float64).reshape(-1, 4, 4)
