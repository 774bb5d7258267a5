"""PropertyGroup: property maps of equal settings, fused from one encoding (Sec. IV-C, VI-I)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from .. import runtime
from ..errors import InputError
from ..types import PointCloud
from .base_map import Integration
from .frame_blocks import FrameBlocks
from .property_map import PropertyMap
from .regressor import Regressor


class PropertyGroup:
    """Property maps that take their voxels, position features and factorised Gram matrices from one
    computation a frame.

        group = PropertyGroup([infrared, style])
        group.integrate(cloud)

    A regression's left side depends on positions only (Eq. 18), so the properties of a cloud are
    encoded as columns of one right side. Every map keeps its own voxels and weights: it may lack
    frames that others have, and is saved, loaded and merged alone.
    """

    def __init__(self, maps: Sequence[PropertyMap]) -> None:
        self.maps = tuple(maps)
        first = self.maps[0]
        for other in self.maps[1:]:
            if other.settings != first.settings:
                raise InputError(
                    f"property group: '{first.name}' and '{other.name}' have other settings: {first.settings} and "
                    f"{other.settings}"
                )
        self._encoders: dict[int, tuple[FrameBlocks, Regressor]] = {}  # by channels in all

    def name_in(self, cloud: PointCloud) -> str:
        """The names of the maps whose attribute a cloud has."""
        return " + ".join(each.name for each in self.maps if each.name in cloud.attributes)

    def integrate(self, cloud: PointCloud) -> dict[str, Integration]:
        """Fuse a cloud in world coordinates into the maps whose attribute it has; by name what that
        did.

        Each map is as after an `integrate` of its own; raises as that does, with all maps
        unchanged.
        """
        present = [each for each in self.maps if each.name in cloud.attributes]
        finite = [
            each
            for each in present
            if len(present) > 1 and np.isfinite(each._observed(cloud).sum())
        ]
        # nothing to share; a map whose values are not all finite leaves points out
        if len(finite) < 2 or not len(cloud):
            return {each.name: each.integrate(cloud) for each in present}
        runtime.check_alive(finite[0]._grid.runtime)
        blocks, regressor = self._encoder(finite)
        finite[0]._encode_values(
            blocks, regressor, cloud.points, [cloud.attributes[each.name] for each in finite]
        )
        for each in finite:
            # what does not fit is said before the first of them changes
            each._grid.reserve(blocks.count)
        done, first = {}, 0
        for each in finite:
            done[each.name] = Integration(
                len(cloud), each._regressor.fuse(blocks, regressor, first), len(each)
            )
            first += each.channels
        return done | {each.name: each.integrate(cloud) for each in present if each not in finite}

    def _encoder(self, maps: Sequence[PropertyMap]) -> tuple[FrameBlocks, Regressor]:
        """Scratch for the properties of a frame; the first map's index says which voxel is which
        block.
        """
        channels = sum(each.channels for each in maps)
        if channels not in self._encoders or self._encoders[channels][0].grid is not maps[0]._grid:
            self._encoders[channels] = maps[0]._make_encoder(channels)
        return self._encoders[channels]


def group_maps(maps: Iterable[PropertyMap]) -> list[PropertyGroup]:
    """The maps in groups of equal settings, in their order."""
    groups: dict[object, list[PropertyMap]] = {}
    for each in maps:
        groups.setdefault(each.settings, []).append(each)
    return [PropertyGroup(members) for members in groups.values()]
