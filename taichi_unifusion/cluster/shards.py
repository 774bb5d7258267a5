"""Shards: stretches of a recording that are fused by themselves, cut where a window ends, so that they
hold the windows that one process would fuse.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import Config
from ..datasets import Dataset, open_dataset
from ..errors import FileError
from ..files.atomic import read_bytes, write_text
from ..geometry.se3 import distance
from ..language import EncoderChoice
from ..maps import Integration
from ..maps.window import FARTHEST_MOVE, GAP, LARGEST_TURN
from ..results.reader import registered_as
from ..results.record import Source
from ..run_log import RunResult, SkippedFrame, StepResult
from ..tracking.base import TrackedFrame, TrackingResult
from ..types import Trajectory

DONE, PLAN = "done.json", "plan.json"  # of a shard, of all


@dataclass(frozen=True)
class Job:
    """What all shards of a run have in common; a value that goes to other processes."""

    source: Source  # the frames asked for
    tracked: tuple[TrackedFrame, ...] | None  # their poses, if not the recording's
    config: Config  # with the sizes of all voxels
    folder: str  # where shards lie; all processes can read and write there
    encoder: EncoderChoice | None = None  # of image-text features, if they are mapped

    def frames(self, first: int, last: int, *, color: bool = True) -> Dataset:
        """The frames of the run from one place to another, with their colour or perhaps without; raises
        DatasetError.
        """
        from ..tracking.sequence import PosedFrames

        source = self.source
        recording = open_dataset(source.format, source.path or None, **source.reading)
        recording = registered_as(recording, source.color) if color else recording.depth_only()
        asked = source.asked[first:last]
        frames = recording[asked.start : asked.stop : asked.step]
        if self.tracked is None:
            return frames
        return PosedFrames(frames, TrackingResult(self.tracked[first:last]))


@dataclass(frozen=True)
class Shard:
    """Frames of a run that are fused together, by their places among those asked for."""

    number: int
    first: int
    last: int  # not included

    def folder(self, job: Job) -> Path:
        """Where its maps lie."""
        return Path(job.folder) / f"{self.number:05d}"


@dataclass(frozen=True)
class ShardDone:
    """A shard that was fused: what that did, and how large its maps are."""

    shard: Shard
    run: RunResult
    bytes: int


def window_starts(
    T_world_camera: Sequence[NDArray | None], indices: Sequence[int], size: int
) -> list[int]:
    """The places of the frames that begin a window, as `WindowFusion` ends windows of at most `size`
    frames; frames without a pose (None) belong to none.
    """
    starts: list[int] = []
    keyframe, frames, last, stride = None, 0, 0, 0
    for place, (T, index) in enumerate(zip(T_world_camera, indices, strict=True)):
        if T is None:
            continue
        gap = stride and abs(index - last) > GAP * stride
        if keyframe is not None and frames < size and not gap:
            moved, turned = distance(keyframe, T)
            near = moved <= FARTHEST_MOVE and np.degrees(turned) <= LARGEST_TURN
        else:
            near = False
        if not near:
            starts.append(place)
            keyframe, frames = T, 0
        frames += 1
        if last and not stride:
            stride = abs(index - last)
        last = index
    return starts


def cut(frames: int, starts: Sequence[int], shards: int) -> list[Shard]:
    """So many shards of about as many frames each, cut where windows start; fewer where there are
    not as many windows.
    """
    wanted = np.linspace(0, frames, shards + 1)[1:-1]
    borders = (
        {min(starts, key=lambda start: abs(start - place)) for place in wanted} if starts else set()
    )
    ends = sorted({0, frames, *(border for border in borders if 0 < border < frames)})
    return [Shard(n, a, b) for n, (a, b) in enumerate(zip(ends, ends[1:], strict=False))]


def write_done(path: Path, job: Job, done: ShardDone) -> None:
    """Keep on disk that a shard is done, and what that did; raises FileError."""
    run = done.run
    values = {
        "recipe": recipe(job, done.shard),
        "steps": [asdict(step) for step in run.steps],
        "skipped": [asdict(frame) for frame in run.skipped],
        "timestamps": run.trajectory.timestamps.tolist(),
        "poses": run.trajectory.T_world_camera.tolist(),
        "warnings": run.warnings,
        "seconds": run.seconds,
        "failure": None if run.failure is None else str(run.failure),
        "bytes": done.bytes,
    }
    write_text(path, json.dumps(values) + "\n")


def write_plan(folder: Path, shards: Sequence[Shard]) -> None:
    """Keep where a run is cut, so that one which goes on with other workers is cut there too; raises
    FileError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / PLAN, json.dumps([[each.first, each.last] for each in shards]) + "\n")


def read_plan(folder: Path, frames: int) -> list[Shard]:
    """Where a run of so many frames was cut before; none where it was not."""
    try:
        ends = json.loads(read_bytes(folder / PLAN))
        shards = [Shard(n, int(first), int(last)) for n, (first, last) in enumerate(ends)]
    except (FileError, TypeError, ValueError):
        return []
    borders = [0, *(each.last for each in shards)]
    firsts = [*(each.first for each in shards), frames]
    return shards if borders == firsts else []


def count_done(folder: Path) -> int:
    """How many shards were done, of whatever run."""
    return len(list(folder.glob(f"*/{DONE}")))


def read_done(path: Path, job: Job, shard: Shard) -> ShardDone | None:
    """What is on disk of a shard that was done for the same run; None where it was not."""
    try:
        values = json.loads(read_bytes(path))
        if values["recipe"] != recipe(job, shard):
            return None
        steps = tuple(_step(each) for each in values["steps"])
        skipped = tuple(SkippedFrame(**each) for each in values["skipped"])
        trajectory = Trajectory.of(
            [float(stamp) for stamp in values["timestamps"]],
            list(range(len(values["timestamps"]))),
            [np.array(T) for T in values["poses"]],
        )
        failure = None if values["failure"] is None else FileError(values["failure"])
        run = RunResult(
            steps, skipped, trajectory, tuple(values["warnings"]), values["seconds"], False, failure
        )
        return ShardDone(shard, run, int(values["bytes"]))
    except (FileError, KeyError, TypeError, ValueError):
        return None


def recipe(job: Job, shard: Shard) -> dict[str, Any]:
    """What a shard's maps depend on, as JSON values."""
    poses = None
    if job.tracked is not None:
        poses = [
            None if each.T_world_camera is None else each.T_world_camera.tolist()
            for each in job.tracked[shard.first : shard.last]
        ]
    values = {
        "source": asdict(job.source),
        "poses": poses,
        "features": None if job.encoder is None else asdict(job.encoder),
        "config": asdict(replace(job.config, threads=0, map_memory="")),
        "frames": [shard.first, shard.last],
    }
    return json.loads(json.dumps(values, default=str))


def _step(values: dict[str, Any]) -> StepResult:
    done = {name: Integration(**each) for name, each in values["integrations"].items()}
    return StepResult(**{**values, "integrations": done})


def joined(runs: Sequence[RunResult]) -> RunResult:
    """What all shards did together, in order."""
    stamps = np.concatenate([run.trajectory.timestamps for run in runs])
    poses = np.concatenate([run.trajectory.T_world_camera for run in runs])
    return RunResult(
        tuple(step for run in runs for step in run.steps),
        tuple(frame for run in runs for frame in run.skipped),
        replace(runs[0].trajectory, timestamps=stamps, T_world_camera=poses),
        tuple(dict.fromkeys(sentence for run in runs for sentence in run.warnings)),
        sum(run.seconds for run in runs),
        any(run.interrupted for run in runs),
        next((run.failure for run in runs if run.failure), None),
    )
