"""`--resume`: a run that was ended goes on from its last safe point."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING

from ..config import dump_config, load_config
from ..datasets import Dataset
from ..errors import FileError, InputError
from ..results.record import ColorRecord, read_record
from ..results.run_folder import RunFolder
from .color_camera import found_color
from .into import maps_of
from .options import OutputOptions, RunOptions, source_of

if TYPE_CHECKING:
    from ..maps.window_store import WindowStore
    from ..networks.encoders import ImageEncoder
    from ..pipeline import Pipeline
    from ..results.saver import RunSaver

logger = logging.getLogger(__name__)


def open_saver(
    frames: int, options: RunOptions, folder: RunFolder, encoder: ImageEncoder | None
) -> RunSaver:
    """What makes safe points of a run, and knows the one to go on from; raises InputError where
    that belongs to a run of other options.
    """
    from ..results.safe_point import Recipe
    from ..results.saver import RunSaver

    output, poses = options.output, options.poses
    if not output.save_every >= 0:
        raise InputError(f"--save-every: seconds must be 0 or more, got {output.save_every:g}")
    recipe = Recipe(
        config=dump_config(options.settings),
        recording=source_of(options.recording, frames),
        poses={
            "tracking": poses.mode,
            "trajectory": str(poses.trajectory or ""),
            "interpolate": poses.interpolate,
            **({"into": str(output.into)} if output.into else {}),
            **({"passes": 1} if poses.tracked and poses.tracking_passes == 1 else {}),
            **({"windows": kept} if (kept := _windows(output)) else {}),
        },
        color_camera=options.recording.color_camera,
        features=encoder.name if encoder else "",
    )
    saver = RunSaver(folder, recipe, output.save_every, resume=output.resume)
    if (
        options.cluster.wanted
    ):  # shards are done or not; only poses that a tracker found are gone on with
        saver.resumed = None
        return saver
    if saver.resumed is not None:
        state = saver.resumed.state
        logger.info("going on after %d of %d frames", state.done, frames)
    elif output.resume:
        logger.info(
            "%s holds no safe point: %s",
            folder.path,
            "its poses are used, the map begins anew" if saver.tracked else "the run begins anew",
        )
    return saver


def _windows(output: OutputOptions) -> str:
    """What was said of windows: "" for nothing."""
    return "kept" if output.keep_windows else "forgotten" if output.forget else ""


def is_complete(folder: RunFolder, frames: int, options: RunOptions) -> bool:
    """Whether a folder holds the whole run already that is to go on."""
    if not options.output.resume or folder.unfinished.exists():
        return False
    try:
        record, used = read_record(folder.record), load_config(folder.config)
    except (FileError, InputError):
        return False
    done, source, wanted = record.frames, record.recording, options.settings
    settled = replace(wanted, voxel_size=wanted.voxel_size or used.voxel_size).settled(())
    if options.cluster.wanted:  # what workers choose for themselves
        settled = replace(settled, threads=used.threads, map_memory=used.map_memory)
    tracking = record.tracking or {"mode": "given"}
    mode, into = tracking["mode"], tracking.get("joined", {}).get("into", "")
    asked = source_of(options.recording, frames, source and source.color)
    return (
        source is not None
        and replace(source, before=()) == asked
        and into == str(options.output.into or "")
        and settled == used
        and mode == options.poses.mode
        and not (
            options.output.keep_windows and folder.relative(folder.windows) not in record.files
        )
        and not (done.interrupted or record.errors)
        and done.used + done.skipped == frames
    )


def registered(
    recording: Dataset, color: ColorRecord, saver: RunSaver
) -> tuple[Dataset, ColorRecord]:
    """The recording with its colour camera, which is looked for but once in a run."""
    known = saver.resumed.state.recording.color if saver.resumed else None
    if known is None or known.camera is None:
        return found_color(recording, color)
    from ..results.reader import registered_as

    logger.info("colour: %s", known.verdict)
    return registered_as(recording, known), known


def make_pipeline(
    options: RunOptions,
    encoder: ImageEncoder | None,
    folder: RunFolder,
    saver: RunSaver,
    store: WindowStore | None = None,
) -> Pipeline:
    """The pipeline of a run, with the maps of the safe point that it goes on from, or else of the run that
    it is added to. It keeps its windows in a `store`, if there is one.
    """
    from .. import runtime
    from ..pipeline import Pipeline
    from ..results.safe_point import read_maps, read_settings, restore_tiles

    if saver.resumed is None:
        shutil.rmtree(folder.working_tiles, ignore_errors=True)  # of a run that was killed
        maps, tiles = maps_of(options, folder), folder.working_tiles
        return Pipeline(options.settings, encoder=encoder, keep=store, maps=maps, tiles=tiles)
    settings = options.settings
    runtime.init(settings.device, threads=settings.threads or None)
    state = saver.resumed.state
    maps = {} if restore_tiles(folder, state) else read_maps(folder, state)
    tiles = folder.working_tiles
    settings = read_settings(folder, state)
    pipeline = Pipeline(settings, encoder=encoder, keep=store, maps=maps, tiles=tiles)
    pipeline.fusion.borders = state.borders
    if pipeline.follower is not None and state.windows is not None:
        pipeline.follower.settled = state.windows.settled
    return pipeline


def end_saving(folder: RunFolder, done: bool) -> None:
    """Remove the safe points of a run that is done, or say that it can go on."""
    from ..results.safe_point import read_state, remove_safe_point

    if done:
        remove_safe_point(folder)
    elif (state := read_state(folder)) is not None:
        logger.info(
            "%d frames are safe: the same command with --resume goes on from there", state.done
        )
