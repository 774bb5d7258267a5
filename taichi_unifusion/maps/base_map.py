"""BaseMap: a Latent Implicit Map, sparse voxels (F, w) fused frame by frame (Sec. IV-A, IV-E; Fig.
5).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..errors import InputError, MapCorrupt
from ..files.maps import read_map, write_map
from ..kernels import visibility, voxels
from ..types import PointCloud
from .encoding import EncoderSettings
from .frame_blocks import FrameBlocks
from .regressor import Regressor, sum_count
from .settings import MapSettings
from .voxel_grid import VoxelData, VoxelGrid


@dataclass(frozen=True)
class Integration:
    """What one call of `integrate` did."""

    points: int  # points given
    voxels: int  # voxels encoded from them
    total_voxels: int  # voxels in the map afterwards


class BaseMap(ABC):
    """Voxel structure, encoding, fusion, files; a subclass says which (x, y) pairs a cloud gives."""

    kind: str  # name of the class of map in files
    settings_type: type[MapSettings]
    registry: dict[str, type[BaseMap]] = {}

    def __init_subclass__(cls) -> None:
        BaseMap.registry[cls.kind] = cls

    def __init__(
        self,
        name: str,
        channels: int,
        settings: MapSettings,
        *,
        centered: bool,
        derivatives: bool,
        evidence: bool = False,
    ) -> None:
        self.name, self.channels, self.settings = name, channels, settings
        sums = (
            sum_count(settings.encoder.rank, channels, centered)
            if settings.fusion == "information"
            else 0
        )
        self._grid = VoxelGrid(
            settings.encoder.rank + centered, channels, evidence=evidence, sums=sums
        )
        self._regressor = Regressor(
            self._grid, settings, channels=channels, centered=centered, derivatives=derivatives
        )

    @property
    def voxel_size(self) -> float:
        """Edge of a voxel [m]."""
        return self.settings.voxel_size

    def __len__(self) -> int:
        """Number of voxels."""
        return len(self._grid)

    @property
    def memory_bytes(self) -> int:
        """Bytes of the voxels and their index."""
        return self._grid.memory_bytes

    def integrate(self, cloud: PointCloud) -> Integration:
        """Fuse a cloud in world coordinates into the map.

        A cloud without points changes nothing; points whose normal or value is not finite are left
        out. Raises InputError where the cloud lacks what the map needs, OutOfRange for points
        beyond the index range, CapacityError where the map would grow beyond safe memory; the map
        is then unchanged.
        """
        runtime.check_alive(self._grid.runtime)
        cloud = _finite_rows(cloud, self._observed(cloud))
        if len(cloud) == 0:
            return Integration(0, 0, len(self))
        blocks = self._encode(cloud)  # local LIM: F', w' of every voxel that the cloud touches
        encoded = self._regressor.fuse(blocks)  # global LIM, Eq. 19
        self._vote(cloud, blocks, 1)
        return Integration(len(cloud), encoded, len(self))

    def remove(self, cloud: PointCloud) -> Integration:
        """Take a cloud out again that was integrated, for example to integrate it at a better pose;
        errors as `integrate`.

        Latents and weights become what they were without it, up to rounding; support for surface
        stays, and of the evidence against it what frames in between changed. Removing what was
        never integrated spoils the voxels that it touches.
        """
        runtime.check_alive(self._grid.runtime)
        cloud = _finite_rows(cloud, self._observed(cloud))
        if len(cloud) == 0:
            return Integration(0, 0, len(self))
        blocks = self._encode(cloud)  # before anything changes: it refuses clouds
        self._vote(cloud, blocks, -1)
        encoded = self._regressor.take_out(blocks)
        return Integration(len(cloud), encoded, len(self))

    def _encode(self, cloud: PointCloud) -> FrameBlocks:
        return (
            self._encode_cells(cloud)
            if self.settings.sampling == "cells"
            else self._encode_points(cloud)
        )

    def _vote(self, cloud: PointCloud, blocks: FrameBlocks, sign: int) -> None:
        """What a map learns from where the cloud was seen from; most learn nothing."""

    @abstractmethod
    def _observed(self, cloud: PointCloud) -> NDArray[np.float32]:
        """What this map takes from the cloud beside its points, (N, c); raises InputError where
        that is missing.
        """

    @abstractmethod
    def _encode_cells(self, cloud: PointCloud) -> FrameBlocks:
        """Encode from cell averages; returns the blocks, whose masks hold the support."""

    @abstractmethod
    def _encode_points(self, cloud: PointCloud) -> FrameBlocks:
        """Encode from every point; returns as `_encode_cells`."""

    def _encode_samples(
        self,
        blocks: FrameBlocks,
        regressor: Regressor,
        samples: NDArray[np.float32],
        targets: NDArray[np.float32],
    ) -> None:
        """Encode samples (N, 3) world [m] with targets (N, c), each as it is, after touching their
        voxels.
        """
        blocks.touch(samples, self.voxel_size, spread=True)
        block_of = np.empty(len(samples), np.int32)
        voxels.block_of_points(samples, 1.0 / self.voxel_size, self._grid.block, block_of)
        order = np.argsort(block_of, kind="stable")
        starts = np.searchsorted(block_of[order], np.arange(blocks.count + 1)).astype(np.int32)
        regressor.encode_points(
            blocks,
            starts,
            samples[order] / np.float32(self.voxel_size),
            np.ascontiguousarray(targets[order], dtype=np.float32),
        )

    def merge(self, other: BaseMap) -> None:
        """Fuse another map of the same settings into this one (Eq. 19 is associative); raises
        InputError where they differ.
        """
        self._check_mergeable(other)
        self._fuse_data(other._grid.export())

    def _check_mergeable(self, other: BaseMap) -> None:
        if (other.kind, other.name, other.channels, other.settings) != (
            self.kind,
            self.name,
            self.channels,
            self.settings,
        ):
            raise InputError(
                f"merge: the maps differ: {self.kind} '{self.name}' x{self.channels} {self.settings} and "
                f"{other.kind} '{other.name}' x{other.channels} {other.settings}"
            )

    def _fuse_data(self, data: VoxelData) -> None:
        n = len(data.keys)
        if n:
            slots = np.empty(n, np.int32)
            self._grid.claim(n, data.keys, data.weights, slots)
            sums = np.zeros((1, 1), np.float32) if data.sums is None else data.sums
            self._regressor.fuse_rows(n, slots, data.latents, sums, data.weights, data.masks, 1.0)
            if data.evidence is not None:
                visibility.add_evidence(slots, data.evidence, self._grid.evidence)

    def save(self, path: str | Path) -> None:
        """Write the map to one file; readable on any device. Raises FileError where that fails; an
        old file then stays.
        """
        write_map(
            Path(path),
            self._tensors(),
            {
                "kind": self.kind,
                "name": self.name,
                "channels": self.channels,
                "voxels": len(self),
                "settings": dataclasses.asdict(self.settings),
            },
        )

    @classmethod
    def load(cls, path: str | Path) -> BaseMap:
        """Read a map written by `save`; raises MapCorrupt or FileError. `BaseMap.load` reads any
        kind of map.
        """
        tensors, manifest = read_map(Path(path))
        target = BaseMap.registry.get(manifest.get("kind"))
        if target is None or not issubclass(target, cls):
            raise MapCorrupt(
                f"{path}: holds a map of kind '{manifest.get('kind')}', not '{getattr(cls, 'kind', 'any')}'"
            )
        try:
            values = dict(manifest["settings"])
            settings = target.settings_type(
                **{**values, "encoder": EncoderSettings(**values["encoder"])}
            )
            restored = target._restore(manifest["name"], int(manifest["channels"]), settings)
        except (KeyError, TypeError, InputError) as error:
            raise MapCorrupt(
                f"{path}: its settings are not those of a map of this version of taichi_unifusion; "
                "integrate the frames again"
            ) from error
        restored._restore_tensors(path, tensors)
        return restored

    def _tensors(self) -> dict[str, NDArray]:
        """All voxels as the arrays of a map file."""
        return {
            name: tensor for name, tensor in vars(self._grid.export()).items() if tensor is not None
        }

    def _restore_tensors(self, path: str | Path, tensors: dict[str, NDArray]) -> None:
        """Fill this empty map from the arrays of a map file; raises MapCorrupt where they do not
        fit.
        """
        data = VoxelData(
            **{field.name: tensors.get(field.name) for field in dataclasses.fields(VoxelData)}
        )
        self._check_data(path, data)
        self._fuse_data(data)

    @classmethod
    @abstractmethod
    def _restore(cls, name: str, channels: int, settings: MapSettings) -> BaseMap:
        """An empty map as described by a file's manifest."""

    def _check_data(self, path: str | Path, data: VoxelData) -> None:
        n = -1 if data.keys is None else len(data.keys)
        wanted = {
            "keys": ((n, 3), np.int32),
            "latents": ((n, self._grid.rows, self._grid.channels), np.float32),
            "weights": ((n,), np.float32),
            "masks": ((n, 2), np.uint32),
        }
        if self._grid.with_evidence:
            wanted["evidence"] = ((n, voxels.BLOCK_CELLS), np.int8)
        if self._grid.sum_count:
            wanted["sums"] = ((n, self._grid.sum_count), np.float32)
        for name, (shape, dtype) in wanted.items():
            array = getattr(data, name)
            if array is None or array.shape != shape or array.dtype != dtype:
                found = "nothing" if array is None else f"{array.shape} {array.dtype}"
                raise MapCorrupt(
                    f"{path}: tensor '{name}' should be {shape} {np.dtype(dtype)}, found {found}; "
                    "write the map again"
                )
        if n and not (
            data.keys.min() >= -voxels.INDEX_HALF
            and data.keys.max() < voxels.INDEX_HALF
            and np.isfinite(data.weights).all()
            and (data.weights > 0).all()
            and np.isfinite(data.latents).all()
            and (data.sums is None or np.isfinite(data.sums).all())
        ):
            raise MapCorrupt(
                f"{path}: holds voxels out of range or numbers that are not finite; write the map again"
            )
        if len(np.unique(data.keys, axis=0)) != max(n, 0):
            raise MapCorrupt(f"{path}: holds a voxel twice; write the map again")


def _finite_rows(cloud: PointCloud, observed: NDArray[np.float32]) -> PointCloud:
    """The cloud without the points at which something observed is NaN or infinite."""
    if np.isfinite(observed.sum()):  # one pass; a sum is finite only if all its terms are
        return cloud
    return cloud.take(np.isfinite(observed).all(axis=1))
