"""`unifusion reconstruct`: frames -> maps -> mesh -> results folder."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from tyro.conf import arg

from ..cluster.engine import ClusterSettings
from ..config import Config
from ..datasets import Dataset
from ..errors import InputError, PoseError
from ..geometry.gravity import Up, parse_up
from ..tracking import check_poses, track
from ..tracking.sequence import PosedFrames
from .color_camera import found_color, given_color
from .following import (
    Mapped,
    in_one_pass,
    keep_store,
    keep_tracking,
    map_in_one_pass,
    open_store,
)
from .interrupts import INTERRUPTED
from .into import Addition, check_into, maps_of, placed, remembered
from .live import LiveOptions, reconstruct_live
from .on_workers import check_workers, remove_shards, run_on_workers
from .options import (
    OutputOptions,
    RecordingOptions,
    Settings,
    TrackingOptions,
    open_recording,
    source_of,
)
from .replacing import say_what_is_replaced
from .resuming import end_saving, is_complete, make_pipeline, open_saver, registered
from .terminal import DONE, FAILED, frame_progress, report
from .viewing import WatchOptions, map_frames, run_watched

if TYPE_CHECKING:
    from ..language import EncoderChoice
    from ..networks.encoders import ImageEncoder
    from ..results import RunFolder
    from ..results.record import ColorRecord, Source
    from ..results.saver import RunSaver
    from ..run_log import RunResult
    from ..viewer.null import Watcher

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reconstruct:
    """Turn a recording of RGB-D frames into a coloured mesh.

    Example: unifusion reconstruct 7scenes my/redkitchen --every 10 --out results/kitchen

    Without camera poses: unifusion reconstruct folder my_recording --tracking rgbd --out
    results/mine

    Of a camera that is connected: unifusion reconstruct realsense --live --out results/mine

    Settings that `unifusion config --help` explains are options here too,

    for example --device cpu, --surface.voxel-size 0.03 or --mesh.resolution 8.
    """

    recording: Annotated[RecordingOptions, arg(name="")]
    poses: Annotated[TrackingOptions, arg(name="")]
    output: Annotated[OutputOptions, arg(name="")]
    watch: Annotated[WatchOptions, arg(name="")] = field(default_factory=WatchOptions)
    live: Annotated[LiveOptions, arg(name="")] = field(default_factory=LiveOptions)
    cluster: Annotated[ClusterSettings, arg(name="")] = field(default_factory=ClusterSettings)
    settings: Settings = field(default_factory=Config, kw_only=True)

    @property
    def image_encoder(self) -> EncoderChoice | None:
        """What makes image-text features, if they are to be mapped."""
        return None


def reconstruct(options: Reconstruct) -> int:
    """Frames -> maps -> mesh -> results folder."""
    if options.live.live and options.output.into is not None:
        raise InputError("--into: not with --live yet; record first, and add the recording")
    if options.live.live:
        return reconstruct_live(
            options.recording,
            options.poses,
            options.output,
            options.watch,
            options.live,
            options.settings,
        )
    return fuse(open_recording(options.recording), options)


def fuse(recording: Dataset, options: Reconstruct, encoder: ImageEncoder | None = None) -> int:
    """What every command does that makes maps, of a recording that is open; with an image encoder
    also a map of its features.
    """
    check_poses(recording, options.poses.tracking, options.poses.trajectory)
    if options.output.resume and (
        options.output.keep_windows or options.poses.tracking_passes == 1
    ):
        raise InputError(
            "--resume: a run that keeps windows (--keep-windows, --tracking-passes 1) cannot go on yet; leave "
            "--resume out"
        )
    check_into(options, options.cluster.wanted)
    check_workers(options.cluster, options.watch.view or options.watch.view_window)
    recording, color = given_color(recording, options.recording.color_camera)
    from ..results.lock import lock_folder
    from ..results.writer import prepare_results

    up = parse_up(options.output.up) if options.output.up else None
    if up is None and recording.up is not None and not options.poses.tracked:
        up = Up(np.array(recording.up), "recording")
    folder = prepare_results(options.output.out)
    frames = len(range(0, len(recording), options.recording.every))
    with lock_folder(folder):
        if is_complete(folder, frames, options):
            logger.info("%s holds the whole run already: there is nothing to resume", folder.path)
            return DONE
        saver = open_saver(frames, options, folder, encoder)
        say_what_is_replaced(
            folder, options.output, options.settings, encoder is not None, options.poses.tracked
        )
        return run_watched(
            options.watch,
            folder,
            frames,
            lambda watcher, stop: _fuse_and_write(
                recording, color, options, folder, stop, encoder, up, watcher, saver
            ),
        )


def _fuse_and_write(
    recording: Dataset,
    color: ColorRecord,
    options: Reconstruct,
    folder: RunFolder,
    stop: Callable[[], bool],
    encoder: ImageEncoder | None,
    up: Up | None,
    watcher: Watcher,
    saver: RunSaver,
) -> int:
    from ..results.summary import summarize
    from ..results.writer import write_results

    mapped, frames, source = _mapped(
        recording, color, options, folder, stop, encoder, watcher, saver
    )
    pipeline, run, written = mapped.pipeline, mapped.run, mapped.written
    if not run.steps:
        logger.warning(
            "stopped before the first frame was done; %s",
            f"{' and '.join(file.name for file in written)} hold the poses found until then"
            if written
            else "nothing was written",
        )
        return INTERRUPTED
    done = len(run.steps) + len(run.skipped)
    if done < len(frames):
        logger.warning(
            "%s after %d of %d frames; writing what they gave",
            "stopped" if run.interrupted else "ended early",
            done,
            len(frames),
        )
    results = write_results(folder.path, pipeline, run, source, mapped.tracking, written, up)
    if not results.failures:
        remove_shards(folder.shards)
    print(
        json.dumps(results.record.to_json(), indent=2)
        if options.output.json
        else summarize(results.record, results.files, folder.path)
    )
    ended = [error for error in (run.failure, *results.failures) if error]
    code = report(ended)
    end_saving(folder, done=not (run.interrupted or ended))
    code = _report_missing(run, len(frames)) or code
    return INTERRUPTED if stop() else code


def _mapped(
    recording: Dataset,
    color: ColorRecord,
    options: Reconstruct,
    folder: RunFolder,
    stop: Callable[[], bool],
    encoder: ImageEncoder | None,
    watcher: Watcher,
    saver: RunSaver,
) -> tuple[Mapped, Dataset, Source]:
    """Track and map; also the frames that were to be mapped, and what the record keeps of them."""
    every, wanted = options.recording.every, options.recording
    if not options.cluster.wanted and in_one_pass(recording, options):
        recording, color = found_color(recording, color)
        watched = options.watch.view or options.watch.view_window
        mapped = map_in_one_pass(
            recording, options, folder, stop, encoder, watcher, watched=watched
        )
        frames = recording[::every]
        return mapped, frames, source_of(wanted, len(frames), color)
    tracking, tracked, written, added = None, None, (), None
    if options.poses.tracked:
        recording, tracking = _track(recording, options, folder, stop, saver)
    recording, color = registered(recording, color, saver)
    if options.output.into is not None:
        added = placed(recording, options, saver, stop)
        recording, tracking = added.frames, {**(tracking or {"mode": "given"}), **added.details}
    if options.poses.tracked:
        assert isinstance(recording, PosedFrames)
        tracked, written = recording.tracking.frames, folder.tracking_files
    frames = recording[::every]
    source = replace(source_of(wanted, len(frames), color), before=added.sources if added else ())
    saver.describe(source, tracking)
    if options.cluster.wanted:
        poses = tracked and tracked[::every]
        mapped = Mapped(
            *run_on_workers(
                frames,
                source,
                poses,
                options.settings,
                options.cluster,
                folder,
                stop,
                encoder=options.image_encoder,
                resume=options.output.resume,
            ),
            None,
            (),
        )
    else:
        mapped = _map(frames, options, folder, stop, encoder, watcher, saver, added)
        if added and written:
            written = written if mapped.run.steps else ()
            if written:  # now: in the folder of the map itself that ends its record
                keep_tracking(folder, added.frames.tracking)
    return replace(mapped, tracking=tracking, written=(*written, *mapped.written)), frames, source


def _map(
    frames: Dataset,
    options: Reconstruct,
    folder: RunFolder,
    stop: Callable[[], bool],
    encoder: ImageEncoder | None,
    watcher: Watcher,
    saver: RunSaver,
    added: Addition | None = None,
) -> Mapped:
    """Fuse frames at the poses that they have, to maps that are there if they are added to some."""
    from ..pipeline import Pipeline

    output, store = options.output, None
    if output.keep_windows or (added and added.windows and not output.forget):
        store = open_store(folder, output, options.settings, moves=False, added=added)
    if store is not None:
        maps = maps_of(options, folder)
        pipeline = Pipeline(options.settings, encoder=encoder, keep=store, maps=maps)
    else:
        pipeline = make_pipeline(options, encoder, folder, saver)
    run = map_frames(
        pipeline,
        frames,
        len(frames),
        strict=options.recording.strict,
        stop=stop,
        watcher=watcher,
        on_border=saver.at_border if store is None else None,
        before=saver.resumed and saver.resumed.so_far,
    )
    kept = remembered(folder, frames, run, store, added, pipeline.config, stop)
    return Mapped(pipeline, run, None, (*keep_store(folder, store), *kept))


def _report_missing(run: RunResult, frames: int) -> int:
    """Say how many of the frames are not in the map; FAILED where these are most of those tried."""
    from ..run_log import SKIP_REASONS

    missing = frames - len(run.steps)
    if not missing:
        return DONE
    kinds = Counter(frame.reason for frame in run.skipped)
    if not_reached := missing - len(run.skipped):
        kinds["not reached"] = not_reached
    reasons = ", ".join(f"{count} {reason}" for reason, count in kinds.most_common())
    few = len(run.skipped) >= len(run.steps)
    unposed = kinds[SKIP_REASONS[PoseError]] > len(run.steps)
    logger.log(
        logging.ERROR if few else logging.WARNING,
        "%d of %d frames are not in the map: %s%s",
        missing,
        frames,
        reasons,
        "; --tracking rgbd finds poses from the frames alone" if unposed else "",
    )
    return FAILED if few else DONE


def _track(
    recording: Dataset,
    options: Reconstruct,
    folder: RunFolder,
    stop: Callable[[], bool],
    saver: RunSaver,
) -> tuple[PosedFrames, Mapping[str, Any]]:
    """The frames with the poses that are asked for, and what to say of them in the record.

    All frames are tracked, whatever --every leaves for the map: small steps are easier. Poses are
    written at once, so that they outlive whatever comes after; those of a recording that is added to a
    map wait until its place is known.
    """
    from .. import runtime

    if saver.tracked is not None:
        posed = PosedFrames(recording, saver.tracked)
        return posed, {"mode": options.poses.tracking, **posed.tracking.details}
    poses, settings = options.poses, options.settings
    runtime.init(settings.device, threads=settings.threads or None)
    with frame_progress(len(recording)) as on_frame:
        posed = track(
            recording,
            settings.tracking,
            settings.preprocess,
            mode=poses.tracking,
            trajectory=poses.trajectory,
            interpolate=poses.interpolate,
            body_camera=poses.body_camera,
            max_difference=options.recording.max_difference,
            stop=stop,
            on_frame=on_frame,
        )
    if options.output.into is None:
        keep_tracking(folder, posed.tracking)
    if not posed.tracking.interrupted:
        saver.save_tracking(posed.tracking)
    return posed, {"mode": poses.tracking, **posed.tracking.details}
