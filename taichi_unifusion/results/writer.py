"""The results folder: maps, mesh, preview, trajectory, configuration and metrics of a run, each
written atomically.
"""

from __future__ import annotations

import json
import logging
import platform
import resource
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np

from .. import __version__, runtime
from ..config import dump_config
from ..errors import FileError, InputError
from ..files.atomic import check_writable, write_text
from ..files.meshes import write_mesh
from ..files.trajectories import write_trajectory
from ..pipeline import FEATURES, Pipeline
from ..rendering.legend import draw_legend, property_mesh
from ..rendering.look import Look, shown_range
from ..rendering.preview import draw_preview, render_preview, write_png
from ..run_log import RunResult, StepResult
from ..types import Mesh, Trajectory

logger = logging.getLogger(__name__)

TRACKING_FILES = ("tracking.csv", "tracking.txt")  # of every frame: verdicts, and poses
ANSWER_FILES = ("query-*.ply", "query-*.png", "query.json", "segmentation.*")
MESH_FILES = ("mesh.ply", "mesh.glb", "mesh.obj")


@dataclass
class ResultsFolder:
    """Writes files into a folder; one that fails is remembered, and the others are still written."""

    directory: Path
    files: list[str] = field(default_factory=list)  # written, relative to the folder
    failures: list[Exception] = field(default_factory=list)

    def write(self, name: str, write: Callable[[Path], Any]) -> None:
        """Call `write` with the path of file `name`."""
        if self.attempt(
            f"{self.directory / name}: could not be written",
            lambda: write(self.directory / name) or True,
        ):
            self.files.append(name)

    def attempt(self, what: str, action: Callable[[], Any]) -> Any:
        """The result of `action`, or None where it failed."""
        try:
            return action()
        except (FileError, InputError) as error:  # these name the file themselves
            self.failures.append(error)
        except Exception as error:  # whatever it is, it must not cost the other files
            logger.debug("%s", what, exc_info=True)
            self.failures.append(
                FileError(f"{what} ({type(error).__name__}: {' '.join(str(error).split())[:200]})")
            )
        return None

    def remove(self, name: str) -> None:
        """Remove a file of an earlier run that this run does not replace, so that results do not
        mix.
        """
        self.attempt(
            f"{self.directory / name}: could not be removed",
            lambda: (self.directory / name).unlink(missing_ok=True),
        )


@dataclass(frozen=True)
class Results:
    """What was written of a run."""

    directory: Path
    files: tuple[str, ...]  # relative to the directory
    failures: tuple[Exception, ...]  # one for every file that could not be written
    metrics: Mapping[str, Any]


def prepare_results(directory: str | Path) -> Path:
    """Make the folder; raises FileError if results cannot be written there, before any work is
    spent on them.
    """
    directory = check_writable(directory)
    check_writable(directory / "maps")
    return directory


def remove_temporaries(directory: Path) -> None:
    """Remove what a write left that was ended at once, in the folders that `prepare_results` made."""
    for path in (*directory.glob(".*.tmp"), *(directory / "maps").glob(".*.tmp")):
        with suppress(OSError):
            path.unlink()


def write_results(
    directory: str | Path,
    pipeline: Pipeline,
    run: RunResult,
    about: Mapping[str, Any] | None = None,
    written: Sequence[str] = (),
) -> Results:
    """Write everything that a run gave, the maps first; `about` joins the metrics (which recording,
    which frames).

    `written` names files in the folder that belong to this run and are there already.
    """
    folder, started = ResultsFolder(prepare_results(directory), list(written)), time.perf_counter()
    for name in TRACKING_FILES:
        if name not in written:
            folder.remove(name)
    logger.info("writing to %s", folder.directory)
    for name, saved in pipeline.maps.items():
        folder.write(f"maps/{name}.safetensors", saved.save)
    if FEATURES not in pipeline.maps:
        folder.remove(f"maps/{FEATURES}.safetensors")
        reasons = [step.lacking[FEATURES] for step in run.steps if FEATURES in step.lacking]
        if reasons:
            folder.failures.append(
                InputError(
                    f"there is no map of features: none of {len(run.steps)} frames gave any (first: "
                    f"{reasons[0]})"
                )
            )
    folder.write("trajectory.txt", lambda path: write_trajectory(path, run.trajectory))
    folder.write("config.yaml", lambda path: write_text(path, dump_config(pipeline.config)))
    logger.info("extracting the mesh")
    extracting = time.perf_counter()
    mesh = folder.attempt(
        f"{folder.directory}: the mesh could not be extracted", pipeline.extract_mesh
    )
    extracted = time.perf_counter()
    if mesh is not None:
        _write_mesh_files(folder, mesh, pipeline, run)
        for name, source in pipeline.sources.items():
            _write_property(folder, mesh, name, source.look, pipeline, run)
    if not folder.failures:
        _remove_others(folder, pipeline)
    seconds = {
        "frames": run.seconds,
        "mesh": extracted - extracting,
        "write": time.perf_counter() - started - (extracted - extracting),
    }
    metrics = {**(about or {}), **_metrics(folder, pipeline, run, mesh, seconds)}
    folder.write(
        "metrics.json", lambda path: write_text(path, json.dumps(metrics, indent=2) + "\n")
    )
    return Results(folder.directory, tuple(folder.files), tuple(folder.failures), metrics)


def _remove_others(folder: ResultsFolder, pipeline: Pipeline) -> None:
    """Remove maps and properties of an earlier run in the folder, and answers that were asked of
    it.
    """
    for file in sorted((folder.directory / "maps").glob("*.safetensors")):
        if file.stem not in pipeline.maps:
            for name in (f"maps/{file.name}", *property_files(file.stem)):
                folder.remove(name)
    for pattern in ANSWER_FILES:
        for file in sorted(folder.directory.glob(pattern)):
            folder.remove(file.name)


def _write_mesh_files(
    folder: ResultsFolder, mesh: Mesh, pipeline: Pipeline, run: RunResult
) -> None:
    wanted = {f"mesh.{suffix}" for suffix in pipeline.config.mesh.formats}
    if not len(mesh.faces):
        folder.failures.append(
            InputError(
                f"the mesh is empty: {len(run.steps)} frames gave no surface; look at preprocess.depth_max, surface.min_points and "
                "surface.support_points, or use more frames"
            )
        )
        wanted &= {"mesh.ply"}  # the other formats cannot say that there is nothing
    for name in MESH_FILES:
        if name in wanted:
            folder.write(name, lambda path: write_mesh(path, mesh))
        else:
            folder.remove(name)
    if len(mesh.faces):
        folder.write(
            "preview.png", lambda path: render_preview(mesh, path, trajectory=run.trajectory)
        )
    else:
        folder.remove("preview.png")


def _write_property(
    folder: ResultsFolder, mesh: Mesh, name: str, look: Look, pipeline: Pipeline, run: RunResult
) -> None:
    """The mesh in the colours of a property, with its values, and a picture of it with a legend."""
    if name not in mesh.attributes:
        reasons = [step.lacking[name] for step in run.steps if name in step.lacking]
        first = f" (first: {reasons[0]})" if reasons else ""
        folder.failures.append(
            InputError(
                f"property '{name}' is empty: none of {len(run.steps)} frames gave it{first}"
            )
        )
        for file in property_files(name):
            folder.remove(file)
        return
    shown = property_mesh(mesh, name, look)
    wanted = {f"{name}.{suffix}" for suffix in pipeline.config.mesh.formats}
    for file in property_files(name):
        if file in wanted:
            folder.write(file, lambda path: write_mesh(path, shown))
        elif file != f"{name}.png" or "color" not in shown.attributes:
            folder.remove(file)
    if "color" in shown.attributes:
        folder.write(
            f"{name}.png",
            lambda path: write_property_picture(path, shown, name, look, run.trajectory),
        )


def property_meshes(directory: Path, mesh: Mesh) -> dict[Path, Mesh]:
    """Mesh files of single properties that a results folder holds, and `mesh` in their colours, as
    its metrics tell them.
    """
    try:
        metrics = json.loads((directory / "metrics.json").read_text(encoding="utf-8"))
        looks = {
            name: Look(shown["colormap"], shown["range"] and tuple(shown["range"]), shown["label"])
            for name, shown in metrics["properties"].items()
        }
    except (
        OSError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
    ):  # of an earlier version, or gone: colours of their own
        looks = {}
    return {
        directory / file: property_mesh(mesh, name, looks.get(name, Look(range=None)))
        for name in mesh.attributes
        if name != "color"
        for file in property_files(name)[:-1]
        if (directory / file).exists()
    }


def property_files(name: str) -> tuple[str, ...]:
    """Files of a property beside its map; the picture is the last."""
    return (*(f"{name}{Path(file).suffix}" for file in MESH_FILES), f"{name}.png")


def write_property_picture(
    path: Path, shown: Mesh, name: str, look: Look, trajectory: Trajectory | None
) -> None:
    """A picture of a mesh in the colours of its property `name`, above their legend."""
    picture = draw_preview(shown, trajectory=trajectory)
    values = shown.attributes[name]
    legend = draw_legend(picture.shape[1], name, look, *shown_range(values, look), values.shape[1])
    write_png(path, np.vstack([picture, legend]))


def _metrics(
    folder: ResultsFolder,
    pipeline: Pipeline,
    run: RunResult,
    mesh: Mesh | None,
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """What `metrics.json` holds; JSON values only."""
    reasons = Counter(frame.reason for frame in run.skipped)
    first = {frame.reason: frame.message for frame in reversed(run.skipped)}
    device = runtime.current()
    return {
        "device": device.device,
        "device_name": device.description,
        "frames": {
            "used": len(run.steps),
            "skipped": len(run.skipped),
            "interrupted": run.interrupted,
            "reasons": [
                {"reason": reason, "frames": count, "first": first[reason]}
                for reason, count in reasons.most_common()
            ],
            "skipped_frames": [
                {"frame": frame.index, "message": frame.message} for frame in run.skipped
            ],
        },
        "milliseconds": stage_milliseconds(run.steps),
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "points": {
            "median": median(step.points for step in run.steps),
            "total": sum(step.points for step in run.steps),
        },
        "maps": {
            name: {
                "voxel_size": target.voxel_size,
                "voxels": len(target),
                "bytes": target.memory_bytes,
                "file_bytes": _size(folder.directory / "maps" / f"{name}.safetensors"),
            }
            for name, target in pipeline.maps.items()
        },
        "properties": {
            name: _shown(mesh, name, source.look, run) for name, source in pipeline.sources.items()
        },
        "mesh": None
        if mesh is None
        else {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)},
        "peak_memory_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        * 1024,  # Linux counts KiB
        "files": {name: _size(folder.directory / name) for name in folder.files},
        "warnings": list(run.warnings),
        "errors": [str(error) for error in (run.failure, *folder.failures) if error is not None],
        "versions": versions(),
    }


def _shown(mesh: Mesh | None, name: str, look: Look, run: RunResult) -> dict[str, Any]:
    """How a property's values were coloured, and how many frames gave it."""
    values = None if mesh is None else mesh.attributes.get(name)
    return {
        "frames": sum(name in step.integrations for step in run.steps),
        "label": look.label or name,
        "colormap": look.colormap,
        "range": None if values is None else list(shown_range(values, look)),
    }


def stage_milliseconds(steps: tuple[StepResult, ...]) -> dict[str, dict[str, float]]:
    """Median and mean of every stage over the frames that had it, and of whole frames; the first
    frame's start-up included.
    """
    stages = list(dict.fromkeys(stage for step in steps for stage in step.milliseconds))
    samples = {
        stage: [step.milliseconds[stage] for step in steps if stage in step.milliseconds]
        for stage in stages
    }
    samples["frame"] = [sum(step.milliseconds.values()) for step in steps]
    return {
        stage: {"median": round(median(values), 2), "mean": round(mean(values), 2)}
        for stage, values in samples.items()
    }


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
