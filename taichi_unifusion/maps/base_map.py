"""BaseMap: a Latent Implicit Map, sparse voxels with a latent and a weight (Sec. IV-A, IV-E; Fig. 5)."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Generic, NoReturn, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, MapCorrupt, as_path, check_kind, shortened
from ..files.maps import write_map
from ..types import Frame, PointCloud
from .settings import MapSettings, check_name
from .stored import MapDescription, read_stored
from .voxel_data import VoxelData
from .voxel_grid import VoxelGrid

S = TypeVar("S", bound=MapSettings)


@dataclass(frozen=True)
class Integration:
    """What one call of `integrate` did."""

    points: int  # points given
    voxels: int  # voxels encoded from them
    total_voxels: int  # voxels in the map afterwards


class Unfused(Protocol):
    """Frames that were summed up for a map and wait to be fused."""

    def flush(self) -> None: ...


class BaseMap(ABC, Generic[S]):
    """Name, settings, voxels, files and merging; a subclass says how clouds become voxels.

    Where a pipeline sums up frames before it fuses them, `waiting` is what it has not fused yet;
    whatever reads or changes the map as a whole calls `flush` first.
    """

    kind: ClassVar[str]  # name of the class of map in files
    settings_type: ClassVar[type[MapSettings]]

    def __init__(self, name: str, channels: int, settings: S, grid: VoxelGrid) -> None:
        check_name("name of the map", name)
        self.name, self.channels, self.settings = name, channels, settings
        self.grid = grid
        self.waiting: Unfused | None = None

    def __copy__(self) -> Self:
        """An independent map of the same voxels, bit for bit."""
        self.flush()
        made = self._empty(self.name, self.channels, self.settings)
        made.grid.add(self.grid.export())
        return made

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        return self.__copy__()

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise InputError(
            f"map '{self.name}': a map lives on the device and cannot be pickled: save it with "
            "map.save(FILE), and read it with load_map(FILE) where it is needed"
        )

    def flush(self) -> None:
        """Fuse the frames that a pipeline has summed up for this map, if there are any."""
        if self.waiting is not None:
            self.waiting.flush()

    @property
    def voxel_size(self) -> float:
        """Edge of a voxel [m]."""
        return self.settings.voxel_size

    def __len__(self) -> int:
        """Number of voxels."""
        self.flush()
        return len(self.grid)

    @property
    def memory_bytes(self) -> int:
        """Bytes of the voxels and their index."""
        self.flush()
        return self.grid.memory_bytes

    @property
    def bounds(self) -> NDArray[np.float64] | None:
        """The lowest and the highest corner (2, 3) world [m] of all voxels; None where there is none."""
        self.flush()
        keys = self.grid.voxel_keys()
        return self.voxel_size * np.array([keys.min(0), keys.max(0) + 1]) if len(keys) else None

    def __repr__(self) -> str:
        centimetres = f"{100 * self.voxel_size:g} cm"
        return f"<{type(self).__name__} '{self.name}': {len(self.grid):,} voxels of {centimetres}>"

    def voxels(self) -> VoxelData:
        """All voxels by value, sorted by index."""
        self.flush()
        return self.grid.export()

    @abstractmethod
    def wants(self, cloud: PointCloud | Frame) -> bool:
        """Whether a cloud, or a frame, has what this map takes."""

    @abstractmethod
    def integrate(self, cloud: PointCloud) -> Integration:
        """Fuse a cloud in world coordinates into the map.

        A cloud without points changes nothing; points whose normal or value is not finite are left
        out. Raises InputError where the cloud lacks what the map needs, OutOfRange for points
        beyond the index range, CapacityError where the map would grow beyond safe memory; the map
        is then unchanged.
        """

    def merge(self, other: Self) -> None:
        """Fuse another map of the same settings into this one.

        Latents and weights are those of one map of all frames, up to rounding (Eq. 19 is associative).
        Evidence of a surface map, which cuts its mesh with `carve`, is added too, but rays voted on
        the surface as it was then: the mesh may differ in a few per mille of its vertices, as it does
        when frames come in another order.

        Raises InputError where they differ.
        """
        check_kind("merge", other, BaseMap, "; load_map reads one from a file")
        mine, theirs = self._identity(), other._identity()
        if mine != theirs:
            raise InputError(
                "merge: the maps differ: {} '{}' x{} {} and {} '{}' x{} {}".format(*mine, *theirs)
            )
        self.flush()
        self.fuse_voxels(other.voxels())

    def _identity(self) -> tuple[str, str, int, S]:
        return self.kind, self.name, self.channels, self.settings

    @abstractmethod
    def fuse_voxels(self, data: VoxelData) -> None:
        """Fuse the voxels of another map into this one."""

    def emptied(self) -> Self:
        """A map of the same kind, name and settings without voxels."""
        return self._empty(self.name, self.channels, self.settings)

    def save(self, path: str | Path) -> None:
        """Write the map to one file; readable on any device. Raises FileError where that fails; an
        old file then stays.
        """
        path, voxels = as_path("save", path), self.voxels()
        write_map(path, voxels.tensors, {**self.manifest(), "voxels": len(voxels)})

    def manifest(self) -> dict[str, Any]:
        """What kind of map this is, in JSON values."""
        return {
            "kind": self.kind,
            "name": self.name,
            "channels": self.channels,
            "settings": dataclasses.asdict(self.settings),
        }

    @classmethod
    def load(cls, path: str | Path, *, repair: bool = False) -> Self:
        """Read a map of this kind written by `save`, or one in tiles, all of which then have to fit in
        memory; raises MapCorrupt, FileError or CapacityError. `repair` as in `load_map`.
        """
        description, data = read_stored(as_path("load", path), repair)
        if description.kind != cls.kind:
            raise MapCorrupt(f"{path}: holds a map of kind '{description.kind}', not '{cls.kind}'")
        return cls.restored(description, data)

    @classmethod
    def restored(cls, description: MapDescription, data: VoxelData) -> Self:
        """The map that a file of this kind holds."""
        made = cls.empty(description)
        made.grid.add(data)
        return made

    @classmethod
    def empty(cls, description: MapDescription) -> Self:
        """A map as a file describes it, without voxels."""
        return cls._empty(description.name, description.channels, description.settings)

    @classmethod
    @abstractmethod
    def _empty(cls, name: str, channels: int, settings: Any) -> Self:
        """An empty map as described by a file's manifest."""


def check_cloud(what: str, cloud: object) -> None:
    """Raise InputError for anything but a cloud of points; says how to make one of a frame."""
    if isinstance(cloud, Frame):
        raise InputError(
            f"{what}: expected a PointCloud, got a Frame; uf.preprocess(frame).transformed(frame.T_world_camera) "
            "makes one, and Pipeline.step takes frames"
        )
    if not isinstance(cloud, PointCloud):
        raise InputError(f"{what}: expected a PointCloud, got {shortened(cloud)}")
