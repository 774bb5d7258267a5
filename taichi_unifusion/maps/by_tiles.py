"""Maps that lie in tiles, asked at points: the tiles around some of the points are in memory at a
time, and the answers are those of the whole map.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from ..errors import MapCorrupt
from ..files.tiles import TileFolder
from . import empty_map
from .base_map import BaseMap
from .encoder import check_points
from .feature_map import FeatureMap
from .property_map import PropertyMap
from .settings import FeatureSettings
from .stored import describe_tiles
from .tile_places import place_codes, rows_by_tile
from .working_set import WorkingSet

M = TypeVar("M", bound=BaseMap)


class TiledProperty:
    """A map of a property in the tiles of a folder; raises MapCorrupt where they are of another."""

    def __init__(self, folder: TileFolder) -> None:
        self._tiles, self._map = _opened(folder, PropertyMap)

    def query(
        self, points: NDArray, return_valid: Literal[True]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """As `PropertyMap.query`; raises FileError or MapCorrupt where a tile cannot be read."""

        def ask(some: NDArray) -> tuple[NDArray, ...]:
            return self._map.query(some, return_valid)

        values, valid = _asked(self._tiles, points, ask)
        return values, valid


class TiledFeatures:
    """A map of features in the tiles of a folder; raises MapCorrupt where they are of another."""

    def __init__(self, folder: TileFolder) -> None:
        self._tiles, self._map = _opened(folder, FeatureMap)

    @property
    def settings(self) -> FeatureSettings:
        """The settings of the map."""
        return self._map.settings

    @property
    def channels(self) -> int:
        """Numbers of a feature."""
        return self._map.channels

    @overload
    def similarity(
        self, points: NDArray, text_embedding: NDArray, return_valid: Literal[False] = False
    ) -> NDArray[np.float32]: ...

    @overload
    def similarity(
        self, points: NDArray, text_embedding: NDArray, return_valid: Literal[True]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]: ...

    def similarity(
        self, points: NDArray, text_embedding: NDArray, return_valid: bool = False
    ) -> NDArray[np.float32] | tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """As `FeatureMap.similarity`; raises FileError or MapCorrupt where a tile cannot be read."""

        def ask(some: NDArray) -> tuple[NDArray, ...]:
            return self._map.similarity(some, text_embedding, return_valid=True)

        values, valid = _asked(self._tiles, points, ask)
        return (values, valid) if return_valid else values

    def uncertainty(self, points: NDArray) -> NDArray[np.float32]:
        """As `FeatureMap.uncertainty`; raises FileError or MapCorrupt where a tile cannot be read."""
        return _asked(self._tiles, points, lambda some: (self._map.uncertainty(some),))[0]


Features = FeatureMap | TiledFeatures


def open_features(path: str | Path) -> Features:
    """The map of features in a file, or in tiles, which are read when points are asked; raises
    FileError, MapCorrupt or CapacityError.
    """
    if TileFolder.is_one(path):
        return TiledFeatures(TileFolder.open(path))
    return FeatureMap.load(path)


def open_property(path: str | Path) -> PropertyMap | TiledProperty:
    """The map of a property in a file, or in tiles, as `open_features`."""
    if TileFolder.is_one(path):
        return TiledProperty(TileFolder.open(path))
    return PropertyMap.load(path)


def _opened(folder: TileFolder, kind: type[M]) -> tuple[WorkingSet, M]:
    """The tiles, none of which is in memory, and the map that they are brought to."""
    made = empty_map(describe_tiles(folder))
    if not isinstance(made, kind):
        raise MapCorrupt(f"{folder.path}: holds a map of kind '{made.kind}', not '{kind.kind}'")
    return WorkingSet(made, folder), made


def _asked(
    tiles: WorkingSet, points: NDArray, ask: Callable[[NDArray], tuple[NDArray, ...]]
) -> tuple[NDArray, ...]:
    """What `ask` gives at points (N, 3) world [m], with the tiles around those of one tile in memory
    at a time.
    """
    points = check_points(points)
    answers: list[NDArray] = []
    for _, rows in rows_by_tile(place_codes(points / tiles.map.voxel_size)):
        some = points[rows]
        near = tiles.codes(some)
        if gone := tiles.loaded - near:
            tiles.drop(gone)
        tiles.bring(sorted(near))
        found = ask(some)
        if not answers:
            answers = [np.empty((len(points), *each.shape[1:]), each.dtype) for each in found]
        for whole, part in zip(answers, found, strict=True):
            whole[rows] = part
    return tuple(answers) if answers else ask(points)
