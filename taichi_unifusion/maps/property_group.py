"""PropertyGroup: property maps of equal settings, fused from one encoding (Sec. IV-C, VI-I)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from .. import runtime
from ..errors import InputError
from ..kernels.layout import Layout
from ..types import PointCloud
from .base_map import BaseMap, Integration
from .binner import Binner
from .encoder import Encoder
from .property_map import PropertyMap, encode_values


class MapGroup:
    """Maps that are given the same clouds; this one fuses each of them by itself."""

    def __init__(self, maps: Sequence[BaseMap]) -> None:
        self.maps = tuple(maps)

    def names_in(self, cloud: PointCloud) -> list[str]:
        """The names of the maps that want a cloud."""
        return [each.name for each in self.maps if each.wants(cloud)]

    def integrate(self, cloud: PointCloud) -> dict[str, Integration]:
        """Fuse a cloud in world coordinates into the maps that want it; by name what that did."""
        return {each.name: each.integrate(cloud) for each in self.maps if each.wants(cloud)}


class PropertyGroup(MapGroup):
    """Property maps that take their voxels, position features and factorised Gram matrices from one
    computation a frame.

        group = PropertyGroup([infrared, style])
        group.integrate(cloud)

    A regression's left side depends on positions only (Eq. 18), so the properties of a cloud are
    encoded as columns of one right side. Every map keeps its own voxels and weights: it may lack
    frames that others have, and is saved, loaded and merged alone.
    """

    maps: tuple[PropertyMap, ...]

    def __init__(self, maps: Sequence[PropertyMap]) -> None:
        super().__init__(maps)
        first = self.maps[0]
        for other in self.maps[1:]:
            if other.settings != first.settings:
                raise InputError(
                    f"property group: '{first.name}' and '{other.name}' have other settings: "
                    f"{first.settings} and {other.settings}"
                )
        self._encoders: dict[Layout, Encoder] = {}

    def integrate(self, cloud: PointCloud) -> dict[str, Integration]:
        """Fuse a cloud in world coordinates into the maps whose attribute it has; by name what that
        did.

        Each map is as after an `integrate` of its own; raises as that does, with all maps
        unchanged.
        """
        present = [each for each in self.maps if each.wants(cloud)]
        finite = [
            each for each in present if len(present) > 1 and np.isfinite(each.observed(cloud).sum())
        ]
        # nothing to share; a map whose values are not all finite leaves points out
        if len(finite) < 2 or not len(cloud):
            return super().integrate(cloud)
        done = self._integrate_together(finite, cloud)
        return done | {each.name: each.integrate(cloud) for each in present if each not in finite}

    def _integrate_together(
        self, maps: Sequence[PropertyMap], cloud: PointCloud
    ) -> dict[str, Integration]:
        """Encode the maps' values side by side, and fuse to each map its part."""
        lead, channels = maps[0], sum(each.channels for each in maps)
        runtime.check_alive(lead.grid.runtime)
        # the first map's index says which voxel is which block
        binner = Binner(lead.grid, lead.voxel_size, channels)
        values = [cloud.attributes[each.name] for each in maps]
        encoder = self._encoder(lead, channels)
        local = encode_values(binner, encoder, lead.settings, cloud.points, values)
        for each in maps:  # what does not fit is said before the first of them changes
            each.grid.reserve(local.count)
        done, first = {}, 0
        for each in maps:
            encoded = each.grid.fuse(local.part(first, each.channels))
            done[each.name] = Integration(len(cloud), encoded, len(each))
            first += each.channels
        return done

    def _encoder(self, lead: PropertyMap, channels: int) -> Encoder:
        """An encoder of so many values a point, which is otherwise that of the maps."""
        layout = Layout(
            lead.layout.rank, channels, lead.layout.centered, information=lead.layout.information
        )
        if layout not in self._encoders:
            self._encoders[layout] = Encoder(lead.grid.runtime, lead.settings, layout)
        return self._encoders[layout]


def group_maps(maps: Iterable[BaseMap]) -> list[MapGroup]:
    """The maps in their order, property maps of equal settings together."""
    groups: dict[object, list[BaseMap]] = {}
    for each in maps:
        key = each.settings if isinstance(each, PropertyMap) else each.name
        groups.setdefault(key, []).append(each)
    return [
        PropertyGroup(together)
        if (together := [each for each in members if isinstance(each, PropertyMap)])
        else MapGroup(members)
        for members in groups.values()
    ]
