"""What a results folder shows and says of its mesh, brought up to date after the mesh was extracted
again.
"""

from __future__ import annotations

from dataclasses import replace

from ..files.trajectories import read_trajectory
from ..rendering.preview import render_preview
from ..types import Mesh, Trajectory
from .folder_writer import FolderWriter
from .property_files import redraw_property_pictures
from .record import MeshRecord, read_record, write_record
from .run_folder import RunFolder


def update_folder(folder: RunFolder, mesh: Mesh) -> FolderWriter:
    """Draw the pictures of `mesh`, whose files are written, again, and put its size into the record.

    What the folder lacks is not made, but for the preview. The writer says what was written, and
    what failed.
    """
    writer = FolderWriter(folder)
    trajectory = writer.attempt(f"{folder.trajectory}: could not be read", lambda: _poses(folder))
    if len(mesh.faces):
        writer.write(folder.preview, lambda path: render_preview(mesh, path, trajectory=trajectory))
        redraw_property_pictures(writer, mesh, trajectory)
    else:
        writer.remove(folder.preview)
    if folder.record.exists():
        writer.write(folder.record, lambda path: _update_record(folder, mesh))
    return writer


def _poses(folder: RunFolder) -> Trajectory | None:
    return read_trajectory(folder.trajectory) if folder.trajectory.exists() else None


def _update_record(folder: RunFolder, mesh: Mesh) -> None:
    """The record of the run with the size of another mesh and of the files as they are now."""
    record = read_record(folder.record)
    names = dict.fromkeys([*record.files, *(folder.relative(file) for file in folder.meshes)])
    sizes = {name: folder.path / name for name in names if (folder.path / name).exists()}
    write_record(
        folder.record,
        replace(
            record,
            mesh=MeshRecord(len(mesh.vertices), len(mesh.faces)),
            files={name: file.stat().st_size for name, file in sizes.items()},
        ),
    )
