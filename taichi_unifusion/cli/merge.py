"""`unifusion merge`: maps of one place, whose worlds are the same -> one map."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from ..config import MeshSettings
from ..errors import InputError
from ..results.run_folder import RunFolder
from .options import FOLDER, Device
from .terminal import DONE

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Merge:
    """Add up the maps of several results whose worlds are the same: a fleet's, a week's (Eq. 19).

    Example: unifusion merge results/monday results/tuesday --out results/both

    Their poses have to be known in one world; their settings have to be equal. Maps are added tile by
    tile, so that no more than two tiles are in memory.
    """

    results: Annotated[Positional[tuple[Path, ...]], arg(metavar="DIR DIR ...")]
    """Results folders of `unifusion reconstruct`."""
    out: Annotated[Path, FOLDER]
    """Folder for the maps, in tiles, and the mesh."""
    resolution: Annotated[int, arg(metavar="N")] = MeshSettings.resolution
    """Cells along the edge of a surface voxel."""
    map_memory: Annotated[str, arg(metavar="SIZE")] = "2GB"
    """Memory for the maps while the mesh is made."""
    device: Device = "auto"
    """Where to compute."""


def merge(options: Merge) -> int:
    """Maps of several folders -> maps in tiles and a mesh."""
    from .. import runtime
    from ..files.tiles import TileFolder
    from ..maps.settings import parse_bytes
    from ..maps.tile_merge import as_tiles, merge_tiles
    from ..maps.working_set import MapMemory
    from ..results.lock import lock_folder
    from ..results.tiled import stream_mesh
    from ..results.writer import prepare_results

    folders = [RunFolder(path) for path in options.results]
    names = _names(folders)
    if options.out.resolve() in [path.resolve() for path in options.results]:
        raise InputError(f"{options.out}: is one of the folders to merge; choose another --out")
    runtime.init(options.device)
    out = prepare_results(options.out)
    with lock_folder(out):
        merged = {}
        for name in names:
            held = [folder.maps[name] for folder in folders if name in folder.maps]
            parts = [as_tiles(path, out.tiled_map(f".{name}-{n}")) for n, path in enumerate(held)]
            target = TileFolder.create(out.tiled_map(name), parts[0].manifest)
            tiles = {tile for part in parts for tile in part.tiles}
            voxels = merge_tiles(parts, target, tiles)
            for part, path in zip(parts, held, strict=True):
                if part.path != path:
                    part.remove()
            print(f"{name}: {voxels:,} voxels in {len(target.tiles)} tiles, from {len(held)} maps")
            merged[name] = target
        memory = MapMemory.over(merged, parse_bytes(options.map_memory, "map_memory"))
        size = stream_mesh(out.mesh, memory, MeshSettings(resolution=options.resolution))
        print(f"{out.mesh}: {size.vertices:,} vertices, {size.triangles:,} triangles")
    return DONE


def _names(folders: list[RunFolder]) -> list[str]:
    """The maps that any of the folders holds; InputError where there are none to merge."""
    if len(folders) < 2:
        raise InputError("merge: name at least two results folders")
    for folder in folders:
        if "surface" not in folder.maps:
            raise InputError(
                f"{folder.path}: no {folder.relative(folder.map('surface'))} here; give results folders "
                "of `unifusion reconstruct`"
            )
    return sorted({name for folder in folders for name in folder.maps})
