"""PropertyMap: any property of the surface as a LIM (Sec. IV-C)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, Self, Unpack, overload

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..device_arrays import DeviceArray
from ..errors import InputError, strict
from ..kernels.patches import Patches, Values
from ..types import Frame, PointCloud, largest_magnitude
from .binner import Binner, patches_of
from .encoder import Encoder
from .keywords import PropertyKeywords, settings_of, shows_keywords
from .local_lim import LocalLim
from .regression_map import RegressionMap
from .settings import MAX_PROPERTY_CHANNELS, PropertySettings, check_channels
from .value_scale import by_channel, exponent_of
from .voxel_data import property_layout

NEAREST_REACH = 2  # voxels


@strict
class PropertyMap(RegressionMap[PropertySettings]):
    """A continuous field of `channels` values on the surface, fused from the attribute `name` of
    point clouds.

        color = PropertyMap("color", channels=3, voxel_size=0.02)
        color.integrate(cloud)                    # cloud.attributes["color"]: (N, 3)
        rgb = color.query(mesh.vertices)          # (V, 3)

    Keywords are those of `PropertySettings`.
    """

    kind = "property"
    settings_type = PropertySettings

    @shows_keywords(PropertySettings)
    def __init__(
        self,
        name: str,
        channels: int,
        settings: PropertySettings | None = None,
        **keywords: Unpack[PropertyKeywords],
    ) -> None:
        settings = settings_of(PropertySettings, settings, dict(keywords), "PropertyMap")
        check_channels(f"property map '{name}'", channels, MAX_PROPERTY_CHANNELS)
        super().__init__(name, channels, settings, property_layout(channels, settings))
        self.binner = Binner(self.grid, settings.voxel_size, channels)

    @classmethod
    def _empty(cls, name: str, channels: int, settings: PropertySettings) -> Self:
        return cls(name, channels, settings)

    def wants(self, cloud: PointCloud | Frame) -> bool:
        return self.name in cloud.attributes

    def observed(self, cloud: PointCloud) -> NDArray[np.float32]:
        self._check_carried(cloud.attributes)
        return cloud.attributes[self.name]

    def carried(self, patches: Patches) -> Values:
        self._check_carried({name: each.values for name, each in patches.attributes.items()})
        return patches.attributes[self.name]

    def _check_carried(self, attributes: Mapping[str, DeviceArray]) -> None:
        values = attributes.get(self.name)
        if values is None:
            raise InputError(
                f"property map '{self.name}': the cloud has no attribute '{self.name}', only "
                f"{', '.join(sorted(attributes)) or 'none'}"
            )
        if values.shape[1] != self.channels:
            raise InputError(
                f"property map '{self.name}': expected {self.channels} channels, the cloud has "
                f"{values.shape[1]}"
            )

    def encode(self, cloud: PointCloud) -> LocalLim:
        return encode_values([self], self.binner, self.encoder, cloud)

    @overload
    def query(
        self, points: NDArray, return_valid: Literal[False] = False, *, flush: bool = True
    ) -> NDArray[np.float32]: ...

    @overload
    def query(
        self, points: NDArray, return_valid: Literal[True], *, flush: bool = True
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]: ...

    def query(
        self, points: NDArray, return_valid: bool = False, *, flush: bool = True
    ) -> NDArray[np.float32] | tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Property values (N, c) float32 at points (N, 3) world [m]; optionally also where (N,) a
        voxel covers the point.

        Elsewhere the value is that of the nearest voxel within two, so that a mesh has no black
        rims, and 0 beyond. Without `flush`, frames that wait to be fused are left out.
        """
        if flush:
            self.flush()
        runtime.check_alive(self.grid.runtime)
        values, valid = self.decoder.decode(self.grid, points, self.settings.blend, NEAREST_REACH)
        return (values, valid) if return_valid else values


def encode_values(
    maps: Sequence[PropertyMap], binner: Binner, encoder: Encoder, cloud: PointCloud
) -> LocalLim:
    """Encode what a cloud carries for maps of equal settings, side by side, from averages in cells
    or each point as it is.
    """
    if maps[0].settings.sampling == "points":
        values = np.hstack([each.observed(cloud) for each in maps])
        return encoder.encode_samples(binner.sort(cloud.points, values))
    patches = patches_of(cloud, binner.grid.runtime.device)
    exponents = [exponent_of(largest_magnitude(each.observed(cloud))) for each in maps]
    carried = [each.carried(patches) for each in maps]
    return encoder.encode(binner.bin(patches, carried, by_channel(maps, exponents)))
