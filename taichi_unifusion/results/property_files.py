"""The files of a single property: the mesh in its colours, and a picture of that with a legend."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ..errors import FileError, InputError
from ..files.images import write_png
from ..pipeline import Pipeline
from ..properties import SurfaceProperty
from ..rendering.drawing import Viewpoint
from ..rendering.legend import draw_legend, property_mesh
from ..rendering.look import Look, shown_range
from ..rendering.preview import draw_views
from ..types import Mesh
from .folder_writer import FolderWriter
from .record import PropertyRecord, read_record
from .run_folder import RunFolder

logger = logging.getLogger(__name__)


def looks_of(pipeline: Pipeline) -> dict[str, Look]:
    """How the mesh is coloured by each property that it carries, by name."""
    return {
        name: source.look
        for name, source in pipeline.sources.items()
        if isinstance(source, SurfaceProperty)  # other sources give vertices no values
    }


def property_meshes(folder: RunFolder, mesh: Mesh) -> dict[Path, Mesh]:
    """Mesh files of single properties that a results folder holds, and `mesh` in their colours, as
    its record tells them.
    """
    looks = recorded_looks(folder)
    return {
        file: property_mesh(mesh, name, looks.get(name, Look(range=None)))
        for name in mesh.attributes
        if name != "color"
        for file in folder.property_meshes(name)
        if file.exists()
    }


def redraw_property_pictures(writer: FolderWriter, mesh: Mesh, views: Sequence[Viewpoint]) -> None:
    """Draw again what pictures of single properties a results folder holds, of `mesh`."""
    folder = writer.folder
    pictures = {name: folder.property_picture(name) for name in mesh.attributes if name != "color"}
    pictures = {name: picture for name, picture in pictures.items() if picture.exists()}
    looks = recorded_looks(folder) if pictures else {}
    for name, picture in pictures.items():
        look = looks.get(name, Look(range=None))
        shown = property_mesh(mesh, name, look)
        if "color" in shown.attributes:
            writer.write(
                picture,
                lambda path, shown=shown, name=name, look=look: write_property_picture(
                    path, shown, name, look, views
                ),
            )


def recorded_looks(folder: RunFolder) -> Mapping[str, Look]:
    """How each property was coloured; empty where the folder has no record that can be read."""
    try:
        record = read_record(folder.record)
        return {name: _look(shown) for name, shown in record.properties.items()}
    except (FileError, InputError) as error:
        logger.warning("%s; properties get their default colours", error)
        return {}


def _look(shown: PropertyRecord) -> Look:
    return Look(shown.colormap, shown.range, shown.label)


def write_property_picture(
    path: Path, shown: Mesh, name: str, look: Look, views: Sequence[Viewpoint]
) -> None:
    """A picture of a mesh in the colours of its property `name`, above their legend."""
    picture = draw_views(shown, views)
    values = shown.attributes[name]
    legend = draw_legend(picture.shape[1], name, look, *shown_range(values, look), values.shape[1])
    write_png(path, np.vstack([picture, legend]))
