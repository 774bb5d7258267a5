"""PropertyMap: any property of the surface as a LIM (Sec. IV-C)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..errors import InputError
from ..types import PointCloud
from .base_map import BaseMap
from .frame_blocks import FrameBlocks
from .regressor import Regressor
from .settings import PropertySettings

NEAREST_REACH = 2  # voxels


class PropertyMap(BaseMap):
    """A continuous field of `channels` values on the surface, fused from the attribute `name` of
    point clouds.

        color = PropertyMap("color", channels=3, voxel_size=0.02)
        color.integrate(cloud)                    # cloud.attributes["color"]: (N, 3)
        rgb = color.query(mesh.vertices)          # (V, 3)

    Keywords are those of `PropertySettings`.
    """

    kind = "property"
    settings_type = PropertySettings

    def __init__(
        self, name: str, channels: int, settings: PropertySettings | None = None, **overrides
    ) -> None:
        settings = dataclasses.replace(settings or PropertySettings(), **overrides)
        if channels < 1:
            raise InputError(f"property map '{name}': channels must be at least 1, got {channels}")
        super().__init__(
            name, channels, settings, centered=settings.prior == "mean", derivatives=False
        )
        self._cells = FrameBlocks(self._grid, channels, with_positions=False)

    @classmethod
    def _restore(cls, name: str, channels: int, settings: PropertySettings) -> PropertyMap:
        return cls(name, channels, settings)

    def _observed(self, cloud: PointCloud) -> NDArray[np.float32]:
        values = cloud.attributes.get(self.name)
        if values is None:
            raise InputError(
                f"property map '{self.name}': the cloud has no attribute '{self.name}', only "
                f"{', '.join(sorted(cloud.attributes)) or 'none'}"
            )
        if values.shape[1] != self.channels:
            raise InputError(
                f"property map '{self.name}': expected {self.channels} channels, the cloud has {values.shape[1]}"
            )
        return values

    def _encode_cells(self, cloud: PointCloud) -> FrameBlocks:
        self._encode_values(
            self._cells, self._regressor, cloud.points, [cloud.attributes[self.name]]
        )
        return self._cells

    _encode_points = _encode_cells

    def _encode_values(
        self,
        blocks: FrameBlocks,
        regressor: Regressor,
        points: NDArray[np.float32],
        values: Sequence[NDArray[np.float32]],
    ) -> None:
        """Encode arrays of values (N, c), side by side, at points (N, 3) world [m], from cell
        averages or each as it is.
        """
        if self.settings.sampling == "points":
            self._encode_samples(blocks, regressor, points, np.hstack(values))
            blocks.bin_support(points, self.voxel_size, 1)
            return
        blocks.touch(points, self.voxel_size)
        blocks.bin(points, values, self.voxel_size)
        blocks.compact(1)
        regressor.encode_cells(blocks)

    def _make_encoder(self, channels: int) -> tuple[FrameBlocks, Regressor]:
        """Scratch to encode `channels` values a point as this map encodes its own."""
        centered = self.settings.prior == "mean"
        return (
            FrameBlocks(self._grid, channels, with_positions=False),
            Regressor(
                self._grid, self.settings, channels=channels, centered=centered, derivatives=False
            ),
        )

    def query(self, points: NDArray, return_valid: bool = False):
        """Property values (N, c) float32 at points (N, 3) world [m]; optionally also where (N,) a
        voxel covers the point.

        Elsewhere the value is that of the nearest voxel within two, so that a mesh has no black
        rims, and 0 beyond.
        """
        runtime.check_alive(self._grid.runtime)
        values, valid = self._regressor.query(
            points, blend=self.settings.blend, reach=NEAREST_REACH
        )
        return (values, valid) if return_valid else values
