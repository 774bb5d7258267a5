"""What a results folder shows and says of its mesh, brought up to date after the mesh was extracted
again.
"""

from __future__ import annotations

from dataclasses import replace

from ..files.images import write_png
from ..geometry.gravity import Up
from ..rendering.preview import draw_views
from ..types import Mesh
from .folder_writer import FolderWriter
from .outlook import Outlook, read_outlook
from .property_files import redraw_property_pictures
from .record import MeshRecord, read_record, write_record
from .run_folder import RunFolder


def update_folder(folder: RunFolder, mesh: Mesh, up: Up | None = None) -> FolderWriter:
    """Draw the pictures of `mesh`, whose files are written, again, and put its size into the record;
    from where they were drawn before, unless another `up` is given.

    What the folder lacks is not made, but for the preview. The writer says what was written, and
    what failed.
    """
    writer = FolderWriter(folder)
    outlook = None
    if len(mesh.faces):
        outlook = writer.attempt(
            f"{folder.preview}: there is no place to draw the mesh from",
            lambda: read_outlook(folder, mesh, up),
        )
    if outlook is not None:
        views = outlook.views
        writer.write(folder.preview, lambda path: write_png(path, draw_views(mesh, views)))
        redraw_property_pictures(writer, mesh, views)
    else:
        writer.remove(folder.preview)
    if folder.record.exists():
        writer.write(folder.record, lambda path: _update_record(folder, mesh, outlook))
    return writer


def _update_record(folder: RunFolder, mesh: Mesh, outlook: Outlook | None) -> None:
    """The record of the run with the size of another mesh and of the files as they are now."""
    record = read_record(folder.record)
    record = record if outlook is None else outlook.kept_in(record)
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
