"""One recording on many workers: shards are fused, added up tile by tile, and voted in.

shards  = cut(frames, where windows start)
partial = fuse_shard(shard)                 on every worker; tiles on disk
merged  = merge_group(tiles of all shards)  Eq. 19
votes   = vote(shard, merged)               rays against the surface of all shards
maps    = add_group(merged, votes)          and the mesh is made tile by tile
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..errors import DatasetError, UniFusionError
from ..files.tiles import Tile, TileFolder
from ..maps import FeatureMap, empty_map
from ..maps.stored import describe_tiles
from ..pipeline import Pipeline
from ..run_log import RunResult
from .engine import Engine
from .shards import (
    Job,
    Shard,
    ShardDone,
    count_done,
    cut,
    joined,
    read_plan,
    window_starts,
    write_plan,
)
from .work import MAPS, VOTES, add_group, fuse_shard, merge_group, vote

logger = logging.getLogger(__name__)

T = TypeVar("T")

SHARDS_A_WORKER = 2  # at least, so that nobody waits long for the last one
LARGEST_SHARD = 500  # frames
GROUPS_A_WORKER = 2  # of tiles


@dataclass(frozen=True)
class Progress:
    """Who is told how much is done, and asked whether to go on."""

    on_frame: Callable[[int, int], None] = lambda done, total: None
    stop: Callable[[], bool] = lambda: False


def fuse_on_workers(
    job: Job, maps: Path, engine: Engine, progress: Progress
) -> tuple[Pipeline, RunResult]:
    """The maps of all frames in tiles in a folder, a folder a map, and what all shards did; a run that
    goes on is cut where it was before.

    What was done for the same run before is not done again. Raises the first error of a worker,
    with what is done kept for the next try; DatasetError where no frame could be used.
    """
    shards = read_plan(Path(job.folder), job.source.frames) or plan(job, engine.workers)
    write_plan(Path(job.folder), shards)
    if earlier := count_done(Path(job.folder)):
        logger.info("%d of %d shards are done already", earlier, len(shards))
    frames = job.source.frames
    done_frames = 0

    def fused() -> None:
        nonlocal done_frames
        done_frames += 1
        progress.on_frame(round(frames * done_frames / len(shards) * 0.8), frames)

    done = _all(engine.map(fuse_shard, [(job, each) for each in shards], fused, progress.stop))
    done = [each for each in done if each.run.steps]
    if not done:
        raise DatasetError("not one frame could be used: see the warnings")
    merged = _merge(job, done, engine)
    progress.on_frame(round(0.9 * frames), frames)
    if job.config.surface.carve:
        _vote(job, done, merged["surface"], engine)
    pipeline = _pipeline_of(job, merged, maps)
    progress.on_frame(frames, frames)
    return pipeline, joined([each.run for each in done])


def plan(job: Job, workers: int) -> list[Shard]:
    """Where the frames of a run are cut."""
    source = job.source
    if job.tracked is not None:
        poses = [each.T_world_camera for each in job.tracked]
    else:
        recording = job.frames(0, source.frames)
        poses = [recording.pose_at(i)[1] for i in range(len(recording))]
    starts = window_starts(poses, list(source.asked), job.config.window)
    wanted = max(SHARDS_A_WORKER * workers, -(-source.frames // LARGEST_SHARD))
    return cut(source.frames, starts, wanted)


def _merge(job: Job, done: Sequence[ShardDone], engine: Engine) -> dict[str, TileFolder]:
    """The sum of all shards' maps, by name."""
    folder = Path(job.folder) / "merged"
    shutil.rmtree(folder, ignore_errors=True)
    parts: dict[str, list[TileFolder]] = {}
    for each in done:
        for path in sorted((each.shard.folder(job) / MAPS).iterdir()):
            parts.setdefault(path.name, []).append(TileFolder.open(path))
    arguments = []
    for name, folders in parts.items():
        for n, group in enumerate(_groups(folders, GROUPS_A_WORKER * engine.workers)):
            paths = [str(each.path) for each in folders]
            arguments.append((job, name, paths, str(folder / f"{name}-{n}"), group))
    _all(engine.map(merge_group, arguments))
    return {
        name: _adopted(folder / name, [Path(each[3]) for each in arguments if each[1] == name])
        for name in parts
    }


def _vote(job: Job, done: Sequence[ShardDone], surface: TileFolder, engine: Engine) -> None:
    """Let the rays of all shards vote in the merged surface, and keep the votes there."""
    _all(engine.map(vote, [(job, each.shard, str(surface.path)) for each in done]))
    votes = [str(each.shard.folder(job) / VOTES) for each in done]
    groups = _groups([surface], GROUPS_A_WORKER * engine.workers)
    folders = [surface.path.parent / f"voted-{n}" for n in range(len(groups))]
    arguments = [
        (job, str(surface.path), votes, str(out), group)
        for out, group in zip(folders, groups, strict=True)
    ]
    _all(engine.map(add_group, arguments))
    for out in folders:
        surface.adopt(TileFolder.open(out))


def _pipeline_of(job: Job, merged: dict[str, TileFolder], maps: Path) -> Pipeline:
    """A pipeline whose maps lie in tiles in a folder, where the merged ones are moved to."""
    memory = job.config.map_memory or "2GB"
    shutil.rmtree(maps, ignore_errors=True)  # of a run that was killed
    described = {name: describe_tiles(folder) for name, folder in merged.items()}
    features = {
        name: empty_map(each) for name, each in described.items() if each.kind == FeatureMap.kind
    }  # a pipeline makes the other maps by itself
    config = replace(job.config, map_memory=memory)
    pipeline = Pipeline(config, tiles=maps, maps=features)
    assert pipeline.memory is not None
    for name in pipeline.maps:
        if name in merged:
            pipeline.memory.sets[name].folder.adopt(merged[name])
    return pipeline


def _adopted(path: Path, parts: Sequence[Path]) -> TileFolder:
    """One folder with the tiles of several."""
    folders = [TileFolder.open(part) for part in parts]
    out = TileFolder.create(path, folders[0].manifest)
    for each in folders:
        out.adopt(each)
    return out


def _groups(folders: Sequence[TileFolder], count: int) -> list[list[Tile]]:
    """All tiles of several folders, in order, in so many groups, or fewer."""
    tiles = sorted({tile for each in folders for tile in each.tiles})
    parts = np.array_split(np.arange(len(tiles)), max(min(count, len(tiles)), 1))
    return [[tiles[i] for i in part] for part in parts if len(part)]


def _all(results: Sequence[T | UniFusionError | None]) -> list[T]:
    """The results, if all are there; raises the first error, KeyboardInterrupt where work was
    stopped.
    """
    for each in results:
        if isinstance(each, UniFusionError):
            raise each
    if any(each is None for each in results):
        raise KeyboardInterrupt
    return [each for each in results if each is not None and not isinstance(each, UniFusionError)]
