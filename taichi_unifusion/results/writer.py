"""The results folder: maps, mesh, preview, trajectory, configuration and record of a run, each
written atomically.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..config import Config, dump_config
from ..datasets.color_camera import ColorCamera, write_color_camera
from ..errors import FileError, InputError
from ..files.atomic import check_writable, write_text
from ..files.images import write_png
from ..files.meshes import write_mesh
from ..files.trajectories import write_trajectory
from ..geometry.gravity import Up
from ..pipeline import Pipeline
from ..properties.specification import name_of
from ..rendering.legend import property_mesh
from ..rendering.look import Look
from ..rendering.preview import draw_views
from ..run_log import RunResult
from ..types import Mesh
from .folder_writer import FolderWriter
from .measure import first_frame_seconds, measure_run
from .outlook import Outlook, look_at_mesh
from .ownership import strangers
from .property_files import looks_of, write_property_picture
from .record import MeshRecord, RunRecord, Seconds, Source, write_record
from .run_folder import MESH_SUFFIXES, RunFolder
from .tiled import picture_resolution, write_mesh_by_tiles, write_tiles

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Results:
    """What was written of a run."""

    directory: Path
    files: tuple[str, ...]  # relative to the directory
    failures: tuple[Exception, ...]  # one for every file that could not be written
    record: RunRecord


def prepare_results(directory: str | Path) -> RunFolder:
    """Make the folder; raises FileError if results cannot be written there, before any work is
    spent on them. A run that fails leaves no empty folder in it.
    """
    if "\0" in str(directory):
        raise FileError("the name of a results folder cannot hold a NUL character")
    folder = RunFolder(check_writable(directory))
    check_writable(folder.map_folder)
    with suppress(OSError):  # it holds maps
        folder.map_folder.rmdir()
    return folder


def check_free(folder: RunFolder, config: Config, features: bool, tracked: bool) -> None:
    """Raise FileError where files that no run wrote stand in the way of those that a run of this
    configuration will write; with a map of features, with tables of a tracker.
    """
    names = ["surface", "color", *map(name_of, config.properties), *["features"] * features]
    wanted = [*folder.run_files(names, config.mesh.formats), *folder.tracking_files * tracked]
    if found := strangers(folder, wanted):
        raise FileError(
            f"{folder.path}: holds {' and '.join(found)}, which no run here is known to have written: choose "
            "another folder, or replace what is there with --overwrite"
        )


def write_results(
    directory: str | Path,
    pipeline: Pipeline,
    run: RunResult,
    recording: Source | None = None,
    tracking: Mapping[str, Any] | None = None,
    written: Sequence[Path] = (),
    up: Up | None = None,
) -> Results:
    """Write everything that a run gave, the maps first.

    `recording` and what a tracker said, as JSON values, are kept in the record. `written` are files
    in the folder that belong to this run and are there already. `up` is found where it is not given.
    """
    folder, started = prepare_results(directory), time.perf_counter()
    folder.map_folder.mkdir(exist_ok=True)
    writer = FolderWriter.marking(folder, written)
    for file in (*folder.tracking_files, folder.windows, folder.keyframes):
        if file not in written:
            writer.remove(file)
    logger.info("writing to %s", folder.path)
    _write_maps(writer, pipeline, run)
    writer.write(folder.trajectory, lambda path: write_trajectory(path, run.trajectory))
    writer.write(folder.config, lambda path: write_text(path, dump_config(pipeline.config)))
    _write_color_camera(writer, recording)
    extracting, mesh = time.perf_counter(), None
    if pipeline.config.mesh.extract:
        logger.info("extracting the mesh")
        memory, settings = pipeline.memory, pipeline.config.mesh
        resolution = picture_resolution(memory, settings) if memory else None
        mesh = writer.attempt(
            f"{folder.path}: the mesh could not be extracted",
            lambda: pipeline.extract_mesh(resolution),
        )
    extracted = time.perf_counter()
    outlook = _find_outlook(writer, mesh, run, up)
    size = None
    if mesh is not None:
        size = _write_mesh_files(writer, mesh, pipeline, run, outlook)
        for name, look in looks_of(pipeline).items():
            _write_property(writer, mesh, name, look, pipeline, run, outlook)
    if not writer.failures:
        for name in writer.of_others:
            writer.remove(folder.path / name)
    seconds = Seconds(
        frames=round(run.seconds, 3),
        first_frame=first_frame_seconds(run.steps),
        mesh=round(extracted - extracting, 3),
        write=round(time.perf_counter() - started - (extracted - extracting), 3),
    )
    record = measure_run(writer, pipeline, run, mesh, seconds, recording, tracking)
    record = record if outlook is None else outlook.kept_in(record)
    record = replace(record, earlier_files=writer.of_others, mesh=size or record.mesh)
    writer.write(folder.record, lambda path: write_record(path, record))
    return Results(folder.path, tuple(writer.files), tuple(writer.failures), record)


def _find_outlook(
    writer: FolderWriter, mesh: Mesh | None, run: RunResult, up: Up | None
) -> Outlook | None:
    """Up and the viewpoints of pictures; None where there is nothing to look at."""
    if mesh is None or not len(mesh.faces):
        return None
    outlook = writer.attempt(
        f"{writer.folder.preview}: there is no place to draw the mesh from",
        lambda: look_at_mesh(mesh, run.trajectory, up),
    )
    if outlook is not None and outlook.up.how in ("cameras", "guess"):
        logger.info("%s", outlook.up.sentence)
    return outlook


def _upright(outlook: Outlook | None) -> NDArray | None:
    """T_up_world, by which a GLB stands upright."""
    return None if outlook is None else outlook.up.T_up_world


def _write_maps(writer: FolderWriter, pipeline: Pipeline, run: RunResult) -> None:
    """Write every map; one that was never made, since no frame gave its values, is a failure."""
    if pipeline.memory:
        write_tiles(writer, pipeline.memory)
    else:
        for name, made in pipeline.maps.items():
            writer.write(writer.folder.map(name), made.save)
    for name, reason in _first_lacking(run).items():
        if name not in pipeline.maps:
            writer.remove(writer.folder.map(name))
            writer.failures.append(
                InputError(
                    f"there is no map of {name}: none of {len(run.steps)} frames gave any (first: "
                    f"{reason})"
                )
            )


def _write_color_camera(writer: FolderWriter, recording: Source | None) -> None:
    """Write the colour camera that was used, for `--color-camera`; without one remove an earlier
    run's.
    """
    color = recording.color if recording else None
    if color is None or color.camera is None:
        writer.remove(writer.folder.color_camera)
        return
    camera = ColorCamera.from_values(color.camera, "the colour camera of this run")
    writer.write(writer.folder.color_camera, lambda path: write_color_camera(path, camera))


def _first_lacking(run: RunResult) -> dict[str, str]:
    """By name of a property, why the first frame that lacks it does not give it."""
    return {name: reason for step in reversed(run.steps) for name, reason in step.lacking.items()}


def _write_mesh_files(
    writer: FolderWriter, mesh: Mesh, pipeline: Pipeline, run: RunResult, outlook: Outlook | None
) -> MeshRecord | None:
    """Write the mesh and a picture of it; returns its size where `mesh` is only a coarse one, because
    the maps lie in tiles.
    """
    folder, size = writer.folder, None
    wanted = {folder.mesh_file(suffix) for suffix in pipeline.config.mesh.formats}
    if not len(mesh.faces):
        writer.failures.append(
            InputError(
                f"the mesh is empty: {len(run.steps)} frames gave no surface; look at preprocess.depth_max, "
                "surface.min_points and surface.support_points, or use more frames"
            )
        )
        wanted &= {folder.mesh}  # the other formats cannot hold an empty mesh
    if pipeline.memory and len(mesh.faces):
        size, wanted = write_mesh_by_tiles(writer, pipeline.memory, pipeline.config.mesh), set()
    for file in folder.meshes:
        if size and file == folder.mesh:
            continue
        if file in wanted:
            writer.write(file, lambda path: write_mesh(path, mesh, _upright(outlook)))
        else:
            writer.remove(file)
    if outlook is not None:
        writer.write(folder.preview, lambda path: write_png(path, draw_views(mesh, outlook.views)))
    else:
        writer.remove(folder.preview)
    return size


def _write_property(
    writer: FolderWriter,
    mesh: Mesh,
    name: str,
    look: Look,
    pipeline: Pipeline,
    run: RunResult,
    outlook: Outlook | None,
) -> None:
    """The mesh in the colours of a property, with its values, and a picture of it with a legend."""
    folder = writer.folder
    if name not in mesh.attributes:
        reason = _first_lacking(run).get(name)
        first = f" (first: {reason})" if reason else ""
        writer.failures.append(
            InputError(
                f"property '{name}' is empty: none of {len(run.steps)} frames gave it{first}"
            )
        )
        for file in folder.property_files(name):
            writer.remove(file)
        return
    shown = property_mesh(mesh, name, look)
    for suffix in MESH_SUFFIXES:
        file = folder.property_mesh(name, suffix)
        if suffix in pipeline.config.mesh.formats:
            writer.write(file, lambda path: write_mesh(path, shown, _upright(outlook)))
        else:
            writer.remove(file)
    if "color" in shown.attributes and outlook is not None:
        writer.write(
            folder.property_picture(name),
            lambda path: write_property_picture(path, shown, name, look, outlook.views),
        )
    else:
        writer.remove(folder.property_picture(name))
