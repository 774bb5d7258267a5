"""`unifusion mesh`: saved maps -> mesh files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from numpy.typing import NDArray
from tyro.conf import FlagCreatePairsOff, Positional, arg

from ..config import MeshSettings
from ..errors import FileError, InputError, UniFusionError
from ..geometry.gravity import Up, parse_up
from ..results.run_folder import RunFolder
from ..results.tables import format_bytes
from .options import Device, UpOption
from .results_source import holds_folder
from .terminal import report

if TYPE_CHECKING:
    from ..maps.working_set import MapMemory
    from ..types import Mesh


@dataclass(frozen=True)
class ExtractMesh:
    """Extract the coloured mesh again from the saved maps of a results folder, finer or coarser."""

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """Results folder of `unifusion reconstruct`."""
    resolution: Annotated[int, arg(metavar="N")] = 4
    """Cells along the edge of a surface voxel; 8 gives 4 times the triangles of 4."""
    min_area: Annotated[float, arg(metavar="M2")] = MeshSettings.min_area
    """Connected parts of less than this area, in square metres, are left out; 0 keeps all."""
    out: Annotated[
        Path | None,
        arg(metavar="FILE", help_behavior_hint="(default: DIR/mesh.ply and DIR/mesh.glb)"),
    ] = None
    """Where to write it: .ply, .glb or .obj; by default the meshes of single properties, the pictures
    and the sizes in the record follow.
    """
    up: UpOption = None
    """Another up for the pictures and the record: an axis as z or -y, or three numbers."""
    bounds: Annotated[
        tuple[float, float, float, float, float, float] | None,
        arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help_behavior_hint="(default: everything)"),
    ] = None
    """Only what lies in this box of the world: its lowest and its highest corner, in metres."""
    repair: FlagCreatePairsOff[bool] = False
    """Leave out voxels whose numbers are damaged, instead of refusing their map."""
    device: Device = "auto"
    """Where to compute."""


@holds_folder()
def extract_mesh(options: ExtractMesh) -> int:
    """Saved maps -> mesh files, those of single properties included."""
    from ..files.atomic import check_writable
    from ..files.meshes import MESH_SUFFIXES, write_mesh

    up = parse_up(options.up) if options.up else None
    folder = RunFolder(options.dir)
    files = [options.out] if options.out else [folder.mesh_file("ply"), folder.mesh_file("glb")]
    if files[0].suffix.lower() not in MESH_SUFFIXES:
        raise InputError(
            f"{files[0]}: a mesh is written as {', '.join(MESH_SUFFIXES)}, not as '{files[0].suffix}'"
        )
    maps = folder.maps
    if "surface" not in maps:
        raise FileError(
            f"{options.dir}: no {folder.relative(folder.map('surface'))} here; give the results folder of "
            "`unifusion reconstruct`"
        )
    check_writable(files[0].parent)
    from .. import runtime
    from ..results.tiled import open_memory, stream_mesh

    runtime.init(options.device)
    memory = open_memory(maps)
    if memory is not None and options.out and options.out.suffix.lower() == ".ply":
        settings = MeshSettings(
            resolution=options.resolution, min_area=options.min_area, bounds=options.bounds
        )
        size = stream_mesh(options.out, memory, settings)
        print(_sentence(options.out, size.vertices, size.triangles))
        return report([])
    mesh = _mesh_of(maps, memory, options)
    meshes = dict.fromkeys(files, mesh)
    if not options.out:
        from ..results.property_files import property_meshes

        meshes.update(property_meshes(folder, mesh))
    failures: list[Exception] = []
    T_up_world = _upright(folder, mesh, up)
    for file, shown in meshes.items():
        try:
            write_mesh(file, shown, T_up_world)
            print(_sentence(file, len(shown.vertices), len(shown.faces)))
        except UniFusionError as error:  # the other file may still be written
            failures.append(error)
    if not options.out:
        from ..results.mesh_update import update_folder

        updated = update_folder(folder, mesh, up)
        print(f"{folder.path}: {', '.join(updated.files)} follow the new mesh")
        failures += updated.failures
    return report(failures)


def _mesh_of(maps: Mapping[str, Path], memory: MapMemory | None, options: ExtractMesh) -> Mesh:
    """The mesh of saved maps, by name, or of those in tiles that `memory` reads."""
    from .. import pipeline
    from ..maps import PropertyMap, SurfaceMap
    from ..maps.stored import read_description
    from ..maps.tiled_mesh import joined_mesh

    if memory is not None:
        return joined_mesh(memory, options.resolution, options.min_area, options.bounds)
    properties = {
        name: PropertyMap.load(path, repair=options.repair)
        for name, path in maps.items()
        if read_description(path).kind == PropertyMap.kind  # others give vertices no value
    }
    return pipeline.extract_mesh(
        SurfaceMap.load(maps["surface"], repair=options.repair),
        properties,
        options.resolution,
        options.min_area,
        bounds=options.bounds,
    )


def _sentence(file: Path, vertices: int, triangles: int) -> str:
    return f"{file}: {vertices:,} vertices, {triangles:,} triangles, {format_bytes(file.stat().st_size)}"


def _upright(folder: RunFolder, mesh: Mesh, up: Up | None) -> NDArray | None:
    """T_up_world, by which a GLB stands upright; None where there is nothing to stand."""
    from ..results.outlook import read_up

    if not len(mesh.faces):
        return None
    try:
        return (up or read_up(folder, mesh)).T_up_world
    except FileError:  # a damaged trajectory, which the pictures will say
        return None
