"""PropertyGroup: property maps of equal settings, fused from one encoding (Sec. IV-C, VI-I)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import taichi as ti

from .. import runtime
from ..errors import InputError
from ..kernels.cells import put_columns
from ..types import PointCloud
from .base_map import Integration
from .frame_blocks import FrameBlocks
from .property_map import PropertyMap
from .regressor import Regressor


class PropertyGroup:
    """Property maps that take their voxels, position features and factorised Gram matrices from one computation a frame.

        group = PropertyGroup([infrared, style])
        group.integrate(cloud)

    A regression's left side depends on positions only (Eq. 18), so the properties of a cloud are encoded as columns of one
    right side. Every map keeps its own voxels and weights: it may lack frames that others have, and is saved, loaded and
    merged alone.
    """

    def __init__(self, maps: Sequence[PropertyMap]) -> None:
        self.maps = tuple(maps)
        first = self.maps[0]
        for other in self.maps[1:]:
            if other.settings != first.settings:
                raise InputError(f"property group: '{first.name}' and '{other.name}' have other settings: {first.settings} and "
                                 f"{other.settings}")
        self._scratch: dict[int, _Scratch] = {}  # by channels in all

    def name_in(self, cloud: PointCloud) -> str:
        """The names of the maps whose attribute a cloud has."""
        return " + ".join(each.name for each in self.maps if each.name in cloud.attributes)

    def integrate(self, cloud: PointCloud) -> dict[str, Integration]:
        """Fuse a cloud in world coordinates into the maps whose attribute it has; by name what that did.

        Each map is as after an `integrate` of its own; raises as that does, with all maps unchanged.
        """
        present = [each for each in self.maps if each.name in cloud.attributes]
        whole = [each for each in present if len(present) > 1 and np.isfinite(each._observed(cloud).sum())]  # no point is left out
        if len(whole) < 2 or not len(cloud):  # nothing to share
            return {each.name: each.integrate(cloud) for each in present}
        runtime.check_alive(whole[0]._grid.runtime)
        scratch = self._scratch_for(whole, len(cloud))
        blocks, regressor = scratch.blocks, scratch.regressor
        whole[0]._encode_values(blocks, regressor, cloud.points, self._stacked(scratch, whole, cloud))
        for each in whole:
            each._grid.reserve(blocks.count)  # what does not fit is said before the first of them changes
        done, first = {}, 0
        for each in whole:
            done[each.name] = Integration(len(cloud), each._regressor.fuse(blocks, regressor, first), len(each))
            first += each.channels
        return done | {each.name: each.integrate(cloud) for each in present if each not in whole}

    def _scratch_for(self, maps: Sequence[PropertyMap], points: int) -> _Scratch:
        """Scratch for the properties of one frame; the first map's index says which voxel is which block."""
        channels = sum(each.channels for each in maps)
        scratch = self._scratch.get(channels)
        if scratch is None or scratch.blocks.grid is not maps[0]._grid:
            scratch = self._scratch[channels] = _Scratch(*maps[0]._make_encoder(channels), ti.ndarray(ti.f32, (1, channels)))
        if points > scratch.values.shape[0]:
            scratch.values = ti.ndarray(ti.f32, (points * 5 // 4, channels))
        return scratch

    def _stacked(self, scratch: _Scratch, maps: Sequence[PropertyMap], cloud: PointCloud):
        """The values of all maps side by side; as an array of the host where single samples are sorted there."""
        if maps[0].settings.sampling == "points":
            return np.hstack([cloud.attributes[each.name] for each in maps])
        first = 0
        for each in maps:
            put_columns(cloud.attributes[each.name], each.channels, first, scratch.values)
            first += each.channels
        return scratch.values


@dataclass
class _Scratch:
    """What a frame's encoding needs; grows to what frames need and is kept."""

    blocks: FrameBlocks
    regressor: Regressor
    values: ti.Ndarray  # (N or more, channels)


def group_maps(maps: Iterable[PropertyMap]) -> list[PropertyGroup]:
    """The maps in groups of equal settings, in their order."""
    groups: dict[object, list[PropertyMap]] = {}
    for each in maps:
        groups.setdefault(each.settings, []).append(each)
    return [PropertyGroup(members) for members in groups.values()]
