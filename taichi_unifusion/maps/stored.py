"""What a map file holds, read without trust: its sums only say that nothing changed since somebody
wrote it, so kind, settings, sizes and numbers are checked before a map is made of them.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass, replace
from functools import cache, partial
from typing import Any, Literal, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, MapCorrupt, check_choice, convert, did_you_mean, shortened
from ..files.maps import CONTAINER_KEYS, FORMAT_VERSION, read_manifest, read_map
from ..files.tiles import Tile, TileFolder
from ..kernels.fusion import LEAST_WEIGHT
from ..kernels.index import INDEX_HALF
from .encoding import position_encoding
from .settings import (
    MAX_FEATURE_CHANNELS,
    MAX_PROPERTY_CHANNELS,
    FeatureSettings,
    MapSettings,
    PropertySettings,
    SurfaceSettings,
    check_channels,
    check_name,
)
from .voxel_data import (
    KEYS,
    VoxelData,
    VoxelField,
    feature_fields,
    property_fields,
    surface_fields,
)

logger = logging.getLogger(__name__)

# of a stored number: what is decoded from twenty of them stays finite
LARGEST = 1e37
MANIFEST_KEYS = ("kind", "name", "channels", "voxels", "settings")  # that maps write


@dataclass(frozen=True)
class MapKind:
    """What a kind of map may be, as files say it."""

    settings: type[MapSettings]
    channels: int  # at most
    fields: Callable[[int, Any], tuple[VoxelField, ...]]  # of channels and settings
    least_weight: float  # every voxel has more


KINDS = {
    "surface": MapKind(SurfaceSettings, 1, lambda _, s: surface_fields(s), LEAST_WEIGHT),
    "property": MapKind(PropertySettings, MAX_PROPERTY_CHANNELS, property_fields, LEAST_WEIGHT),
    "latent": MapKind(FeatureSettings, MAX_FEATURE_CHANNELS, feature_fields, 0.0),
}


# what maps of older files are, whose settings say nothing of it
BEFORE = {"surface": {"two_sides": False}}
_EXACT = {  # type of a setting -> those that it has in JSON, and their name
    float: ((float, int), "a number"),
    int: ((int,), "a whole number"),
    bool: ((bool,), "true or false"),
    str: ((str,), "text"),
}


@dataclass(frozen=True)
class MapDescription:
    """What a file says about the map in it."""

    kind: str  # one of KINDS
    name: str
    channels: int
    settings: MapSettings
    voxels: int
    version: int  # of the file's format

    @property
    def fields(self) -> tuple[VoxelField, ...]:
        """What such a map holds of a voxel beside its key."""
        return KINDS[self.kind].fields(self.channels, self.settings)

    @property
    def source(self) -> str:
        """What made the features of a map of them, as far as that is known; "" for other maps."""
        return self.settings.source if isinstance(self.settings, FeatureSettings) else ""


def read_description(path: str | os.PathLike[str]) -> MapDescription:
    """What a map file says about itself, checked with the sizes of its tensors, or what the index of
    a map in tiles says; no tensor is read.

    Raises FileError where it cannot be read, MapCorrupt where it makes no sense.
    """
    if TileFolder.is_one(path):
        return describe_tiles(TileFolder.open(path))
    return describe(path, read_manifest(path))


def describe_tiles(folder: TileFolder) -> MapDescription:
    """The description in the index of a map in tiles; raises MapCorrupt."""
    manifest = {**folder.manifest, "voxels": folder.voxels, "format_version": FORMAT_VERSION}
    return _described(folder.index, manifest)


def read_stored(
    path: str | os.PathLike[str], repair: bool = False
) -> tuple[MapDescription, VoxelData]:
    """Description and voxels of a map file, or of all tiles of a map; errors as `read_description`.

    Sizes are compared with the settings before a tensor is read, numbers before they are used. With
    `repair`, voxels of a file whose numbers cannot be are left out, which is said, instead of
    refusing the file.
    """
    if TileFolder.is_one(path):
        folder = TileFolder.open(path)
        description = describe_tiles(folder)
        tiles = [read_tile(folder, tile) for tile in sorted(folder.tiles)]
        fields = {
            field.name: np.concatenate(
                [
                    np.empty((0, *field.shape), field.dtype),
                    *(data.tensors[field.name] for data in tiles),
                ]
            )
            for field in (KEYS, *description.fields)
        }
        _check_voxels(path, description, fields)  # two tiles may not hold the same voxel
        order = np.lexsort(fields[KEYS.name].T[::-1])
        fields = {name: values[order] for name, values in fields.items()}
        return description, VoxelData(fields.pop(KEYS.name), fields)
    tensors, manifest = read_map(path, check=partial(describe, path))
    description = describe(path, manifest)
    if repair:
        description, tensors = _repaired(path, description, tensors)
    _check_voxels(path, description, tensors)
    return description, VoxelData(
        tensors["keys"], {field.name: tensors[field.name] for field in description.fields}
    )


def _repaired(
    path: object, description: MapDescription, tensors: Mapping[str, NDArray]
) -> tuple[MapDescription, Mapping[str, NDArray]]:
    """Only the voxels whose numbers can be those of a map, and how many are left."""
    keys = tensors["keys"]
    sound = ((keys >= -INDEX_HALF) & (keys < INDEX_HALF)).all(axis=1)
    sound &= tensors["weights"] > KINDS[description.kind].least_weight
    for values in tensors.values():
        if values.dtype.kind == "f":
            can_be = np.abs(values) <= LARGEST  # False for NaN
            sound &= can_be.reshape(len(keys), -1).all(axis=1)
    if (lost := int(np.count_nonzero(~sound))) == 0:
        return description, tensors
    logger.warning("%s: %d of %d voxels are damaged and left out", path, lost, len(keys))
    kept = {name: values[sound] for name, values in tensors.items()}
    return replace(description, voxels=len(keys) - lost), kept


def read_tile(folder: TileFolder, tile: Tile) -> VoxelData:
    """The voxels of a tile, checked as `read_stored` does; raises FileError or MapCorrupt."""
    description = describe_tiles(folder)
    tensors, file = folder.read(tile, describe)
    _check_voxels(file, description, tensors)
    return VoxelData(
        tensors["keys"], {field.name: tensors[field.name] for field in description.fields}
    )


def describe(path: object, manifest: Mapping[str, Any]) -> MapDescription:
    """The description in a manifest, whose tensors are those of such a map; raises MapCorrupt."""
    description = _described(path, manifest)
    _check_sizes(path, description, manifest["tensors"])
    return description


def _described(path: object, manifest: Mapping[str, Any]) -> MapDescription:
    """The description in a manifest, whatever its tensors are; raises MapCorrupt."""
    try:
        _check_keys(manifest, (*MANIFEST_KEYS, *CONTAINER_KEYS), "")
        kind = exact(manifest.get("kind"), Literal[tuple(KINDS)], "kind")
        known = KINDS[kind]
        given = manifest.get("settings")
        if isinstance(given, dict):
            given = {**BEFORE.get(kind, {}), **given}
        settings = _settings(known.settings, given, "settings")
        if not settings.voxel_size:  # one that is not chosen yet: no map has that
            raise InputError("settings: voxel_size is missing or 0")
        description = MapDescription(
            kind,
            exact(manifest.get("name"), str, "name"),
            exact(manifest.get("channels"), int, "channels"),
            settings,
            exact(manifest.get("voxels"), int, "voxels"),
            manifest["format_version"],
        )
        check_name("name", description.name)
        if kind == "surface":
            check_choice("name", description.name, ("surface",))
        check_channels("channels", description.channels, known.channels)
        position_encoding(settings.encoder).check()
    except InputError as error:
        raise MapCorrupt(
            f"{path}: {error}; no version of taichi_unifusion up to this one writes such a map: "
            "integrate the frames again"
        ) from None
    return description


def exact(value: object, wanted: Any, name: str) -> Any:
    """`value` if it is of the very type that JSON has for `wanted`, finite and not too large; raises
    InputError, which calls it `name`.
    """
    types, words = _EXACT[str if get_origin(wanted) is Literal else wanted]
    if type(value) not in types:
        raise InputError(f"{name}: expected {words}, got {shortened(value)}")
    return convert(value, wanted, name)


@cache
def _types(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _settings(kind: type, values: object, where: str) -> Any:
    """Settings of a class from a file's values, each of its very type; what an older version did not
    know has its default.
    """
    if not isinstance(values, dict):
        raise InputError(f"{where}: expected names and values, got {shortened(values)}")
    types = _types(kind)
    _check_keys(values, types, where)
    read = {
        key: _settings(types[key], value, f"{where}.{key}")
        if is_dataclass(types[key])
        else exact(value, types[key], f"{where}.{key}")
        for key, value in values.items()
    }
    try:
        return kind(**read)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _check_keys(values: Mapping[str, Any], known: Any, where: str) -> None:
    for key in values:
        if key not in known:
            name = f"{where}.{key}" if where else key
            raise InputError(f"'{name[:80]}' is unknown{did_you_mean(key, known)}")


def _check_sizes(
    path: object, description: MapDescription, tensors: Mapping[str, Mapping[str, Any]]
) -> None:
    """Raise MapCorrupt unless the tensors are those of such a map, all of them and no more."""
    fields = {field.name: field for field in (KEYS, *description.fields)}
    for name in tensors:
        if name not in fields:
            raise MapCorrupt(
                f"{path}: tensor '{name[:80]}' does not belong to a map of kind "
                f"'{description.kind}' with these settings; integrate the frames again"
            )
    for name, field in fields.items():
        wanted = (field.dtype.name, [description.voxels, *field.shape])
        entry = tensors.get(name)
        found = None if entry is None else (entry["dtype"], entry["shape"])
        if found != wanted:
            said = "nothing" if found is None else f"{found[0]} {found[1]}"
            raise MapCorrupt(
                f"{path}: tensor '{name}' should be {wanted[0]} {wanted[1]}, found {said}; "
                "integrate the frames again"
            )


def _check_voxels(
    path: object, description: MapDescription, tensors: Mapping[str, NDArray]
) -> None:
    """Raise MapCorrupt where numbers cannot be those of a map."""
    keys, problem = tensors["keys"], ""
    if len(keys) and not (keys.min() >= -INDEX_HALF and keys.max() < INDEX_HALF):
        problem = "voxels out of range"
    for name, values in tensors.items():
        if values.dtype.kind == "f" and values.size:
            low, high = float(values.min()), float(values.max())  # NaN if there is one
            if not -LARGEST <= low <= high <= LARGEST:
                problem = f"numbers in tensor '{name}' that are not finite, or too large"
    if not (tensors["weights"] > KINDS[description.kind].least_weight).all():
        problem = problem or "voxels of no weight"
    if not problem and _holds_twice(keys):
        problem = "a voxel twice"
    if problem:
        raise MapCorrupt(
            f"{path}: holds {problem}; integrate the frames again, or leave such voxels out: "
            "`unifusion mesh --repair`, load_map(..., repair=True)"
        )


def _holds_twice(keys: NDArray[np.int32]) -> bool:
    """Whether a row (N, 3), whose numbers lie in the range of an index, is there twice."""
    i, j, k = (keys.astype(np.int64) + INDEX_HALF).T
    codes = np.sort((i * 2 * INDEX_HALF + j) * 2 * INDEX_HALF + k)
    return bool((codes[1:] == codes[:-1]).any())
