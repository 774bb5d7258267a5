"""What `--workers` and `--cluster` change in a run: other processes fuse its frames."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..cluster.engine import ClusterSettings, open_engine
from ..config import Config
from ..datasets import Dataset
from ..errors import InputError, UniFusionError
from ..tracking.base import TrackedFrame
from .terminal import frame_progress

if TYPE_CHECKING:
    from ..language import EncoderChoice
    from ..pipeline import Pipeline
    from ..results import RunFolder
    from ..results.record import Source
    from ..run_log import RunResult

logger = logging.getLogger(__name__)


def run_on_workers(
    frames: Dataset,
    source: Source,
    tracked: tuple[TrackedFrame, ...] | None,
    config: Config,
    cluster: ClusterSettings,
    folder: RunFolder,
    stop: Callable[[], bool],
    *,
    encoder: EncoderChoice | None,
    resume: bool,
) -> tuple[Pipeline, RunResult]:
    """Fuse the frames of a run on workers; `tracked` has their poses where these are not the
    recording's. Returns a pipeline with the maps, in tiles, and what the workers did.

    With `resume`, what was done for the same run in an earlier try is not done again. Raises
    MissingDependency without Dask, InputError where workers cannot be reached, and what a worker ended
    with.
    """
    from ..cluster.run import Progress, fuse_on_workers
    from ..cluster.shards import Job, count_done
    from ..pipeline import first_frames

    settled = config.settled(tuple(first_frames(frames, stop)))
    threads = config.threads or cluster.share
    if not resume:
        remove_shards(folder.shards)
    job = Job(source, tracked, replace(settled, threads=threads), str(folder.shards), encoder)
    with open_engine(cluster) as engine:
        logger.info("%d workers fuse %d frames", engine.workers, len(frames))
        try:
            with frame_progress(len(frames)) as on_frame:
                tiles = folder.working_tiles
                return fuse_on_workers(job, tiles, engine, Progress(on_frame, stop))
        except (UniFusionError, KeyboardInterrupt):
            logger.info(
                "%d shards are done: the same command with --resume goes on from there",
                count_done(folder.shards),
            )
            raise


def remove_shards(folder: Path) -> None:
    """Remove what lies on disk of shards, after the run is done."""
    shutil.rmtree(folder, ignore_errors=True)


def check_workers(cluster: ClusterSettings, live: bool) -> None:
    """Raise InputError where something is asked for that workers cannot do."""
    if cluster.wanted and live:
        raise InputError("--workers and --cluster cannot be watched: leave --view out")
