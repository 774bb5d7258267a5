"""`unifusion reconstruct`: frames -> maps -> mesh -> results folder."""

from __future__ import annotations

import json
import logging
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from tyro.conf import arg

from ..cluster.engine import ClusterSettings
from ..config import Config
from ..datasets import Dataset
from ..errors import InputError, PoseError
from ..geometry.gravity import Up, parse_up
from ..tracking import check_poses
from .color_camera import given_color
from .interrupts import INTERRUPTED
from .into import check_into
from .live import LiveOptions, reconstruct_live
from .mapping import map_recording
from .on_workers import check_workers, remove_shards
from .options import (
    OutputOptions,
    RecordingOptions,
    Settings,
    TrackingOptions,
    for_mapping,
    open_recording,
)
from .replacing import say_what_is_replaced
from .resuming import end_saving, is_complete, open_saver
from .run import Run
from .terminal import DONE, FAILED, report
from .viewing import WatchOptions, run_watched

if TYPE_CHECKING:
    from ..language import EncoderChoice
    from ..networks.encoders import ImageEncoder
    from ..results.record import ColorRecord
    from ..run_log import RunResult

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
        raise InputError(
            "--into: not with --live, whose map begins before its place in the other is known; leave it out, "
            "and bring both together afterwards: unifusion merge DIR LIVE --align --out BOTH"
        )
    if options.live.live:
        return reconstruct_live(
            options.recording,
            options.poses,
            options.output,
            options.watch,
            options.live,
            options.settings,
        )
    options = replace(options, recording=for_mapping(options.recording))
    return fuse(open_recording(options.recording), options)


def fuse(recording: Dataset, options: Reconstruct, encoder: ImageEncoder | None = None) -> int:
    """What every command does that makes maps, of a recording that is open; with an image encoder
    also a map of its features.
    """
    options = replace(options, poses=options.poses.for_recording(recording))
    check_poses(recording, options.poses.mode, options.poses.trajectory)
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
            lambda watcher, stop: _map_and_write(
                recording, color, up, Run(options, folder, saver, encoder, watcher, stop)
            ),
        )


def _map_and_write(recording: Dataset, color: ColorRecord, up: Up | None, made: Run) -> int:
    """Map the frames and write the results; the exit code."""
    from ..results.summary import summarize
    from ..results.writer import write_results

    folder = made.folder
    mapped, frames, source = map_recording(recording, color, made)
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
        if made.options.output.json
        else summarize(results.record, results.files, folder.path)
    )
    ended = [error for error in (run.failure, *results.failures) if error]
    code = report(ended)
    end_saving(folder, done=not (run.interrupted or ended))
    code = _report_missing(run, len(frames), tracked=mapped.tracking is not None) or code
    return INTERRUPTED if made.stop() else code


def _report_missing(run: RunResult, frames: int, *, tracked: bool) -> int:
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
    unposed = not tracked and kinds[SKIP_REASONS[PoseError]] > len(run.steps)
    logger.log(
        logging.ERROR if few else logging.WARNING,
        "%d of %d frames are not in the map: %s%s",
        missing,
        frames,
        reasons,
        "; --tracking rgbd finds poses from the frames alone" if unposed else "",
    )
    return FAILED if few else DONE
