"""Tiled maps on disk: a folder with a map file for every tile, and an index that says which.

`index.json` is replaced as a whole, after the files that it names are written and before those that
it no longer names are removed: whoever reads it finds every tile whole, also after a crash.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from ..errors import FileError, InputError, MapCorrupt, convert, shortened
from .atomic import check_writable, file_error, link_or_copy, read_bytes, write_text
from .maps import read_map, write_map

INDEX = "index.json"
FORMAT, FORMAT_VERSION = "taichi_unifusion tiles", 1
MAX_INDEX = 256 << 20  # [bytes]; a tile takes some 100

AT_ONCE = 16  # tiles written with one index

Tile = tuple[int, int, int]  # its place, in edges of a tile
Check = Callable[[Path, dict[str, Any]], object]


@dataclass(frozen=True)
class TileFile:
    """A tile that lies on disk."""

    file: str  # in the folder
    voxels: int
    bytes: int


class TileFolder:
    """The tiles of one map in a folder."""

    def __init__(self, path: Path, manifest: Mapping[str, Any], tiles: dict[Tile, TileFile]):
        # as it comes back from a file
        self.path, self.manifest, self.tiles = path, json.loads(json.dumps(manifest)), tiles
        self._turn = 1 + max((_turn_of(each.file) for each in tiles.values()), default=0)

    @classmethod
    def create(cls, path: str | os.PathLike[str], manifest: Mapping[str, Any]) -> TileFolder:
        """A folder without tiles, in which those of an earlier map are no longer named; `manifest`
        describes the map, in JSON values. Raises FileError where it cannot be written.
        """
        folder = cls(check_writable(path), manifest, {})
        earlier = _earlier(folder.path)
        folder._turn = 1 + max((_turn_of(file.name) for file in earlier), default=0)
        folder._write_index()
        _remove(earlier)
        return folder

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> TileFolder:
        """The tiles in a folder; raises FileError where there are none, MapCorrupt where the index
        is damaged or of another version.
        """
        index = Path(path) / INDEX
        if index.is_file() and index.stat().st_size > MAX_INDEX:
            raise MapCorrupt(f"{index}: too large for the index of a map")
        try:
            values = json.loads(read_bytes(index))
        except (ValueError, RecursionError):
            raise MapCorrupt(f"{index}: not the index of a tiled map, or a damaged file") from None
        return cls(Path(path), *_checked(values, index))

    @staticmethod
    def is_one(path: str | os.PathLike[str]) -> bool:
        """Whether there is a tiled map."""
        return (Path(path) / INDEX).is_file()

    @property
    def index(self) -> Path:
        """The file that names the others."""
        return self.path / INDEX

    @property
    def voxels(self) -> int:
        """Voxels of all tiles."""
        return sum(each.voxels for each in self.tiles.values())

    @property
    def bytes(self) -> int:
        """Bytes of all tiles."""
        return sum(each.bytes for each in self.tiles.values())

    @property
    def files(self) -> list[Path]:
        """The index and the tiles' files."""
        return [self.index, *(self.path / each.file for each in self.tiles.values())]

    def read(self, tile: Tile, check: Check) -> tuple[dict[str, NDArray], Path]:
        """The arrays of a tile, and the file that they come from; `check` is given that file and
        what it says of the map before an array is read. Raises FileError or MapCorrupt.
        """
        file = self.path / self.tiles[tile].file

        def check_tile(manifest: dict[str, Any]) -> None:
            if manifest.get("tile") != list(tile):
                raise MapCorrupt(
                    f"{file}: holds tile {shortened(manifest.get('tile'))}, not {tile}"
                )
            if any(manifest.get(name) != value for name, value in self.manifest.items()):
                raise MapCorrupt(f"{file}: is a tile of another map than {self.index} names")
            check(file, {name: value for name, value in manifest.items() if name != "tile"})

        return read_map(file, check=check_tile)[0], file

    def write(self, tiles: Iterable[tuple[Tile, Mapping[str, NDArray]]]) -> None:
        """Replace tiles by arrays, as they come, or remove those that have none left; all of them or, where
        that fails, none. Raises FileError.
        """
        before, written, replaced = dict(self.tiles), [], []
        try:
            for tile, tensors in tiles:
                if tile in self.tiles:
                    replaced.append(self.path / self.tiles.pop(tile).file)
                if not len(tensors["keys"]):
                    continue
                file = self.path / f"{'_'.join(map(str, tile))}.{self._turn}.safetensors"
                written.append(file)
                manifest = {**self.manifest, "voxels": len(tensors["keys"]), "tile": list(tile)}
                write_map(file, dict(tensors), manifest)
                size = file.stat().st_size
                self.tiles[tile] = TileFile(file.name, len(tensors["keys"]), size)
            self._write_index()
        except BaseException:
            self.tiles = before
            _remove(written)
            raise
        self._turn += 1
        _remove(replaced)

    def write_each(self, tiles: Iterable[tuple[Tile, Mapping[str, NDArray]]]) -> None:
        """Replace many tiles, as they come; the index is written for some at a time. Raises FileError."""
        tiles = iter(tiles)
        while waiting := list(islice(tiles, AT_ONCE)):
            self.write(waiting)

    def adopt(self, other: TileFolder) -> None:
        """Take over the tiles of another folder, in place of those that are here; all of them or, where
        that fails, none. Raises FileError.
        """
        replaced = [self.path / self.tiles[tile].file for tile in other.tiles if tile in self.tiles]
        before, taken = dict(self.tiles), []
        try:
            for tile, each in other.tiles.items():
                name = f"{'_'.join(map(str, tile))}.{self._turn}.safetensors"
                taken.append(self.path / name)
                link_or_copy(other.path / each.file, taken[-1])
                self.tiles[tile] = replace(each, file=name)
            self._write_index()
        except (FileError, OSError) as error:
            self.tiles = before
            _remove(taken)
            raise (
                error if isinstance(error, FileError) else file_error("write", self.path, error)
            ) from error
        self._turn += 1
        _remove(replaced)
        other.remove()

    def moved(self, path: str | os.PathLike[str]) -> TileFolder:
        """These tiles in another folder, where they replace those of an earlier map when all are there;
        raises FileError.
        """
        target = TileFolder(check_writable(path), self.manifest, {})
        earlier = _earlier(target.path)
        target._turn = 1 + max((_turn_of(file.name) for file in earlier), default=0)
        target.adopt(self)
        _remove(earlier)
        return target

    def snapshot(self, path: str | os.PathLike[str]) -> TileFolder:
        """These tiles as they are now in another, new folder too, by links where the disk has them:
        files of tiles never change. Raises FileError.
        """
        copy = TileFolder(check_writable(path), self.manifest, dict(self.tiles))
        try:
            for each in self.tiles.values():
                link_or_copy(self.path / each.file, copy.path / each.file)
        except OSError as error:
            raise file_error("write", copy.path, error) from error
        copy._write_index()
        return copy

    def remove(self) -> None:
        """Remove the tiles, the index, and the folder if it holds nothing else."""
        _remove([*(self.path / each.file for each in self.tiles.values()), self.index])
        with suppress(OSError):
            self.path.rmdir()

    def _write_index(self) -> None:
        tiles = [{"tile": tile, **asdict(each)} for tile, each in sorted(self.tiles.items())]
        values = {"format": FORMAT, "format_version": FORMAT_VERSION, "map": self.manifest}
        write_text(self.index, json.dumps({**values, "tiles": tiles}) + "\n")


def map_bytes(path: Path) -> int:
    """Bytes of a map on disk, in one file or in tiles; 0 where there is none."""
    if TileFolder.is_one(path):
        return TileFolder.open(path).bytes
    return path.stat().st_size if path.exists() else 0


def _checked(values: Any, index: Path) -> tuple[dict[str, Any], dict[Tile, TileFile]]:
    """The manifest and the tiles of an index; raises MapCorrupt."""
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise MapCorrupt(f"{index}: not the index of a tiled map")
    version = values.get("format_version")
    if type(version) is not int or version != FORMAT_VERSION:
        raise MapCorrupt(
            f"{index}: a tiled map of version {shortened(version)}, this program reads version "
            f"{FORMAT_VERSION}; update taichi_unifusion"
        )
    tiles: dict[Tile, TileFile] = {}
    try:
        manifest = _named(values["map"])
        for entry in values["tiles"]:
            i, j, k = (convert(each, int, "tile") for each in entry["tile"])
            file = convert(entry["file"], str, "file")
            if Path(file).name != file or not _turn_of(file) or (i, j, k) in tiles:
                raise InputError(f"tile {i, j, k}: {shortened(file)}")
            sizes = (convert(entry[name], int, name) for name in ("voxels", "bytes"))
            tiles[i, j, k] = TileFile(file, *sizes)
    except (KeyError, TypeError, ValueError, InputError) as error:
        raise MapCorrupt(f"{index}: the index of a tiled map is damaged ({error})") from None
    return manifest, tiles


def _named(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"the map: {shortened(value)}")
    return value


def _turn_of(file: str) -> int:
    """The number of the writing that a tile's file comes from; 0 for other files."""
    parts = file.split(".")
    whole = len(parts) == 3 and parts[2] == "safetensors" and parts[1].isdecimal()
    return int(parts[1]) if whole and parts[0].count("_") == 2 else 0


def _earlier(path: Path) -> list[Path]:
    """The files of tiles that lie in a folder, also those that no index names."""
    return [file for file in path.glob("*.safetensors") if _turn_of(file.name)]


def _remove(files: Iterable[Path]) -> None:
    for file in files:
        with suppress(FileError, OSError):
            file.unlink()
