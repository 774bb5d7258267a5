"""WorkingSet: the tiles of a map that are in memory; the others lie on disk (Sec. IV-A, IV-E).

Voxels do not depend on where their neighbours are kept, so a map in tiles holds what the whole one
would. MapMemory keeps the maps of a pipeline together within a limit: tiles that no frame saw for
longest are written and dropped, and come back when they are seen again.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.tiles import TileFolder
from ..types import Frame
from . import empty_map
from .base_map import BaseMap
from .settings import parse_bytes
from .stored import describe_tiles, read_tile
from .tile_places import TILE, code_of, codes_between, key_codes, place_codes, tile_of

logger = logging.getLogger(__name__)

KEPT_SHARE = 0.6  # of the room that stays taken when tiles are dropped, so that it is done rarely
LEAST_SHARE = 0.4  # of the limit that voxels have, however large their index is
RAY_STEP = 32  # [px] between the rays by which the tiles that a frame sees are found
SEEN_HALO = 4  # voxels around their points that count as seen
HALO = 2  # voxels around a point that its value may depend on


class WorkingSet:
    """The tiles of one map in memory, and the folder with the others."""

    def __init__(self, lim: BaseMap, folder: TileFolder) -> None:
        self.map, self.folder = lim, folder
        self.asked: dict[int, int] = {}  # by code of a tile, when it was asked for last
        self.loaded: set[int] = set()  # tiles of the folder that are in memory as well
        self.changed: set[int] = set()  # tiles that may differ from what the folder has

    @property
    def bytes(self) -> int:
        """Bytes of memory that the voxels take, without their index, whose nodes stay."""
        return len(self.map.grid) * self.map.grid.row_bytes

    def codes(self, points: NDArray, halo: int = HALO) -> set[int]:
        """The tiles around points (N, 3) world [m], by code."""
        voxels = points / self.map.voxel_size
        return set(codes_between(place_codes(voxels - halo), place_codes(voxels + halo)))

    def bring(self, codes: Iterable[int]) -> None:
        """Load the tiles among `codes` that only the folder has; raises FileError, MapCorrupt or
        CapacityError.
        """
        for code in codes:
            tile = tile_of(code)
            if code in self.loaded or tile not in self.folder.tiles:
                continue
            data = read_tile(self.folder, tile)
            there = self.map.grid.slots_of(data.keys) >= 0
            if there.any():  # maps that do not wait for their tiles: Eq. 19 adds up what they saw
                self.map.fuse_voxels(data)
                self.changed.add(code)
            else:
                self.map.grid.add(data)
            self.loaded.add(code)

    def sizes(self) -> dict[int, int]:
        """The tiles in memory by code, and how many voxels each has."""
        codes, counts = np.unique(key_codes(self.map.grid.voxel_keys()), return_counts=True)
        return dict(zip(codes.tolist(), counts.tolist(), strict=True))

    def write(self, codes: Iterable[int] | None = None) -> None:
        """Write the tiles among `codes`, or all, that the folder lacks or has otherwise; frames that
        wait to be fused come first. Raises FileError.
        """
        if codes is None:
            self.map.flush()
        wanted = set(self.sizes()) | self.loaded if codes is None else set(codes)
        wanted = {code for code in wanted if code in self.changed or code not in self.loaded}
        # what lies in the folder of a map that did not wait for it
        self.bring(code for code in wanted if tile_of(code) in self.folder.tiles)
        grid = self.map.grid
        slots, keys = grid.used_slots(), grid.voxel_keys()
        of = key_codes(keys)
        chosen = np.isin(of, list(wanted))
        slots, keys, of = slots[chosen], keys[chosen], of[chosen]
        order = np.lexsort((*keys.T[::-1], of))
        slots, of = slots[order], of[order]
        ends = np.searchsorted(of, sorted(wanted), side="right")
        begins = np.searchsorted(of, sorted(wanted), side="left")
        tiles = [
            (tile_of(code), slots[begin:end])
            for code, begin, end in zip(sorted(wanted), begins, ends, strict=True)
            if end > begin or tile_of(code) in self.folder.tiles
        ]
        if tiles:
            self.folder.write((tile, grid.take(rows).tensors) for tile, rows in tiles)
        self.changed -= wanted
        self.loaded |= {code for code in wanted if tile_of(code) in self.folder.tiles}

    def drop(self, codes: Iterable[int]) -> None:
        """Write tiles and take them out of memory; raises FileError, and nothing is dropped then."""
        gone = set(codes)
        self.write(gone)
        grid = self.map.grid
        of = key_codes(grid.voxel_keys())
        grid.retain(grid.used_slots()[~np.isin(of, list(gone))])
        self.loaded -= gone
        for code in gone:
            self.asked.pop(code, None)

    def move(self, path: Path) -> None:
        """Write what the folder lacks, and let the tiles lie elsewhere, in place of those of an earlier
        map; raises FileError.
        """
        self.write()
        if self.folder.path != path:
            self.folder = self.folder.moved(path)

    def tiles(self) -> set[int]:
        """Codes of all tiles, in memory and on disk."""
        return set(self.sizes()) | {code_of(tile) for tile in self.folder.tiles}


class MapMemory:
    """Keeps maps within a limit [bytes] of memory; the rest of them lies in `folder`, a folder each,
    empty at first, or with the tiles to go on with.
    """

    def __init__(self, limit: int, folder: Path, *, goes_on: bool = False) -> None:
        self.limit, self.folder, self.goes_on = limit, folder, goes_on
        self.sets: dict[str, WorkingSet] = {}
        self._turn = 0
        self._seen: dict[str, set[int]] = {}  # since `settle` was called last

    @classmethod
    def over(cls, folders: Mapping[str, TileFolder], limit: int) -> MapMemory:
        """Memory for reading maps that lie in tiles, by name; raises MapCorrupt."""
        memory = cls(limit, next(iter(folders.values())).path.parent)
        for name, folder in folders.items():
            memory.sets[name] = WorkingSet(empty_map(describe_tiles(folder)), folder)
        return memory

    def follow(self, maps: Mapping[str, BaseMap]) -> None:
        """Take in maps that are new; raises FileError or MapCorrupt."""
        for name, each in maps.items():
            if name not in self.sets:
                path = self.folder / name
                if self.goes_on and TileFolder.is_one(path):
                    folder = TileFolder.open(path)
                else:
                    folder = TileFolder.create(path, each.manifest())
                self.sets[name] = WorkingSet(each, folder)

    def see(self, frame: Frame) -> None:
        """Note which tiles a frame, of which the pose is known, sees or sees through."""
        self._turn += 1
        finest = min(each.map.voxel_size for each in self.sets.values())
        points = seen_points(frame, finest * TILE / 2)
        for name, each in self.sets.items():
            codes = each.codes(points, SEEN_HALO)
            each.asked |= dict.fromkeys(codes, self._turn)
            each.changed |= codes
            self._seen.setdefault(name, set()).update(codes)

    def settle(self) -> None:
        """Bring what frames have seen since the last time, and drop what was not seen for longest
        if there is too much. No frame may be summed up meanwhile. Raises as `WorkingSet` does.
        """
        seen, self._seen = self._seen, {}
        self.shrink(seen)
        for name, codes in seen.items():
            self.sets[name].bring(sorted(codes))

    def shrink(self, needed: Mapping[str, set[int]]) -> None:
        """Where the maps take too much, write and drop the tiles that were asked for longest ago,
        never those of `needed`; raises FileError.
        """
        total = sum(each.bytes for each in self.sets.values())
        if total <= LEAST_SHARE * self.limit:
            return
        index = sum(each.map.grid.index_bytes for each in self.sets.values())
        room = max(self.limit - index, LEAST_SHARE * self.limit)
        if total <= room:
            return
        old = []
        for name, each in self.sets.items():
            sizes = each.sizes()
            voxel = each.bytes / max(sum(sizes.values()), 1)
            spare = sizes.keys() - needed.get(name, set())
            old += [(each.asked.get(code, 0), code, name, sizes[code] * voxel) for code in spare]
        gone: dict[str, list[int]] = {}
        for _, code, name, size in sorted(old):
            if total <= KEPT_SHARE * room:
                break
            total -= size
            gone.setdefault(name, []).append(code)
        for name, codes in gone.items():
            logger.debug("%s: %d tiles are written and dropped", name, len(codes))
            self.sets[name].drop(codes)

    def near(self, name: str, codes: set[int]) -> None:
        """Bring tiles of a map, to read it there, and drop others if need be; raises as
        `WorkingSet`.
        """
        self._turn += 1
        each = self.sets[name]
        each.asked |= dict.fromkeys(codes, self._turn)
        if any(code not in each.loaded and tile_of(code) in each.folder.tiles for code in codes):
            self.shrink({name: codes})
            each.bring(sorted(codes))

    @contextmanager
    def at_most(self, limit: int) -> Iterator[None]:
        """Keep maps within fewer bytes for a while, for who reads them piece by piece."""
        before = self.limit
        self.limit = min(limit, before)
        try:
            yield
        finally:
            self.limit = before

    def save(self) -> None:
        """Write all that the folders lack; raises FileError."""
        for each in self.sets.values():
            each.write()


def make_memory(limit: str, folder: str | Path | None, goes_on: bool) -> MapMemory | None:
    """Memory of so many bytes ("2GB") with a folder for the rest, whose tiles are gone on with or
    replaced; None where there is no limit. Raises InputError where it has no folder.
    """
    if not limit:
        return None
    if folder is None:
        raise InputError(
            "map_memory: name a folder for the tiles that do not fit: Pipeline(tiles=...)"
        )
    return MapMemory(parse_bytes(limit, "map_memory"), Path(folder), goes_on=goes_on)


def seen_points(frame: Frame, step: float) -> NDArray[np.float64]:
    """Points (N, 3) world [m] along some rays of a frame, up to what they read, `step` [m] apart."""
    depth, camera = frame.depth[::RAY_STEP, ::RAY_STEP], frame.camera
    u, v = np.arange(0, camera.width, RAY_STEP), np.arange(0, camera.height, RAY_STEP)
    rays = camera.rays(u, v[:, None])
    read = np.isfinite(depth) & (depth > 0)
    depth, rays = depth[read].astype(np.float64), rays[read]
    steps = np.arange(0.0, depth.max(initial=0.0) + step, step)
    places = np.minimum(steps, depth[:, None])[..., None] * rays[:, None]
    T_world_camera = frame.require_pose()
    return places.reshape(-1, 3) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
