"""Voters: rays of frames vote in a surface that is there already, as a second pass over a map in tiles.

So the votes do not depend on the order of frames, and those of several processes add up.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MapCorrupt
from ..files.tiles import Tile, TileFolder
from ..geometry.se3 import inverse
from ..kernels import ti
from ..maps import empty_map
from ..maps.stored import describe_tiles, read_tile
from ..maps.surface_map import SurfaceMap
from ..maps.tile_places import TILE, key_codes, tile_of
from ..maps.voxel_data import EVIDENCE, VoxelData
from ..maps.working_set import SEEN_HALO, WorkingSet, seen_points
from ..preprocessing import PreprocessSettings, invert_depth
from ..types import Frame, PinholeCamera

VIEWS = 10  # that vote at once
MOST_VOTES = 127  # that a cell can hold, for or against
VOTES_MANIFEST = {"kind": "votes"}  # of a folder of votes


class Voters:
    """Counts the votes of frames in the surface map that lies in a folder of tiles, of which `limit`
    bytes are in memory at most, and those that a few frames see.
    """

    def __init__(self, tiles: TileFolder, settings: PreprocessSettings, limit: int) -> None:
        surface = empty_map(describe_tiles(tiles))
        assert isinstance(surface, SurfaceMap)
        self.surface = surface
        self.tiles = WorkingSet(self.surface, tiles)
        self.settings, self.limit = settings, limit
        self.counted: dict[int, VoxelData] = {}  # votes of tiles that left memory, by code
        self._views: list[NDArray[np.float32]] = []  # (3, 4) T_camera_world
        self._camera: PinholeCamera | None = None
        self._seen: list[NDArray[np.float64]] = []  # (N, 3) world [m] along their rays

    def add(self, frame: Frame) -> None:
        """Let a frame vote, now or with the next ones; raises FileError, MapCorrupt or CapacityError."""
        if self._camera != frame.camera or len(self._views) == VIEWS:
            self.cast()
        if self._camera != frame.camera:
            self._camera = frame.camera
            self._images = ti.ndarray(ti.f32, (VIEWS, *frame.depth.shape))
        invert_depth(frame, self.settings, self._images, len(self._views))
        self._views.append(inverse(frame.require_pose())[:3].astype(np.float32))
        self._seen.append(seen_points(frame, self.surface.voxel_size * TILE / 2))

    def cast(self) -> None:
        """Count the votes of the frames that wait."""
        if not self._views or self._camera is None:
            return
        if self.tiles.bytes > self.limit:
            self._count()
        self.tiles.bring(sorted(self.tiles.codes(np.concatenate(self._seen), SEEN_HALO)))
        slots = 0, self.surface.grid.count
        self.surface.vote(self._images, self._camera, np.array(self._views), slots)
        self._views, self._seen = [], []

    def votes(self) -> Mapping[Tile, Mapping[str, NDArray]]:
        """The votes of all frames, as the tiles of a folder."""
        self.cast()
        self._count()
        return {tile_of(code): data.tensors for code, data in self.counted.items()}

    def _count(self) -> None:
        """Add what is in memory to the count, and let it go."""
        grid = self.surface.grid
        data = grid.export()
        codes = key_codes(data.keys)
        for code in np.unique(codes).tolist():
            rows = codes == code
            votes = data.fields[EVIDENCE.name][rows].astype(np.int32)
            if code in self.counted:  # the same voxels in the same order
                votes += self.counted[code].fields[EVIDENCE.name]
            self.counted[code] = VoxelData(data.keys[rows], {EVIDENCE.name: votes})
        grid.retain(np.zeros(0, np.int32))
        self.tiles.loaded.clear()


def check_votes(file: Path, manifest: Mapping[str, Any]) -> None:
    """Raise MapCorrupt unless a file holds the votes of a tile."""
    tensors, n = manifest["tensors"], manifest.get("voxels")
    wanted = {"keys": ("int32", [n, 3]), EVIDENCE.name: ("int32", [n, *EVIDENCE.shape])}
    if {name: (each["dtype"], each["shape"]) for name, each in tensors.items()} != wanted:
        raise MapCorrupt(f"{file}: does not hold the votes of a tile")


def add_votes(
    surface: TileFolder, votes: Sequence[TileFolder], out: TileFolder, tiles: Iterable[Tile]
) -> None:
    """Write to `out` some tiles of a surface map with the sum of votes, as `Voters` gives them; raises
    FileError or MapCorrupt.
    """

    def voted(tile: Tile) -> dict[str, NDArray]:
        data = read_tile(surface, tile)
        total = np.zeros((len(data), *EVIDENCE.shape), np.int32)
        for each in votes:
            if tile in each.tiles:
                tensors, _ = each.read(tile, check_votes)
                total[_rows(data, tensors["keys"])] += tensors[EVIDENCE.name]
        held = np.clip(total, -MOST_VOTES, MOST_VOTES).astype(EVIDENCE.dtype)
        return {**data.tensors, EVIDENCE.name: held}

    out.write_each((tile, voted(tile)) for tile in sorted(tiles))


def _rows(data: VoxelData, keys: np.ndarray) -> np.ndarray:
    """The rows (N,) of voxels (N, 3) among those of a tile, which are sorted."""
    low = data.keys.min(axis=0)
    step = np.int64(1) << np.array([42, 21, 0], np.int64)
    codes, wanted = ((each.astype(np.int64) - low) @ step for each in (data.keys, keys))
    return np.searchsorted(codes, wanted)
