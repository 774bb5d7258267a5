"""Measures a run: its pipeline, its result and its files become a RunRecord."""

from __future__ import annotations

import platform
import resource
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np

from .. import __version__, runtime
from ..files.tiles import map_bytes
from ..pipeline import Pipeline
from ..rendering.look import Look, shown_range
from ..run_log import RunResult, StepResult
from ..types import Mesh
from .folder_writer import FolderWriter
from .property_files import looks_of
from .record import (
    FrameCounts,
    Lacking,
    MapRecord,
    MeshRecord,
    Milliseconds,
    PointCounts,
    PropertyRecord,
    RunRecord,
    Seconds,
    Skipped,
    SkipReason,
    Source,
)


def measure_run(
    writer: FolderWriter,
    pipeline: Pipeline,
    run: RunResult,
    mesh: Mesh | None,
    seconds: Seconds,
    recording: Source | None = None,
    tracking: Mapping[str, Any] | None = None,
) -> RunRecord:
    """The record of a run whose files are written."""
    device, folder = runtime.current(), writer.folder
    failed = (run.failure, *writer.failures)
    return RunRecord(
        recording=recording,
        tracking=tracking,
        device=device.device,
        device_name=device.description,
        frames=_count_frames(run),
        milliseconds=stage_milliseconds(run.steps),
        seconds=seconds,
        points=PointCounts(
            median=median(step.points for step in run.steps),
            total=sum(step.points for step in run.steps),
        ),
        maps={
            name: MapRecord(
                target.voxel_size,
                _voxels(pipeline, name),
                target.memory_bytes,
                map_bytes(folder.saved_map(name)),
            )
            for name, target in pipeline.maps.items()
        },
        properties={
            name: _shown(mesh, name, look, run) for name, look in looks_of(pipeline).items()
        },
        mesh=None if mesh is None else MeshRecord(len(mesh.vertices), len(mesh.faces)),
        # Linux counts KiB
        peak_memory_bytes=1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        files={folder.relative(file): _size(file) for file in writer.written},
        warnings=run.warnings,
        doubts=run.doubts,
        errors=tuple(str(error) for error in failed if error is not None),
        versions=versions(),
    )


def _voxels(pipeline: Pipeline, name: str) -> int:
    """Voxels of a map, those on disk included."""
    if pipeline.memory:
        return pipeline.memory.sets[name].folder.voxels
    return len(pipeline.maps[name])


def _count_frames(run: RunResult) -> FrameCounts:
    reasons = Counter(frame.reason for frame in run.skipped)
    first = {frame.reason: frame.message for frame in reversed(run.skipped)}
    return FrameCounts(
        used=len(run.steps),
        skipped=len(run.skipped),
        interrupted=run.interrupted,
        reasons=tuple(
            SkipReason(reason, count, first[reason]) for reason, count in reasons.most_common()
        ),
        skipped_frames=tuple(Skipped(frame.index, frame.message) for frame in run.skipped),
        without=frames_without(run.steps),
    )


def frames_without(steps: Sequence[StepResult]) -> dict[str, Lacking]:
    """By name of a map, the frames that gave it nothing, and why the first did not."""
    names = dict.fromkeys(name for step in steps for name in step.lacking)
    lacking = {name: [step for step in steps if name in step.lacking] for name in names}
    return {
        name: Lacking(tuple(step.index for step in found), found[0].lacking[name])
        for name, found in lacking.items()
    }


def _shown(mesh: Mesh | None, name: str, look: Look, run: RunResult) -> PropertyRecord:
    values = None if mesh is None else mesh.attributes.get(name)
    return PropertyRecord(
        frames=sum(name in step.integrations for step in run.steps),
        label=look.label or name,
        colormap=look.colormap,
        range=None if values is None else shown_range(values, look),
    )


def stage_milliseconds(steps: Sequence[StepResult]) -> dict[str, Milliseconds]:
    """Median and mean of every stage over the frames that had it, and of whole frames.

    A stage compiles its kernels in the first frame that has it: that one is left out, and so is
    every such frame of the whole ones, unless there is no other.
    """
    samples: dict[str, list[float]] = {}
    frames, compiling = [], []
    for step in steps:
        first = not step.milliseconds.keys() <= samples.keys()
        (compiling if first else frames).append(sum(step.milliseconds.values()))
        for stage, spent in step.milliseconds.items():
            samples.setdefault(stage, []).append(spent)
    samples = {stage: spent[1:] or spent for stage, spent in samples.items()}
    samples["frame"] = frames or compiling
    return {
        stage: Milliseconds(round(median(values), 2), round(mean(values), 2))
        for stage, values in samples.items()
    }


def first_frame_seconds(steps: Sequence[StepResult]) -> float:
    """What the first frame took, in which most kernels are compiled."""
    return round(1e-3 * sum(steps[0].milliseconds.values()), 3) if steps else 0.0


def versions() -> dict[str, str]:
    """Versions of this package and of what its numbers depend on."""
    import taichi as ti

    return {
        "taichi_unifusion": __version__,
        "python": platform.python_version(),
        "taichi": ".".join(map(str, ti.__version__)),
        "numpy": np.__version__,
        "platform": platform.platform(),
    }


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
