"""What workers do: fuse a shard, let its rays vote in the merged surface, add up tiles. Arguments and
results are small values and paths; maps stay on disk.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import replace

from .. import runtime
from ..config import Config
from ..datasets.loading import load_ahead
from ..errors import DatasetError, FileError, FrameError
from ..files.tiles import Tile, TileFolder
from ..maps.settings import parse_bytes
from ..maps.tile_merge import merge_tiles
from ..pipeline import Pipeline
from ..run_log import SKIP_REASONS, RunResult, SkippedFrame
from ..types import Trajectory
from .engine import own_kernels
from .shards import DONE, Job, Shard, ShardDone, read_done, write_done
from .votes import VOTES_MANIFEST, Voters, add_votes

SHARD_MEMORY = "1GB"  # of a shard's maps, where the run names no other
MAPS, VOTES = "maps", "votes"  # in the folder of a shard


def start(config: Config) -> None:
    """Start Taichi in a worker, with a cache of kernels of its own: its lock is for one process."""
    os.environ.update(own_kernels())
    runtime.init(config.device, threads=config.threads or None)


def without_votes(config: Config) -> Config:
    """The configuration of a shard: its rays vote when the surface of all shards is there."""
    memory = config.map_memory or SHARD_MEMORY
    return replace(config, surface=replace(config.surface, carve=False), map_memory=memory)


def fuse_shard(job: Job, shard: Shard) -> ShardDone:
    """Fuse the frames of a shard into tiles on disk, or find that this was done; raises FileError,
    DatasetError, MapCorrupt or CapacityError.
    """
    folder = shard.folder(job)
    if done := read_done(folder / DONE, job, shard):
        return done
    shutil.rmtree(folder, ignore_errors=True)  # what a worker left that was killed
    start(job.config)
    encoder = None if job.encoder is None else job.encoder.make()
    pipeline = Pipeline(without_votes(job.config), encoder=encoder, tiles=folder / MAPS)
    frames = job.frames(shard.first, shard.last)
    try:
        run = pipeline.run(frames)
    except DatasetError as error:  # not one frame of the shard could be used
        run = _nothing(job, shard, error)
    assert pipeline.memory is not None
    pipeline.memory.save()
    size = sum(each.folder.bytes for each in pipeline.memory.sets.values())
    done = ShardDone(shard, run, size)
    write_done(folder / DONE, job, done)
    return done


def _nothing(job: Job, shard: Shard, error: DatasetError) -> RunResult:
    places = job.source.asked[shard.first : shard.last]
    reason = next(iter(SKIP_REASONS.values()))
    skipped = tuple(SkippedFrame(place, reason, str(error)) for place in places)
    return RunResult((), skipped, Trajectory.of([], [], []), (), 0.0)


def merge_group(job: Job, name: str, parts: Sequence[str], out: str, tiles: Sequence[Tile]) -> int:
    """Add up some tiles of a map that lie in several folders, into a folder of their own; returns how
    many voxels they have.
    """
    start(job.config)
    folders = [TileFolder.open(part) for part in parts]
    manifest = folders[0].manifest
    if name == "surface":
        settings = {**manifest["settings"], "carve": job.config.surface.carve}
        manifest = {**manifest, "settings": settings}
    return merge_tiles(folders, TileFolder.create(out, manifest), tiles)


def vote(job: Job, shard: Shard, merged: str) -> int:
    """Let the rays of a shard's frames vote in the merged surface, and keep the votes beside the
    shard's maps; returns how many frames did.
    """
    folder = shard.folder(job)
    done = read_done(folder / DONE, job, shard)
    if done is None:
        raise FileError(f"{folder / DONE}: the shard is no longer there")
    start(job.config)
    used = {step.index for step in done.run.steps}
    limit = parse_bytes(without_votes(job.config).map_memory, "map_memory")
    voters = Voters(TileFolder.open(merged), job.config.preprocess, limit)
    for load in load_ahead(job.frames(shard.first, shard.last, color=False)):
        try:
            frame = load()
        except FrameError:  # it was not fused either
            continue
        if frame.index in used:
            voters.add(frame)
    shutil.rmtree(folder / VOTES, ignore_errors=True)
    TileFolder.create(folder / VOTES, VOTES_MANIFEST).write(voters.votes().items())
    return len(used)


def add_group(job: Job, surface: str, votes: Sequence[str], out: str, tiles: Sequence[Tile]) -> int:
    """Add votes to some tiles of the merged surface, into a folder of their own; returns how many
    tiles these are.
    """
    start(job.config)
    folder = TileFolder.open(surface)
    voted = TileFolder.create(out, folder.manifest)
    add_votes(folder, [TileFolder.open(each) for each in votes], voted, tiles)
    return len(tiles)
