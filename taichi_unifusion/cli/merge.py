"""`unifusion merge`: maps of one place -> one map, of one world or of several."""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ..config import MeshSettings
from ..errors import InputError
from ..results.run_folder import RunFolder
from .mesh import ExtractMesh, extract_mesh
from .options import FOLDER, Device
from .repose import copied
from .terminal import DONE

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Merge:
    """Add up the maps of several results: a fleet's, a week's (Eq. 19).

    Example: unifusion merge results/monday results/tuesday --align --out results/both

    Their settings have to be equal. Where their worlds are the same, maps are added tile by tile, so
    that no more than two tiles are in memory. With --align the others come into the world of the
    first: their cameras find their places in it. That needs windows.log in every folder, which runs
    with --keep-windows leave there.
    """

    results: Annotated[Positional[tuple[Path, ...]], arg(metavar="DIR DIR ...")]
    """Results folders of `unifusion reconstruct`."""
    out: Annotated[Path, FOLDER]
    """Folder for the maps, in tiles, and the mesh."""
    align: FlagCreatePairsOff[bool] = False
    """Every result has a world of its own, as with --tracking rgbd: find the place of each in the first."""
    known_poses: FlagCreatePairsOff[bool] = False
    """The worlds are the same; needed only for results of --tracking rgbd, of which each has its own."""
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
    if options.align and options.known_poses:
        raise InputError(
            "merge: either the worlds are the same (--known-poses), or --align finds out"
        )
    if options.out.resolve() in [path.resolve() for path in options.results]:
        raise InputError(f"{options.out}: is one of the folders to merge; choose another --out")
    if options.align:
        return _merge_aligned(folders, options)
    _check_worlds(folders, options.known_poses)
    runtime.init(options.device)
    out = prepare_results(options.out)
    with lock_folder(out):
        merged = {}
        for name in names:
            held = [folder.maps[name] for folder in folders if name in folder.maps]
            new = out.working_tiles
            parts = [as_tiles(path, new / f"{name}-{n}") for n, path in enumerate(held)]
            target = TileFolder.create(new / name, parts[0].manifest)
            tiles = {tile for part in parts for tile in part.tiles}
            voxels = merge_tiles(parts, target, tiles)
            for part, path in zip(parts, held, strict=True):
                if part.path != path:
                    part.remove()
            print(f"{name}: {voxels:,} voxels in {len(target.tiles)} tiles, from {len(held)} maps")
            merged[name] = target
        merged = {name: each.moved(out.tiled_map(name)) for name, each in merged.items()}
        shutil.rmtree(out.working_tiles, ignore_errors=True)
        memory = MapMemory.over(merged, parse_bytes(options.map_memory, "map_memory"))
        size = stream_mesh(out.mesh, memory, MeshSettings(resolution=options.resolution))
        print(f"{out.mesh}: {size.vertices:,} vertices, {size.triangles:,} triangles")
    return DONE


def _merge_aligned(folders: list[RunFolder], options: Merge) -> int:
    """Maps of several worlds -> a results folder in the world of the first."""
    from .. import runtime
    from ..results.lock import lock_folder
    from ..results.merging import align, check_same_maps, record_all
    from .into import sentence

    config = check_same_maps(folders)
    runtime.init(options.device)
    out = copied(folders[0], options.out)
    try:
        with lock_folder(out):
            maps, added = align(folders, out, config)
            for each in added:
                print(f"{each.folder.path}: {sentence(each.joined, each.views)}")
            for name, made in maps.maps.items():
                made.save(out.map(name))
                print(f"{name}: {len(made.grid):,} voxels, from {len(folders)} maps")
            out.new_windows.replace(out.windows)
            out.new_keyframes.replace(out.keyframes)
            for file in out.asked:  # answers to questions that were put to the first map alone
                file.unlink()
            record_all(folders, out, maps, added)
    except BaseException:
        shutil.rmtree(out.path, ignore_errors=True)  # it is a copy
        raise
    resolution, min_area = options.resolution, config.mesh.min_area
    return extract_mesh(ExtractMesh(out.path, resolution, min_area, device=options.device)) or DONE


def _check_worlds(folders: list[RunFolder], known: bool) -> None:
    """Raise InputError where worlds are surely not the same: each begins at its own first camera."""
    from ..results.record import read_record

    own = []
    for folder in folders:
        record = read_record(folder.record) if folder.record.exists() else None
        tracking = (record and record.tracking) or {}
        if tracking.get("mode") == "rgbd" and not {"joined", "reposed"} & set(tracking):
            own.append(folder.path)
    if own and not known and len(folders) > 1:
        raise InputError(
            f"merge: the world of {own[0]} begins at its own first camera, so maps do not lie on each other; use "
            "--align, or --known-poses where you know better"
        )


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
