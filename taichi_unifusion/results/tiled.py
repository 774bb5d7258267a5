"""What differs in a results folder whose maps lie in tiles: their folders, and a mesh that is written
while it is made.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from ..config import MeshSettings
from ..files.mesh_stream import MeshStream
from ..files.tiles import INDEX, TileFolder
from ..maps.stored import describe_tiles
from ..maps.tiled_mesh import mesh_pieces, on_border, parts_with_areas
from ..maps.working_set import MapMemory
from .folder_writer import FolderWriter
from .record import MeshRecord

logger = logging.getLogger(__name__)
READING_MEMORY = 1_000_000_000  # bytes of maps in tiles that are read again
PICTURE_TRIANGLES = 4_000_000  # of the mesh that pictures are drawn from, about


def write_tiles(writer: FolderWriter, memory: MapMemory) -> None:
    """Write what of the maps is in memory, and let all of them lie in the folder, in place of earlier
    ones; their indices stand for all their files.
    """
    for name, each in memory.sets.items():
        path = writer.folder.tiled_map(name)
        writer.write(path / INDEX, lambda _, each=each, path=path: each.move(path))
    with suppress(OSError):  # where they were until now
        memory.folder.rmdir()


def open_memory(maps: Mapping[str, Path]) -> MapMemory | None:
    """Memory for the surface and the properties among saved maps, by name, that lie in tiles, of which
    a part is read at a time; None where the surface does not. Raises FileError or MapCorrupt.
    """
    tiled = {name: path for name, path in maps.items() if TileFolder.is_one(path)}
    if "surface" not in tiled:
        return None
    folders = {name: TileFolder.open(path) for name, path in tiled.items()}
    shown = {
        name: each
        for name, each in folders.items()
        if describe_tiles(each).kind in ("surface", "property")  # others give vertices no value
    }
    return MapMemory.over(shown, READING_MEMORY)


def picture_resolution(memory: MapMemory, settings: MeshSettings) -> int:
    """Cells a voxel of the mesh that pictures are drawn from: those of `settings`, or fewer where that
    would not fit into memory.
    """
    voxels = memory.sets["surface"].folder.voxels
    fits = int((PICTURE_TRIANGLES / max(voxels, 1)) ** 0.5)  # a voxel has about r^2 triangles
    return min(max(fits, 1), settings.resolution)


def write_mesh_by_tiles(
    writer: FolderWriter, memory: MapMemory, settings: MeshSettings
) -> MeshRecord | None:
    """Write the mesh of all tiles as PLY, tile by tile; returns its size, None where that failed."""
    path = writer.folder.mesh
    if set(settings.formats) != {"ply"}:
        logger.info(
            "the mesh is written tile by tile, as PLY alone; `unifusion export` makes others"
        )
    size = writer.attempt(
        f"{path}: could not be written", lambda: stream_mesh(path, memory, settings)
    )
    if size is not None:
        writer.written.append(path)
    return size


def stream_mesh(path: Path, memory: MapMemory, settings: MeshSettings) -> MeshRecord:
    """Write the mesh of all tiles as PLY, holding no more than a few tiles of it; parts of less than
    `settings.min_area` are left out. Raises FileError or MapCorrupt.
    """
    voxel_size = memory.sets["surface"].map.voxel_size
    with MeshStream(path) as stream:
        for slab, mesh in mesh_pieces(memory, settings.resolution, settings.bounds):
            border = on_border(mesh.vertices, voxel_size)
            stream.add(mesh, border, slab, *parts_with_areas(mesh))
        return MeshRecord(*stream.write(settings.min_area))
