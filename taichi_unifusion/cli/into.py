"""`--into DIR`: a new recording is added to the map of an earlier run, whose world it joins."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..config import Config, load_config
from ..datasets import Dataset
from ..datasets.loading import index_in_recording
from ..errors import FileError, InputError, NoOverlap
from .options import RunOptions

if TYPE_CHECKING:
    from ..maps import BaseMap
    from ..maps.window_store import WindowStore
    from ..results import RunFolder
    from ..results.placement import Placement
    from ..results.record import Source
    from ..results.saver import RunSaver
    from ..run_log import RunResult
    from ..tracking.joining import Joined
    from ..tracking.keyframes import Keyframes
    from ..tracking.sequence import PosedFrames

logger = logging.getLogger(__name__)
POSED = ("given", "external")  # poses that stay as they are relative to each other


@dataclass(frozen=True, eq=False)
class Addition:
    """A recording in the world of the map that it is added to."""

    frames: PosedFrames
    keyframes: Keyframes  # of the map, and of the recording
    details: Mapping[str, Any]  # for the record
    sources: tuple[Source, ...]  # what the map was made from, in order
    windows: Path | None  # what its windows were fused from, if that was kept


def check_into(options: RunOptions, on_workers: bool) -> None:
    """Raise InputError for options that --into does not go with, FileError where there is no map."""
    from ..results.merging import SETTINGS
    from ..results.record import read_record
    from ..results.run_folder import RunFolder

    output, into = options.output, options.output.into
    if into is None:
        return
    if on_workers:
        raise InputError(
            "--into: one process adds a recording to a map; leave --workers and --cluster out"
        )
    known, goes_on = RunFolder(into), output.resume and RunFolder(output.out).placement.exists()
    before = settings_of(into)
    if not goes_on:
        read_record(known.record)
    _check_tiles(known, options)
    for name in SETTINGS:
        if getattr(options.settings, name) != getattr(before, name):
            raise InputError(
                f"--into: settings of maps stay those of {into}, and '{name}' is another one here; leave it out"
            )
    if output.keep_windows and not known.windows.exists():
        raise InputError(
            f"--keep-windows: {into} holds no {known.windows.name}, so that of both would lack what it was made "
            "from; leave it out"
        )


def _tiled(options: RunOptions) -> bool:
    return bool(options.settings.map_memory)


def _check_tiles(known: RunFolder, options: RunOptions) -> None:
    """Raise InputError where a map in tiles is to be kept in memory as a whole; say what else changes."""
    from ..files.tiles import TileFolder

    if _tiled(options):
        if known.windows.exists():
            logger.warning(
                "%s is not gone on with: maps in tiles cannot follow a trajectory that changes",
                known.windows.name,
            )
    elif any(map(TileFolder.is_one, known.maps.values())):
        raise InputError(
            f"--into: the maps of {known.path} lie in tiles: keep them so with --map-memory 2GB, or another limit"
        )


def settings_of(into: str | Path) -> Config:
    """The settings of the run that a recording is added to."""
    from ..results.run_folder import RunFolder

    file = RunFolder(Path(into)).config
    if not file.exists():
        raise FileError(
            f"{into}: holds no {file.name}; give --into the results of `unifusion reconstruct`"
        )
    return load_config(file)


def maps_of(options: RunOptions, folder: RunFolder) -> dict[str, BaseMap] | None:
    """The maps that a recording is added to, which are read; those in tiles are laid out in the `folder`
    of the run instead. None without --into. Starts Taichi; raises FileError where a run was ended while
    it wrote them.
    """
    from .. import runtime
    from ..files.tiles import TileFolder
    from ..maps import load_map
    from ..results.record import read_record
    from ..results.run_folder import RunFolder

    if options.output.into is None:
        return None
    runtime.init(options.settings.device, threads=options.settings.threads or None)
    found = {}
    known = RunFolder(options.output.into)
    read_record(known.record)  # a run that was ended while it wrote has none
    for name, path in known.maps.items():
        if TileFolder.is_one(path):
            TileFolder.open(path).snapshot(folder.working_tiles / name)
        else:
            found[name] = load_map(path)
    return found


def remembered(
    folder: RunFolder,
    frames: Dataset,
    run: RunResult,
    store: WindowStore | None,
    added: Addition | None,
    config: Config,
    stop: Callable[[], bool],
) -> tuple[Path, ...]:
    """Keep the keyframes of a run that keeps its windows, and of one that was added to a map; the
    files that are there then.
    """
    from ..results.keyframes import keyframes_of_run

    in_file = store is not None and store.path is not None
    if not run.steps or not (in_file or added):
        return ()
    found = added.keyframes if added else keyframes_of_run(frames, run, config, stop)
    return keep_keyframes(folder, found)


def keep_keyframes(folder: RunFolder, found: Keyframes | None) -> tuple[Path, ...]:
    """Write keyframes, if there are any; the files that are there then."""
    from ..tracking.keyframe_file import write_keyframes

    if not found:
        return ()
    size = write_keyframes(folder.new_keyframes, found)
    folder.new_keyframes.replace(folder.keyframes)
    logger.info(
        "%d keyframes kept, %.1f MB: --into finds its place by them", len(found), size / 1e6
    )
    return (folder.keyframes,)


def placed(
    recording: Dataset, options: RunOptions, saver: RunSaver, stop: Callable[[], bool]
) -> Addition:
    """The recording, which has poses, in the world of the map, where the run that goes on found it, if
    one does; raises NoOverlap where its place is not sure, and leaves nothing behind then.
    """
    from ..results.run_folder import RunFolder
    from ..results.safe_point import remove_safe_point

    assert options.output.into is not None
    into = RunFolder(options.output.into)
    if saver.placed is not None:
        placement, known = saver.placed
        logger.info("%s", placement.details["joined"]["said"])
    else:
        try:
            placement, known = _found(recording, options, stop)
        except NoOverlap:
            remove_safe_point(saver.folder)
            raise
        if not stop():
            saver.save_placement(placement, known)
    if into.path.resolve() == saver.folder.path.resolve():
        saver.save_soon()
    return Addition(
        moved(recording, placement),
        known,
        placement.details,
        placement.sources,
        into.windows if into.windows.exists() else None,
    )


def _found(
    recording: Dataset, options: RunOptions, stop: Callable[[], bool]
) -> tuple[Placement, Keyframes]:
    """The place of the recording, and the keyframes of the map and the recording."""
    from .. import runtime
    from ..geometry import se3
    from ..results.keyframes import depth_range, known_keyframes
    from ..results.placement import Placement
    from ..results.reader import sources_of
    from ..results.run_folder import RunFolder
    from ..tracking.joining import join, keyframes_of

    assert options.output.into is not None
    settings = options.settings
    runtime.init(settings.device, threads=settings.threads or None)
    known = known_keyframes(RunFolder(options.output.into))
    new = keyframes_of(recording, depth_range(settings), stop)
    logger.info("looking for the place of %d views among %d of the map", len(new), len(known))
    joined = join(
        known,
        new,
        settings.tracking.photometric_weight,
        rigid=options.poses.mode in POSED,
    )
    logger.info("%s", sentence(joined, len(new)))
    motion = joined.T_known_keyframe @ se3.inverse(np.array(new.T_world_keyframe))
    for keyframe, T in zip(new.items, joined.T_known_keyframe, strict=True):
        known.append(keyframe, T)
    folder = RunFolder(options.output.into)
    placement = Placement(
        tuple(keyframe.index for keyframe in new.items),
        motion,
        {"joined": details_of(joined, folder.path, len(new))},
        sources_of(folder),
    )
    return placement, known


def sentence(joined: Joined, views: int) -> str:
    """What was found, to say."""
    return (
        f"{joined.matched} of {views} views were recognised, {joined.aligned} pairs aligned: "
        f"{joined.agreement:.0%} of what both see agrees; poses were bent by up to {100 * joined.bent:.1f} cm"
    )


def details_of(joined: Joined, into: Path, views: int) -> dict[str, Any]:
    """What the record keeps of it."""
    return {
        "into": str(into),
        "said": sentence(joined, views),
        "recognised": joined.matched,
        "aligned": joined.aligned,
        "agreement": round(joined.agreement, 4),
        "bent": round(joined.bent, 5),
        "T_map_recording": joined.T_known_new.tolist(),
    }


def moved(recording: Dataset, placement: Placement) -> PosedFrames:
    """The frames at their new poses: each moves with the keyframe before it."""
    from ..geometry import se3
    from ..tracking.sequence import PosedFrames, with_poses

    starts, motion = np.array(placement.places), placement.motion
    poses = {}
    for i in range(len(recording)):
        place, T = index_in_recording(recording, i), recording.pose_at(i)[1]
        if T is not None and np.isfinite(T).all():
            row = max(int(np.searchsorted(starts, place, "right")) - 1, 0)
            poses[place] = se3.normalized(motion[row] @ T)
    there = with_poses(recording, poses)
    if not isinstance(recording, PosedFrames):
        return there
    found = zip(recording.tracking.frames, there.tracking.frames, strict=True)
    frames = tuple(replace(was, T_world_camera=now.T_world_camera) for was, now in found)
    return PosedFrames(recording, replace(recording.tracking, frames=frames))
