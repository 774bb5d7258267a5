"""Partial maps of one place, in tiles, become one map (Eq. 19 adds up), tile by tile: no more than two
tiles are in memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.tiles import Tile, TileFolder
from . import empty_map
from .stored import MapDescription, describe_tiles, read_stored, read_tile
from .tile_places import key_codes, tile_of


def merge_tiles(parts: Sequence[TileFolder], out: TileFolder, tiles: Iterable[Tile]) -> int:
    """Write to `out` the sum of what all parts hold of some tiles; returns how many voxels that are.

    Where the manifest of `out` is of a surface map with votes and those of the parts are not, no cell
    has a vote yet. Raises InputError where the maps differ, FileError, MapCorrupt or CapacityError.
    """
    description = _common(parts)
    wanted = describe_tiles(out)
    if (wanted.kind, wanted.name, wanted.channels) != _identity(description):
        raise InputError(f"merge: {out.path} is for another map than {parts[0].path}")
    tiles = sorted(tile for tile in tiles if any(tile in part.tiles for part in parts))
    scratch = empty_map(description)
    added = [field for field in wanted.fields if field not in description.fields]

    def total(tile: Tile) -> dict[str, NDArray]:
        first, *others = (part for part in parts if tile in part.tiles)
        data = read_tile(first, tile)
        if others:
            scratch.grid.clear()
            scratch.grid.add(data)
            for part in others:
                scratch.fuse_voxels(read_tile(part, tile))
            data = scratch.grid.export()
        more = {each.name: np.zeros((len(data), *each.shape), each.dtype) for each in added}
        return {**data.tensors, **more}

    out.write_each((tile, total(tile)) for tile in tiles)
    return sum(out.tiles[tile].voxels for tile in tiles)


def as_tiles(path: Path, folder: Path) -> TileFolder:
    """The tiles of a map; those of a map in one file are written to `folder`. Raises FileError or
    MapCorrupt.
    """
    if TileFolder.is_one(path):
        return TileFolder.open(path)
    description, data = read_stored(path)
    tiles = TileFolder.create(folder, empty_map(description).manifest())
    codes = key_codes(data.keys)
    tiles.write_each(
        (tile_of(code), {name: each[codes == code] for name, each in data.tensors.items()})
        for code in np.unique(codes).tolist()
    )
    return tiles


def _common(parts: Sequence[TileFolder]) -> MapDescription:
    """What all parts are; raises InputError where they differ."""
    first = describe_tiles(parts[0])
    for part in parts[1:]:
        other = describe_tiles(part)
        if (_identity(other), other.settings) != (_identity(first), first.settings):
            raise InputError(
                f"merge: {parts[0].path} and {part.path} hold maps of other kinds or settings, which "
                "cannot be added up"
            )
    return first


def _identity(description: MapDescription) -> tuple[str, str, int]:
    return description.kind, description.name, description.channels
